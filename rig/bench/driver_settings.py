"""Settings of drivers that the bench understands, although only some drivers have them.

A driver marks them (`rig.core.settings.Channels`, `CommunicationTimeout`, `Deceleration`) and calls
them as it likes; the unit is the one that the name ends with. Where a driver marks none, a setting
with the usual name is taken for it: drivers were written before there was a mark.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from rig.core.settings import (
    CHANNELS,
    COMMUNICATION_TIMEOUT,
    DECELERATION,
    Settings,
    settings_that_mean,
    unit_of,
)

USUAL = {
    CHANNELS: "channels",
    COMMUNICATION_TIMEOUT: "communication_timeout_ms",
    DECELERATION: "deceleration_mm_s2",
}
"""Names of the settings where a driver marks none."""
SECONDS = {"s": 1.0, "ms": 1e-3}
"""Units that the name of a time may end with, in s."""
UNITS = {
    COMMUNICATION_TIMEOUT: {"_s": "s", "_ms": "ms"},
    DECELERATION: {"_mm_s2": "mm/s^2"},
}
"""Units that a setting's name may end with, by that end."""
MARKS = {
    CHANNELS: "Channels",
    COMMUNICATION_TIMEOUT: "CommunicationTimeout",
    DECELERATION: "Deceleration",
}


class StatedTime(NamedTuple):
    """A time that a driver's setting states."""

    name: str
    """Name of the setting."""
    value: float
    unit: str
    """Unit of the value: s or ms."""
    seconds: float


def channels_name(settings: Settings) -> str | None:
    """Return the name of a DAQ's setting of its channels; None if it has none."""
    return _name_of(type(settings), CHANNELS) or None


def channels_of(settings: Settings) -> Mapping[str, Any]:
    """Return the inputs of a DAQ by signal; none if its settings have no channels."""
    _, value = _stated(settings, CHANNELS)
    return value or {}


def communication_timeout(settings: Settings) -> StatedTime | None:
    """Return the time without a request after which a drive stops by itself; None for one that does
    not."""
    name, value = _stated(settings, COMMUNICATION_TIMEOUT)
    unit = unit_of(name) or ""
    if value is None or unit not in SECONDS:  # `mark_errors` reports another unit
        return None
    return StatedTime(name, float(value), unit, float(value) * SECONDS[unit])


def deceleration_mm_s2(settings: Settings) -> float | None:
    """Return with how many mm/s2 a stage brakes; None if its settings do not state it."""
    _, value = _stated(settings, DECELERATION)
    return None if value is None else float(value)


def mark_errors(model: type[Settings]) -> Iterator[str]:
    """Yield a fault for each mark that two settings have, or one with a name in another unit."""
    for meaning, mark in MARKS.items():
        names = settings_that_mean(model, meaning)
        if len(names) > 1:
            yield f"{' and '.join(names)} are both marked as {mark}; one setting may be"
        units = UNITS.get(meaning, {})
        for name in names:
            if units and unit_of(name) not in units.values():
                ends = " or ".join(units)
                yield f"{name} is marked as {mark}: its name must end with its unit, {ends}"


def _name_of(model: type[Settings], meaning: str) -> str:
    """Return the name of the setting with a meaning; "" if there is none."""
    marked = settings_that_mean(model, meaning)
    if marked:
        return marked[0]
    return USUAL[meaning] if USUAL[meaning] in model.model_fields else ""


def _stated(settings: Settings, meaning: str) -> tuple[str, Any]:
    """Return name and value of the setting with a meaning; None for one that is left out."""
    name = _name_of(type(settings), meaning)
    return name, getattr(settings, name) if name else None
