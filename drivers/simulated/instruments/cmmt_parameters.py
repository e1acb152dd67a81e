"""Parameters of a CMMT drive by number (PNU), and the mailbox by which a client accesses them."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence

from drivers.simulated.instruments.cmmt_settings import SimulatedCmmtSettings

MAILBOX_WORDS, DATA_WORDS = 5, 100
_ACCESS, _LENGTH = 3, 4
"""Words of the mailbox; before them are number, subindex and number of elements."""
_READ, _WRITE = 1, 2
_DONE, _REFUSED = 0x10, 3

# Parameter numbers (PNU), from the vendor's pnu_map.csv.
_TELEGRAM, _SERIAL, _FIRMWARE, _TIMEOUT_ms = 3490, 2021, 2266, 4854
_POSITION_UNIT, _SPEED_UNIT = 12698, 12699  # UNCONFIRMED that they describe telegram 111
_CLAMPING, _LOW_LIMIT, _HIGH_LIMIT = 12168, 11584, 11585
_TORQUE, _RATED_TORQUE = 11070, 11704
_WRITABLE = frozenset({_TELEGRAM, _CLAMPING, _LOW_LIMIT, _HIGH_LIMIT})

TELEGRAM = 111
RATED_TORQUE_Nm = 0.5
"""UNCONFIRMED that both torques are in Nm."""


class CmmtParameters:
    """The parameters, and the mailbox: five words that say which one is read or written, and its
    bytes.

    Only a parameter that can be written is written, with as many bytes as it has, and never while
    the drive is enabled.
    """

    def __init__(
        self,
        settings: SimulatedCmmtSettings,
        torque_Nm: Callable[[], float],
        log: Callable[[str, object, str], None],
    ):
        self.values = _factory_parameters(settings)
        """The bytes of each parameter but the present torque, which is asked for."""
        self.mailbox = [0] * MAILBOX_WORDS
        self.data = [0] * DATA_WORDS
        self._torque_Nm = torque_Nm
        self._log = log

    @property
    def clamping_percent(self) -> float:
        """The clamping torque in percent of the full one."""
        (percent,) = struct.unpack("<f", self.values[_CLAMPING])
        return float(percent)

    @property
    def limits(self) -> tuple[int, int]:
        """The software limits in units of position, the negative one first."""
        low, high = (
            struct.unpack("<q", self.values[number])[0] for number in (_LOW_LIMIT, _HIGH_LIMIT)
        )
        return low, high

    def set_timeout_ms(self, value: int) -> None:
        """Show this communication time-out."""
        self.values[_TIMEOUT_ms] = struct.pack("<f", value)

    def write_mailbox(self, at: int, words: Sequence[int], enabled: bool, by: str) -> None:
        """Take words of the mailbox from word `at` on; the one of access executes it."""
        self.mailbox[at : at + len(words)] = words
        if at <= _ACCESS < at + len(words):
            self.mailbox[_ACCESS] = self._access(enabled, by)

    def write_data(self, at: int, words: Sequence[int]) -> None:
        """Take words of a parameter's bytes from word `at` on."""
        self.data[at : at + len(words)] = words

    def _access(self, enabled: bool, by: str) -> int:
        """Execute the mailbox; return 0x10 for done, 3 for an error."""
        number, subindex, elements, access, length = self.mailbox
        known = self._known(number)
        if known is None or subindex or not elements:
            return _REFUSED
        if access == _READ:
            self.mailbox[_LENGTH] = len(known)
            padded = known + b"\0" * (len(known) % 2)
            self.data[: len(padded) // 2] = struct.unpack(f"<{len(padded) // 2}H", padded)
            return _DONE
        if access != _WRITE or number not in _WRITABLE or length != len(known) or enabled:
            return _REFUSED
        raw = struct.pack(f"<{DATA_WORDS}H", *self.data)[:length]
        if number == _CLAMPING and not _positive(raw):
            return _REFUSED
        self.values[number] = raw
        self._log("parameter", {"number": number, "raw": raw.hex()}, by)
        return _DONE

    def _known(self, number: int) -> bytes | None:
        if number == _TORQUE:
            return struct.pack("<f", self._torque_Nm())
        return self.values.get(number)


def _factory_parameters(settings: SimulatedCmmtSettings) -> dict[int, bytes]:
    unit = settings.position_unit_mm
    low, high = (
        round(mm / unit)
        for mm in (settings.mechanics.low_switch_mm, settings.mechanics.high_switch_mm)
    )
    return {
        _TELEGRAM: struct.pack("<H", TELEGRAM),
        _SERIAL: settings.serial.encode("ascii").ljust(5, b"\0")[:5],
        _FIRMWARE: b"simulated".ljust(30, b"\0"),
        _TIMEOUT_ms: struct.pack("<f", 0.0),
        _POSITION_UNIT: _si_unit(settings.position_unit_mm, 0x00),
        _SPEED_UNIT: _si_unit(settings.speed_unit_mm_s, 0x03),
        _CLAMPING: struct.pack("<f", 100.0),
        _RATED_TORQUE: struct.pack("<f", RATED_TORQUE_Nm),
        _LOW_LIMIT: struct.pack("<q", low),
        _HIGH_LIMIT: struct.pack("<q", high),
    }


def _si_unit(millimetres: float, per: int) -> bytes:
    """Return CiA 402 object 60A8h or 60A9h: power of ten, metre (01h), per second (03h) or none."""
    power = round(math.log10(millimetres * 1e-3))
    return struct.pack("<I", (power & 0xFF) << 24 | 0x01 << 16 | per << 8)


def _positive(raw: bytes) -> bool:
    (value,) = struct.unpack("<f", raw)
    return math.isfinite(value) and value > 0
