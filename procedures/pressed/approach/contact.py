"""The way of z to the pressed object, the same in every procedure.

The stage waits where it is clear of everything, the force sensor is zeroed there in free air
(`procedures.pressed.approach.tare`), and the way to just above the earliest contact is quick. The
fixture says where contact may be felt: earlier, something is in the way; no later, there is nothing
to press. How contact is searched for and the force brought up is each procedure's own; the way back
is the same again, at every exit (`procedures.pressed.approach.unload`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from procedures.pressed.approach.torque_watch import WayTorque
from procedures.pressed.approach.unload import stop_z, unload_deadline_s
from procedures.pressed.approach.way_down import (
    ARRIVED_S,
    BASELINE_S,
    BOTTOM_mm,
    TRAVEL_mm_s,
    expected_speed_mm_s,
    go_down_watched,
    speed_bound,
    travel_mm_s,
)
from rig.bench.clear_of_contact import CLEAR_mm
from rig.core.errors import (
    ConfigurationError,
    InstrumentError,
    LimitError,
)
from rig.run.trip import TripError

if TYPE_CHECKING:
    from rig.bench.connected import Bench
    from rig.bench.settings import FixtureSettings
    from rig.run.context import Run

FORCE_RATE_S_S = 1000.0
"""Frames a second that a force sensor is asked for (paper 4.1)."""
HOMING_S = 0.68
"""Expected homing time of a stage without a reference, wherever it stands (measured on simulated
drives)."""


def contact_range_mm(bench: Bench) -> tuple[float, float]:
    """Return the positions of the z stage between which contact has to be felt, in mm.

    Raises ConfigurationError if the bench file does not say, or if the parking position is not
    clear of the earliest contact: the run would press on its way there.
    """
    fixture = bench.settings.fixture
    if fixture.contact_from_mm is None or fixture.contact_to_mm is None:
        raise ConfigurationError(
            f"{bench.plan.source}: [fixture] does not say where contact has to be felt",
            "add contact_from_mm and contact_to_mm, positions of the z stage",
        )
    highest_mm = fixture.contact_from_mm - CLEAR_mm
    if fixture.parked_mm > highest_mm + 1e-9:  # the difference of two round numbers
        raise ConfigurationError(
            f"{bench.plan.source}: [fixture] parked_mm = {fixture.parked_mm:g} mm is not clear of "
            f"contact, which may be felt from contact_from_mm = {fixture.contact_from_mm:g} mm on",
            f"set parked_mm to {highest_mm:g} mm or less, or correct contact_from_mm",
        )
    return fixture.contact_from_mm, fixture.contact_to_mm


def expected_contact_mm(fixture: FixtureSettings) -> tuple[float, float, float]:
    """Return three positions of z in mm: where the slow search begins, where contact is expected
    (the middle of where it may be felt), and the parking position. All are the same if the fixture
    does not state them; it is refused later."""
    first_mm, last_mm, parked_mm = (
        fixture.contact_from_mm,
        fixture.contact_to_mm,
        fixture.parked_mm,
    )
    if first_mm is None or last_mm is None:
        return parked_mm, parked_mm, parked_mm
    return first_mm - CLEAR_mm, (first_mm + last_mm) / 2, parked_mm


def travel_s(way_mm: float) -> float:
    """Return the bench time that a quick way is expected to take."""
    return abs(way_mm) / TRAVEL_mm_s + ARRIVED_S if way_mm else 0.0


def first_ways_s(fixture: FixtureSettings, limit_N: float, homed: bool) -> float:
    """Return by how much bench time in s the first ways down of a run are expected to take longer,
    because z has not been there before. They lead to the parking position, unless z is `homed` and
    waits there, and from there to where the slow search begins."""
    slow_from_mm, _, parked_mm = expected_contact_mm(fixture)
    slow_mm_s = expected_speed_mm_s(fixture, limit_N)
    way_mm = slow_from_mm - (parked_mm if homed else 0.0)
    rest_s = 0.0 if homed else BASELINE_S
    return rest_s + way_mm * (1 / slow_mm_s - 1 / TRAVEL_mm_s)


def park(run: Run, name: str, way_back: Callable[[float], None]) -> None:
    """Stop z, find its reference if that is not known, and go where it is clear of everything.

    `way_back` is armed as `name` once it has somewhere to go: a stage without a reference can only
    be stopped, and has pressed nothing yet. It is given the position in mm that z leaves here.

    A way down is slow and watched, since z has not been there in this run. Raises InstrumentError
    where something is felt on it.
    """
    stage = run.bench.stage_z
    arm_from_where_it_stands(run, name, way_back)  # again, to end before what was armed since
    stage.stop()
    if not stage.homed():
        stage.home()
    came_from_mm = stage.position_mm()
    run.arm(
        name,
        lambda: way_back(came_from_mm),
        unload_deadline_s(run),
        emergency=stage.make_safe,
        done=f"{name} released",
    )
    parked_mm = run.bench.settings.fixture.parked_mm
    if parked_mm > came_from_mm + BOTTOM_mm:
        go_down_watched(run, parked_mm, f"parked_mm = {parked_mm:g} mm")
    else:
        stage.move_to(parked_mm, travel_mm_s(stage))


def arm_from_where_it_stands(run: Run, name: str, way_back: Callable[[float], None]) -> None:
    """Register the end of z before anything is asked of it, or of the force sensor: z is stopped
    and, if it stands where contact may be, goes its `way_back` from there.

    It may stand on something that an earlier run has left pressed, and what fails first may be the
    force sensor that would show it.
    """
    stage = run.bench.stage_z
    first_mm, _ = contact_range_mm(run.bench)

    def end() -> None:
        stop_z(run)
        try:
            if not stage.homed():
                return
            stands_mm = stage.position_mm()
        except InstrumentError as error:
            # It has stopped, and was not moved.
            run.ending.fail(error, "it is not known where stage_z is")
            return
        if stands_mm > first_mm - CLEAR_mm + BOTTOM_mm:
            way_back(stands_mm)

    deadline_s = unload_deadline_s(run)
    run.arm(name, end, deadline_s, emergency=stage.make_safe, done="z stage stopped")


def stream_force(run: Run, least_S_s: float, what: str) -> None:
    """Begin to stream and to watch the force, at `FORCE_RATE_S_S` or the nearest rate that the
    sensor has: `run.force.rate_S_s` from now on.

    Raises LimitError where that is less than `least_S_s`, which `what` needs; call it before any
    motion.
    """
    rates = run.bench.force_sensor.limits()["rate"]
    rate_S_s = run.stream_force(min(max(FORCE_RATE_S_S, rates.low), rates.high)).rate_S_s
    if rate_S_s < least_S_s:
        raise LimitError(
            f"force_sensor: it sends {rate_S_s:g} frames/s, and {what} needs {least_S_s:g} or more",
            "use a faster force sensor, or set this one to a higher rate",
        )


def come_close(
    run: Run, contact_N: float, window_s: float, every_s: float, known_clear: bool = False
) -> None:
    """Go to just above the earliest contact; a force of more than `contact_N` ends it.

    The force is the mean over `window_s`, taken every `every_s`; its limit is watched all the time.
    The way is quick only where it is `known_clear`, because z has gone it since the run was armed.
    """
    stage = run.bench.stage_z
    first_mm, _ = contact_range_mm(run.bench)
    speed_mm_s = travel_mm_s(stage)
    if not known_clear:
        speed_mm_s = min(speed_bound(run.bench, run.force.limit_N).speed_mm_s, speed_mm_s)
    torque = WayTorque(run)
    stage.start_move(first_mm - CLEAR_mm, speed_mm_s)
    while stage.moving():
        run.clock.sleep(every_s)
        force_N = felt_N(run, window_s)
        refuse_early_contact(run, force_N, contact_N)
        torque.refuse_rise(force_N)
    stage.stop()


def felt_N(run: Run, window_s: float) -> float:  # noqa: N802 - the unit keeps its capital
    """Return the mean force along z over the latest `window_s`, in N; what presses is positive."""
    return float(run.force.mean_N(window_s)[2])


def refuse_early_contact(run: Run, force_N: float, contact_N: float) -> None:
    """Stop z and raise InstrumentError where `force_N`, of either sign, is larger than `contact_N`:
    that means contact before there can be any."""
    if abs(force_N) <= contact_N:
        return
    stage = run.bench.stage_z
    stage.stop()
    raise InstrumentError(
        "stage_z",
        "approach",
        f"force_sensor reads {force_N:.2g} N at {stage.position_mm():.2f} mm, before any contact "
        f"can be (contact_from_mm = {contact_range_mm(run.bench)[0]:g} mm)",
        "check what is in the way, and that the force sensor reads no force where nothing touches; "
        "correct [fixture] if contact belongs there",
    )


def refuse_deeper(position_mm: float, deepest_mm: float) -> None:
    """Raise TripError, before z is ordered there, for a position below `deepest_mm`: what holds the
    force never goes deeper than where contact has to be felt at the latest."""
    if position_mm > deepest_mm + BOTTOM_mm:
        raise TripError(
            f"stage_z: the force would be held at {position_mm:.3f} mm, deeper than contact_to_mm "
            f"= {deepest_mm:g} mm",
            "check whether the object gives way and whether the force sensor reads what is "
            "pressed; correct contact_to_mm if z may go deeper",
        )


def nothing_felt(run: Run, force_N: float, contact_N: float, check: str) -> InstrumentError:
    """Return the error for a way to the latest contact on which no contact was felt. `check` names
    what to check."""
    return InstrumentError(
        "stage_z",
        "approach",
        f"no contact is felt down to {contact_range_mm(run.bench)[1]:g} mm (contact_to_mm): "
        f"force_sensor reads {force_N:.2g} N, contact means {contact_N:g} N",
        f"check that {check}, and that the sensor is not dead; correct [fixture]",
    )


class LateTargetsError(InstrumentError):
    """Raised for a z that has waited for its targets because its link or the computer is slow."""


def not_there(
    run: Run, within_s: float, target_every_s: float = 0.0, target_lasts_s: float = math.inf
) -> InstrumentError:
    """Return the error for a z that has not reached the latest contact, without contact, in more
    time than it needs. It has been given a target every `target_every_s` on average, each of which
    it reaches in `target_lasts_s`."""
    cause = (
        f"it is at {run.bench.stage_z.position_mm():.3f} mm after {within_s:.3g} s of approach "
        f"and did not reach {contact_range_mm(run.bench)[1]:g} mm (contact_to_mm)"
    )
    if target_every_s > target_lasts_s:
        return LateTargetsError(
            "stage_z",
            "approach",
            f"{cause}: it had to wait for its targets, which came every {target_every_s:.2g} s and "
            f"last {target_lasts_s:g} s",
            "its answers come late, or the computer is busy: check its connection, and end other "
            "programs; then start again",
        )
    return InstrumentError(
        "stage_z", "approach", cause, "check what blocks the stage; then start again"
    )
