"""Identifies an AZ drive and brings its parameters in line with the bench file, at connect.

Whether the axis moves meanwhile is the driver's affair.
"""

from __future__ import annotations

from drivers.oriental_az.link import AzLink, AzRefusalError, signed
from drivers.oriental_az.registers import (
    DECELERATION_STOP,
    EXCEPTION_REPLY,
    HIGH_LIMIT,
    LOW_LIMIT,
    OVERTRAVEL,
    SLAVE_ERROR_RESPONSE,
    TEMPERATURES,
    LINE_TIMEOUT_ms,
)
from drivers.oriental_az.settings import OrientalAzSettings
from rig.core.errors import InstrumentError
from rig.instruments.roles import Identity

IDENTITY = Identity("Oriental Motor", "AZ", "unknown", "unknown")
"""An AZ reports neither serial number nor firmware."""
OUTSIDE_C = (-40.0, 150.0)
"""No drive or motor reports a temperature beyond these."""


def identify(link: AzLink) -> None:
    """Check by its registers that the drive is an AZ, which reports no name; only reads. Raises
    InstrumentError where it is not."""
    try:
        words = link.read(TEMPERATURES, 4)
    except AzRefusalError as refused:
        raise _not_an_az(link, f"has no register {TEMPERATURES:04X}h") from refused
    for pair in (words[:2], words[2:]):
        celsius = signed(pair[0] << 16 | pair[1]) / 10
        if not OUTSIDE_C[0] < celsius < OUTSIDE_C[1]:
            raise _not_an_az(link, f"reports a temperature of {celsius:g} C")


def _not_an_az(link: AzLink, why: str) -> InstrumentError:
    return InstrumentError(
        link.device,
        "identify",
        f"{link.where} {why}",
        "an Oriental Motor AZ drive is expected; correct port and unit_id in the bench file",
    )


def set_communication(link: AzLink, settings: OrientalAzSettings) -> None:
    """Set the communication time-out, and that the drive answers what it refuses."""
    link.set_value(LINE_TIMEOUT_ms, settings.communication_timeout_ms)
    link.line.watch(settings.unit_id, link.device, settings.communication_timeout_ms * 1e-3)
    link.set_value(SLAVE_ERROR_RESPONSE, EXCEPTION_REPLY)


def set_limits(link: AzLink, settings: OrientalAzSettings) -> None:
    """Set the travel limits of the bench file and read them back."""
    link.set_value(LOW_LIMIT, round(settings.low_limit_mm * settings.steps_per_mm))
    link.set_value(HIGH_LIMIT, round(settings.high_limit_mm * settings.steps_per_mm))
    if link.read_value(OVERTRAVEL) < 0:  # switched off
        link.set_value(OVERTRAVEL, DECELERATION_STOP)
