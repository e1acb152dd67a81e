"""The way of z off what is pressed, the same in every procedure and at every exit.

The stage is stopped, moved away if its drive still can, and what the force sensor reads afterwards
is judged. Where an instrument does not answer, what is known is said at once: where z was last seen
and what is pressed.
"""

from __future__ import annotations

import contextlib
import math
from typing import TYPE_CHECKING

from procedures.pressed.approach.way_down import BOTTOM_mm, travel_mm_s
from rig.bench.clear_of_contact import PRESSED_N
from rig.core.errors import (
    InstrumentError,
    InstrumentLinkError,
    InstrumentTimeoutError,
    UnsafeError,
    WrongPositionError,
)
from rig.instruments.roles import LastSeen, LinearStage, RemembersPosition

if TYPE_CHECKING:
    from rig.run.context import Run

SETTLED_S = 0.1
"""Time in s from the end of the way back until the force is judged, and the length of the force
record that is judged."""
UNLOAD_DEADLINE_S = 20.0
"""Longest time in s that the way off the object may take, in addition to that for z's travel."""


def unload_deadline_s(run: Run) -> float:
    """Return the longest time in s that the way off the object may take, however slow z is and
    wherever it stands."""
    stage = run.bench.stage_z
    travel = stage.limits()["position"]
    return UNLOAD_DEADLINE_S + (travel.high - travel.low) / travel_mm_s(stage)


def unload(run: Run, pressed: str, came_from_mm: float) -> None:
    """Stop z, whatever happens; then move it away from what is pressed, if the drive still can.

    It never goes deeper than it stands. Where the parking position lies deeper, it goes back to
    `came_from_mm`, from where it set out to park, or stays where it is if that lies deeper, too.

    Where a watcher stops z on the way, the reason is recorded and the way continues, once. So does
    it where one answer was lost or spoilt, and where the drive has stopped by its own communication
    time-out: that fault is acknowledged over a new connection. A drive that cannot be moved even
    then raises UnsafeError. A drive that has another fault, has lost its place or does not act
    stands where it is, and the run has failed (exit 3), or UnsafeError is raised where the force is
    over the limit that was watched. What the stop itself raises is raised: then the bench is not
    safe. A force that remains afterwards fails the run; one over the limit that was watched raises
    UnsafeError.
    """
    stage = run.bench.stage_z
    say_if_lost(run)
    stop_z(run)
    timed_out = False
    lost = ""
    try:
        try:
            _go_clear(run, came_from_mm)
        except InstrumentError as error:
            if isinstance(error, InstrumentTimeoutError):
                _say_not_reached(run, error)
            trip = run.tripped()
            timed_out = stage.acknowledge_timeout()
            if isinstance(error, InstrumentTimeoutError | InstrumentLinkError):
                lost = error.one_line()
            if trip is None and not timed_out and not lost:
                raise
            if trip is not None:
                run.ending.fail(trip)
            stop_z(run)
            _go_clear(run, came_from_mm)
        where = _where(run)
        if timed_out:
            run.event(
                "warning",
                "drive-timed-out",
                f"stage_z had stopped by its own communication time-out; the fault was "
                f"acknowledged and the {pressed} lifted: z is {where}",
            )
        elif lost:
            run.event(
                "warning",
                "answer-lost",
                f"on the way up: {lost}; it was asked again and the {pressed} lifted: z is {where}",
            )
    except InstrumentError as error:
        if timed_out:
            raise _still_pressed(run, pressed, error) from error
        stop_z(run)  # one answer lost on the way does not stop it
        force_N = run.force_from_now_N(SETTLED_S)
        what = (
            f"the stage has stopped and the {pressed} may still be pressed: {error.one_line()}; "
            f"{_read_by_the_sensor(force_N)}"
        )
        hint = "check the stage; then start again, or move it away by hand"
        if force_N is not None and force_N > run.force.limit_N:
            raise UnsafeError(f"stage_z: unload: {what}, over the limit", hint) from error
        failure = InstrumentError("stage_z", "unload", what, hint)
        run.ending.fail(failure, f"the {pressed} may still be pressed")
        return
    _judge_what_remains(run, pressed, where)


def _where(run: Run) -> str:
    """Return where z stands, in words; a position that cannot be right fails the run."""
    try:
        return f"at {run.bench.stage_z.position_mm():.3f} mm"
    except WrongPositionError as error:
        run.ending.fail(error, "it is not known where stage_z is")
        return f"where its driver does not say ({error.cause})"


def stop_z(run: Run) -> None:
    """Stop z; one answer that is lost or spoilt is asked for again. Raises InstrumentError where z
    has not answered the second time.

    Where it does not answer in time, or not twice, that is said at once, with where it was last
    seen and what is pressed: nothing says more until the guard has tried in vain, seconds later.
    The exception of the second stop says so, too.
    """
    stage = run.bench.stage_z
    try:
        stage.stop()
        return
    except InstrumentTimeoutError as error:
        _say_not_reached(run, error)
    except InstrumentError:
        pass
    try:
        stage.stop()
    except InstrumentError as error:
        _say_not_reached(run, error)
        cause = f"{error.cause}; {_last_known(run)}"
        raise InstrumentError(error.device, error.command, cause, error.hint) from error


