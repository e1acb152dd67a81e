"""Identifies a CMMT drive and brings its parameters in line with the bench file, at connect.

Parameters (PNU) and their meaning: `drivers.festo_cmmt.driver` lists what is not confirmed of them.
Whether the axis moves meanwhile is the driver's affair.
"""

from __future__ import annotations

import math
import struct

from drivers.festo_cmmt.link import CmmtLink, ParameterRefusedError
from drivers.festo_cmmt.settings import FestoCmmtSettings
from rig.core.errors import InstrumentError
from rig.instruments.roles import Identity

# Parameters (PNU), from the vendor's pnu_map.csv.
TELEGRAM_SELECTION = 3490
SERIAL_NUMBER, SERIAL_LENGTH = 2021, 5
POSITION_UNIT = 12698  # CiA 402 object 60A8h
SPEED_UNIT = 12699  # CiA 402 object 60A9h
CLAMPING_TORQUE = 12168  # REAL, percent of the rated torque
TORQUE, RATED_TORQUE = 11070, 11704  # torqueActDrive, torqueRated: REAL
LOW_LIMIT, HIGH_LIMIT = 11584, 11585  # LINT, position units

TELEGRAM = 111


def read_identity(link: CmmtLink) -> Identity:
    """Return the identity of the drive, whose serial number takes a write to be asked for: it is
    "unknown" here. Raises InstrumentError for another device."""
    objects = link.identification()
    found = f"{objects[0]} {objects[5]}"
    if not any("CMMT" in objects[number] for number in (1, 4, 5)):
        raise InstrumentError(
            link.device,
            "identify",
            f"{link.where} is a {found}",
            "a Festo CMMT drive is expected; correct the host in the bench file",
        )
    return Identity(objects[0], objects[5], "unknown", objects[2])


def ask_serial_number(link: CmmtLink) -> str:
    """Return the serial number by the parameter mailbox, or "unknown" where it is refused."""
    try:
        raw = link.parameter(SERIAL_NUMBER, SERIAL_LENGTH)
    except ParameterRefusedError:
        return "unknown"
    return raw.split(b"\0")[0].decode("ascii", "replace")


def check_telegram(link: CmmtLink) -> None:
    """Raise InstrumentError where the drive speaks another telegram."""
    selected = int.from_bytes(link.parameter(TELEGRAM_SELECTION), "little")
    if selected != TELEGRAM:
        raise InstrumentError(
            link.device,
            f"read parameter {TELEGRAM_SELECTION}",
            f"the drive speaks telegram {selected}",
            f"select telegram {TELEGRAM} in the drive's parameters and restart it",
        )


def check_units(link: CmmtLink, settings: FestoCmmtSettings) -> None:
    """Raise InstrumentError where the drive has other units than the bench file, or does not
    report them and no one has checked them (``trust_units``)."""
    for parameter, name, unit, per in (
        (POSITION_UNIT, "position_unit_mm", "mm", 0x00),
        (SPEED_UNIT, "speed_unit_mm_s", "mm/s", 0x03),
    ):
        _check_unit(link, settings, parameter, name, unit, per)


def _check_unit(
    link: CmmtLink, settings: FestoCmmtSettings, parameter: int, name: str, unit: str, per: int
) -> None:
    """Check the drive's unit as CiA 402 codes it: power of ten, metre (01h), and the divisor."""
    wanted = getattr(settings, name)
    try:
        code = int.from_bytes(link.parameter(parameter), "little")
    except ParameterRefusedError as refused:
        if settings.trust_units:
            return
        raise InstrumentError(
            link.device,
            refused.command,
            "the drive does not report its units",
            "check them in the vendor's software, then set trust_units = true",
        ) from refused
    power = int.from_bytes(bytes([code >> 24]), "little", signed=True)
    if (code >> 16 & 0xFF, code >> 8 & 0xFF) != (0x01, per):
        raise InstrumentError(
            link.device,
            f"read parameter {parameter}",
            f"the drive's unit is {code:#010x} (CiA 402), which cannot be stated in {unit}",
            f"set a unit in metres that agrees with {name} = {wanted:g} in the vendor's software",
        )
    steps = 1000.0 * 10.0**power
    if abs(steps / wanted - 1) >= 1e-9:
        raise InstrumentError(
            link.device,
            f"read parameter {parameter}",
            f"the drive's unit is {steps:g} {unit}, not {wanted:g} {unit}",
            f"correct {name} in the bench file",
        )


def set_limits(link: CmmtLink, settings: FestoCmmtSettings) -> None:
    """Set the travel limits and the clamping torque of the bench file and read them back."""
    for parameter, limit_mm in (
        (LOW_LIMIT, settings.low_limit_mm),
        (HIGH_LIMIT, settings.high_limit_mm),
    ):
        _set(link, parameter, struct.pack("<q", round(limit_mm / settings.position_unit_mm)))
    if settings.torque_limit_percent is not None:
        _set(link, CLAMPING_TORQUE, struct.pack("<f", settings.torque_limit_percent))


def _set(link: CmmtLink, parameter: int, raw: bytes) -> None:
    """Write a parameter only where it differs: the drive's memory wears."""
    if link.parameter(parameter) != raw:
        link.set_parameter(parameter, raw)


def read_rated_torque(link: CmmtLink) -> float | None:
    """Return the rated torque; None where the drive reports no torque."""
    try:
        rated = real(link.parameter(RATED_TORQUE))
        link.parameter(TORQUE)
    except ParameterRefusedError:
        return None
    return rated if math.isfinite(rated) and rated > 0 else None


def real(raw: bytes) -> float:
    """Return the value of a REAL parameter from its four bytes; NaN for another number of bytes."""
    return float(struct.unpack("<f", raw)[0]) if len(raw) == 4 else math.nan
