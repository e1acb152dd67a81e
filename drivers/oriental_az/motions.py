"""Motions of an AZ drive in its own units, and how long they and their exchanges take."""

from __future__ import annotations

from drivers.oriental_az.link import AzLine, halves, reading, writing
from drivers.oriental_az.registers import (
    ABSOLUTE,
    COMMAND_POSITION,
    DIRECT_DATA,
    INPUT_COMMAND,
    OPERATION_TYPE,
    POSITION_REGISTERS,
    STATE_REGISTERS,
    TRIGGER_ALL,
)
from drivers.oriental_az.settings import OrientalAzSettings

KEEP_ALIVES_PER_TIMEOUT = 5
"""Number of state polls of each drive within its communication time-out."""
UPDATE_S = 0.02
"""The fastest line takes this long for a poll and a new target, with room for keep-alives."""
SETTLING_S = 1.0
"""Time in s that a motion may take longer than its profile."""


def operation(
    settings: OrientalAzSettings, target: int, speed_mm_s: float, numbered: bool
) -> tuple[int, tuple[int, ...]]:
    """Return address and words of the write that starts a motion to `target`, in steps.

    The first value is the number of the operation data, which may be left out. A caller that gives
    and omits it in turn sends writes of two lengths, so that a doubled answer to one does not fit
    the next.
    """
    values = (
        0,  # operation data number
        ABSOLUTE,
        target,
        round(speed_mm_s * settings.steps_per_mm),
        round(settings.acceleration_mm_s2 * settings.steps_per_mm),
        round(settings.deceleration_mm_s2 * settings.steps_per_mm),
        round(10 * settings.current_percent),
        TRIGGER_ALL,
    )
    words = tuple(word for value in values for word in halves(value))
    return (DIRECT_DATA, words) if numbered else (OPERATION_TYPE, words[2:])


def longest_s(settings: OrientalAzSettings, distance_mm: float, speed_mm_s: float) -> float:
    """Return the longest time that a motion over this distance may take."""
    slower = min(settings.acceleration_mm_s2, settings.deceleration_mm_s2)
    return distance_mm / speed_mm_s + 4 * settings.max_speed_mm_s / slower + SETTLING_S


def longest_stop_s(settings: OrientalAzSettings) -> float:
    """Return the longest time that a stop may take."""
    return settings.max_speed_mm_s / settings.deceleration_mm_s2 + SETTLING_S


def braking_mm(settings: OrientalAzSettings) -> float:
    """Return the distance in which the axis brakes from its highest speed."""
    return settings.max_speed_mm_s**2 / (2 * settings.deceleration_mm_s2)


def keep_alive_s(settings: OrientalAzSettings) -> float:
    """Return the interval at which the drive's state is read to feed its time-out."""
    return settings.communication_timeout_ms * 1e-3 / KEEP_ALIVES_PER_TIMEOUT


def update_s(settings: OrientalAzSettings, line: AzLine) -> float:
    """Return the duration of a poll and a new target, with the keep-alives of two drives on the
    line."""
    unit = settings.unit_id
    look = reading(unit, COMMAND_POSITION, max(POSITION_REGISTERS))
    target = writing(unit, DIRECT_DATA, (0,) * 16)
    state = reading(unit, INPUT_COMMAND, max(STATE_REGISTERS))
    kept_alive = 2 * line.exchange_s(state) / keep_alive_s(settings)
    return max(UPDATE_S, (line.exchange_s(look) + line.exchange_s(target)) / (1 - kept_alive))