def say_if_lost(run: Run) -> None:
    """Say at once, before it is tried again, where z was last seen and what is pressed if the run
    has ended because z, or an instrument on its line, did not answer."""
    if "stage_z" in run.ending.silent:
        _say_not_reached(run, run.ending.lost[0])


def _say_not_reached(run: Run, error: InstrumentError) -> None:
    run.ending.say_not_safe(
        f"not safe yet: stage_z: {error.command}: {error.cause}; {_last_known(run)}; it is asked "
        "again. An e-stop on the drives' power needs no answer"
    )


def _last_known(run: Run) -> str:
    """Return in words where z was last seen and what the force sensor reads; asks z nothing."""
    seen = _last_seen(run.bench.stage_z)
    where = "its position is not known"
    if seen is not None:
        now_s = run.clock.now()
        where = (
            f"stage_z has not answered for {now_s - seen.answered_s:.1f} s and was last seen at "
            f"{seen.position_mm:.3f} mm, {now_s - seen.seen_s:.1f} s ago"
        )
    return f"{where}, and {_read_by_the_sensor(run.latest_force_N(SETTLED_S))}"


def _last_seen(stage: LinearStage) -> LastSeen | None:
    try:
        seen = stage.last_seen() if isinstance(stage, RemembersPosition) else None
        return seen if seen is not None and all(map(math.isfinite, seen)) else None
    except Exception:  # noqa: BLE001 - a driver of another package; the stop that follows matters
        return None


def _still_pressed(run: Run, pressed: str, error: InstrumentError) -> UnsafeError:
    """Return the error for a drive that timed out and cannot be moved after that: where z is
    and what the force sensor reads, as far as both answer."""
    where = ""
    with contextlib.suppress(InstrumentError):
        where = f" and is at {run.bench.stage_z.position_mm():.3f} mm"
    how_hard = _read_by_the_sensor(run.force_from_now_N(SETTLED_S))
    return UnsafeError(
        f"stage_z: unload: it stopped by its own communication time-out{where}; the "
        f"{pressed} may still be pressed, {how_hard}: {error.one_line()}",
        "move the stage away by hand; then run: rig make-safe",
    )


def _read_by_the_sensor(force_N: float | None) -> str:
    """Return in words what the force sensor reads."""
    if force_N is None:
        return "the force is not known"
    return f"force_sensor reads {force_N:.3g} N"


def _go_clear(run: Run, came_from_mm: float) -> None:
    """Move z to its parking position, or back to where it came from; never deeper than it stands.

    Where a driver does not return a number, z goes to the higher of these two places: it has been
    above neither since it set out to park. A number that cannot be right is what the drive goes by
    as well, so it decides as any other.
    """
    stage = run.bench.stage_z
    try:
        stands_mm = stage.position_mm()
    except WrongPositionError as error:
        stands_mm = error.position
        if math.isnan(stands_mm):
            if not stage.homed():
                raise
            parked_mm = run.bench.settings.fixture.parked_mm
            target_mm = max(min(came_from_mm, parked_mm), stage.limits()["position"].low)
            stage.move_to(target_mm, travel_mm_s(stage))
            return
    target_mm = run.bench.settings.fixture.parked_mm
    if target_mm > stands_mm + BOTTOM_mm:
        lowest_mm = stage.limits()["position"].low
        target_mm = max(min(came_from_mm, stands_mm), lowest_mm)
    if target_mm <= stands_mm + BOTTOM_mm:
        stage.move_to(target_mm, travel_mm_s(stage))


def _judge_what_remains(run: Run, pressed: str, where: str) -> None:
    """Fail the run where z has gone as far as it can and the force sensor still reads a force.

    A sensor that has not been zeroed reads its own zero as well: then the limit alone is judged,
    as it is by the watcher.
    """
    run.clock.sleep(SETTLED_S)
    force_N = run.force_from_now_N(SETTLED_S)
    if force_N is None:
        # Frames that are late, as after a suspension of the computer, end no stream by themselves.
        unknown = f"it is not known whether the {pressed} is still pressed"
        run.ending.doubt(
            unknown,
            f"force_sensor sends nothing, or late, after the way up: z is {where}, and {unknown}; "
            "look before you go near it",
        )
        return
    limit_N = run.force.limit_N
    if force_N <= (min(PRESSED_N, limit_N) if run.force.tared else limit_N):
        return
    finding = f"the {pressed} is still pressed with {force_N:.3g} N {where}"
    hint = (
        "check what presses; move the stage away by hand. Where nothing presses, the force "
        "sensor's zero has moved"
    )
    if force_N > limit_N:
        raise UnsafeError(f"stage_z: unload: {finding}, over the limit of {limit_N:g} N", hint)
    failure = InstrumentError("stage_z", "unload", finding, hint)
    run.ending.fail(failure, f"the {pressed} is still pressed with {force_N:.3g} N")
