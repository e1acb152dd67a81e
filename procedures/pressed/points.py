"""The points of trials with the skin pressed on an object, and their expected times."""

from __future__ import annotations

from typing import TYPE_CHECKING

from procedures.pressed.approach.contact import (
    HOMING_S,
    expected_contact_mm,
    first_ways_s,
    travel_s,
)
from procedures.pressed.approach.tare import TARE_S
from procedures.pressed.approach.unload import SETTLED_S
from procedures.pressed.settings import AFTER_S, CONTACT_N, DELAY_S, TAP_S, NEAR_mm, POLL_RATE_Hz
from rig.core.errors import ConfigurationError
from rig.run.points import Move, Point

if TYPE_CHECKING:
    from procedures.pressed.settings import PressedSettings
    from rig.bench.settings import FixtureSettings

RISE_S = 0.22
"""Expected time in s from touch to the normal force (measured on the skin, 2 to 8 N)."""


def trial_points(
    settings: PressedSettings,
    moves: tuple[Move, ...],
    motion_s: float,
    first_s: float,
    places: int = 1,
) -> tuple[Point, ...]:
    """Return one point for each trial. `motion_s` is the expected time of the motion under the held
    force with its preparation, `first_s` an additional time of the first trial. There are
    `settings.trials` for each of `places` along x. The ways in z depend on the fixture:
    `pressed_overhead_s`."""
    asked = (
        Move("force_sensor.force", settings.largest_force_N, ("largest_force_N",)),
        Move("stage_z.update_rate", settings.updates_Hz, ("tick_Hz",)),
        *moves,
    )
    trial_s = pressing_s(settings) + motion_s + AFTER_S
    return tuple(
        Point(
            id=point_name(number),
            condition=number,
            moves=asked,
            acquisitions=(settings.acquisition,),
            acquisitions_given=("range_V", "rate_S_s"),
            duration_s=trial_s + (first_s if number == 1 else 0.0),
        )
        for number in range(1, settings.trials * places + 1)
    )


def refuse_below_contact(procedure: str, force_N: float) -> None:
    """Raise ConfigurationError for a normal force that is less than what means contact."""
    if force_N < CONTACT_N:
        raise ConfigurationError(
            f"{procedure}: a normal force of {force_N:g} N must be at least {CONTACT_N:g} N, the "
            "force that means contact",
            f"press with {CONTACT_N:g} N or more",
        )


def point_name(number: int) -> str:
    """Return the name of a trial's point, from its number."""
    return f"trial-{number:03d}"


def pressing_s(settings: PressedSettings) -> float:
    """Return the expected time in s of zeroing the force, and from touch to the end of the rest."""
    return 2 * TARE_S + RISE_S + 2 * TAP_S + settings.rest_s


def pressed_overhead_s(
    settings: PressedSettings,
    fixture: FixtureSettings,
    homed: bool,
    presses: int,
    x_mm: float,
    slid_mm: float = 0.0,
) -> float:
    """Return the expected time in s of all travel to the object and back, and of making ready.

    The place of the contact is searched for once. x begins at `x_mm`, and is `slid_mm` from there
    after each press. Stages that are `homed` wait where they are parked, x where the last run has
    left it.
    """
    # Here and not at the top: numpy would slow a command's `--help`.
    from rig.control.approach import TOUCH
    from rig.control.speed_bound import largest_speed_mm_s

    late_s, force_N = DELAY_S + max(settings.tick_s, 1 / POLL_RATE_Hz), settings.normal_force_N
    slow, quick = (
        largest_speed_mm_s(
            share * force_N, fixture.stiffest_N_mm, late_s, settings.acceleration_mm_s2
        )
        for share in (TOUCH, 1.0)
    )
    slow_from_mm, contact_mm, parked_mm = expected_contact_mm(fixture)
    searched_mm = contact_mm - slow_from_mm
    near_mm = min(NEAR_mm, searched_mm)
    ways_s = travel_s(slow_from_mm - parked_mm) + travel_s(contact_mm - parked_mm)
    again_s = (searched_mm - near_mm) / quick + near_mm / slow
    ready_s = 0.0 if homed else 2 * HOMING_S + travel_s(parked_mm) + travel_s(x_mm)
    back_s = (presses - 1 + homed) * travel_s(slid_mm)
    searches_s = searched_mm / slow + (presses - 1) * again_s
    ready_s += first_ways_s(fixture, settings.largest_force_N, homed)
    return ready_s + presses * (ways_s + 2 * SETTLED_S) + back_s + searches_s + 2 * SETTLED_S
