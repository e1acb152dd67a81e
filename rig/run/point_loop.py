"""The loop over the points of a run, with the treatment of disturbed points.

a hold (pause, silent sensor)   the bench is made safe, the run waits until the condition has
                                passed, arms again and retakes the point; where the bench was
                                not made safe the run ends, and so it does after more holds than
                                the bench file allows
a trip (a limit was exceeded)   the bench is made safe, the run arms again and retakes the point
                                once; a second trip of the same point ends the run
an invalid reading              the point is retaken without arming, as often as the procedure's
                                `retries_of_invalid` allows; then it is recorded as invalid
what the procedure itself       the point is retaken without arming, at most `MOST_RETAKES` times
gives up (`RetakeError`)
anything else                   the point is discarded and the run ends
"""

from __future__ import annotations

import contextlib
import zlib
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

from rig.core.errors import ExitCode, LimitError, RigError, UnsafeError
from rig.run.arming import ShutdownFailure
from rig.run.holds import HOLD_OVER, ON_HOLD, PAUSE, HoldError
from rig.run.observers import HOLD, PAUSED, RUNNING
from rig.run.phases import RunPhase
from rig.run.points import Point, Reading, RetakeError, check_points, remedy
from rig.run.trip import TripError

if TYPE_CHECKING:
    from rig.run.parts import RunParts

HOLD_POLL_S = 0.1
"""Interval in s at which a run on hold checks whether it may continue."""

MOST_RETAKES = 10
"""Largest number of attempts at a point that its procedure may give up."""

SwitchOff = Callable[[bool], list[ShutdownFailure]]
"""Runs the shutdown actions and returns those that failed; with True the watchers stay on."""


class InvalidReadingError(RigError):
    """Raised for an invalid reading whose point will be retaken."""


class PointLoop:
    """Measures the points of a run, one after the other, including those that the procedure
    adds."""

    def __init__(self, parts: RunParts, switch_off: SwitchOff):
        """Add recorded points to the run's readings; `switch_off` makes the bench safe."""
        self._settings, self._run_number = parts.job.settings, parts.job.run_number
        self._procedure, self._run, self._recorder = parts.procedure, parts.run, parts.recorder
        self._readings, self._outcome = parts.readings, parts.outcome
        self._phases, self._stop, self._observers = parts.phases, parts.stop, parts.observers
        self._switch_off = switch_off
        self._points: tuple[Point, ...] = ()
        self._ahead: dict[str, float] = {}
        """Expected time of the point under way and of those behind it, for who follows the run."""
        self._tripped: set[str] = set()
        """Points that a trip has disturbed once."""

    def record_all(self, points: Sequence[Point]) -> None:
        """Measure the points that are not in the journal yet, then those that the procedure adds.

        Returns when all of them are recorded. Whatever ends the run is raised; the bench may be
        armed then.
        """
        self._points = tuple(points)
        self._outcome.points_done = len(self._readings)
        for point_id, reading in self._readings.items():  # an earlier attempt's warnings are gone
            self._note_invalid(point_id, reading)
        self._record_plan(self._procedure.refining_s())
        further = self._procedure.refine(self.readings())
        if further:
            check_points(further, self._run.bench, [p.id for p in self._points], self._settings)
            self._points += further
            self._outcome.points_planned = len(self._points)
            self._run.event("info", "refined", f"{len(further)} further points where it matters")
            self._record_plan()

    def readings(self) -> list[Reading]:
        """Return the readings so far, in the order of the plan."""
        return [self._readings[p.id] for p in self._points if p.id in self._readings]

    def _record_plan(self, refining_s: float = 0.0) -> None:
        """Measure the points that are planned; `refining_s` is what further ones will take."""
        remaining = [point for point in self._points if point.id not in self._readings]
        if not remaining:
            return
        armed = bool(self._run.arming.names)
        overhead_s = refining_s
        if not armed:
            overhead_s += self._procedure.overhead_s(self._run.bench.settings.fixture, False)
        self._observers.planned(self._points, set(self._readings), overhead_s)
        if not armed:
            self._observers.state(RUNNING)
            self._arm()
        ahead_s = sum(point.duration_s for point in remaining)
        for number, point in enumerate(remaining, 1):
            ahead_s -= point.duration_s
            self._ahead = {
                "expected_s": round(point.duration_s, 3),
                "ahead_s": round(max(0.0, ahead_s), 3),
                "points_ahead": len(remaining) - number,
                "of": len(self._points),
            }
            self._run.check_stop()
            self._stop.check_between_points(point.duration_s)
            reading = self._record(point)
            self._run.disturbances.at_point = 0
            self._readings[point.id] = reading
            self._outcome.points_done += 1
            self._observers.point_recorded(
                self._outcome.points_done, len(self._points), point, reading
            )
            if invalid := self._note_invalid(point.id, reading):
                self._observers.event("warning", invalid)

    def _note_invalid(self, point_id: str, reading: Reading) -> str:
        """Record that a reading is invalid, however the run ends; return that in words, "" for a
        valid one."""
        if not (why := self._procedure.why_invalid(reading)):
            return ""
        text = f"{point_id} is invalid: {why}"
        self._run.event("warning", "invalid", text)
        return text

    # --- one point, and what disturbs it ----------------------------------------------------------

    def _arm(self, point: Point | None = None) -> None:
        """Arm the bench, again for this point where one is given; after a hold, wait and arm it
        again. A trip meanwhile ends the run."""
        while True:
            self._run.holds.acknowledge()  # Arming deals with every hold so far.
            try:
                with (
                    self._phases.measuring(),
                    self._run.first_cause(),
                    self._phases.passing.first_raised(),
                ):
                    self._procedure.arm(self._run)
                return
            except HoldError as hold:
                self._wait_out(hold, "the arming of the bench" if point is None else point.id)

    def _record(self, point: Point) -> Reading:
        """Measure a point until it is recorded; see the module's table."""
        retries = self._procedure.retries_of_invalid()
        given_up = 0
        while True:
            try:
                with self._phases.measuring():
                    return self._take(point, discard_invalid=retries > 0)
            except HoldError as hold:
                self._wait_out(hold, point.id)
                self._arm(point)
            except TripError as trip:
                if point.id in self._tripped:
                    raise
                self._tripped.add(point.id)
                self._make_safe_after(trip, point)
                self._arm(point)
            except RetakeError as reason:
                given_up += 1
                if given_up > MOST_RETAKES:
                    raise RigError(
                        f"{point.id}: given up {given_up} times, the last time because "
                        f"{reason.message}",
                        reason.hint,
                        reason.code,
                    ) from reason
                given = f"{point.id}: an attempt was given up: {reason.message}"
                self._run.event("warning", "retake", given)
                self._observers.event("warning", f"{point.id}: {reason.message}; retaking it")
            except InvalidReadingError as invalid:
                retries -= 1
                repeated = f"{point.id}: an attempt was invalid: {invalid.message}"
                self._run.event("warning", "invalid", repeated)
                self._observers.event("warning", f"{point.id}: {invalid.message}; retaking it")

    def _take(self, point: Point, discard_invalid: bool) -> Reading:
        """Make one attempt at a point, from its first record in the journal to its last."""
        self._run.clock.announce(self._run_number, zlib.crc32(point.id.encode()))
        self._recorder.put_point_begin(point.id, {"time": self._run.elapsed_s(), **self._ahead})
        try:
            with self._run.first_cause(), self._naming(point):
                with self._phases.passing.first_raised():
                    reading = self._procedure.take(self._run, point)
                # Also notices a hold that began and ended within the last blocking call.
                self._run.check_watchers()
            if discard_invalid and (reason := self._procedure.why_invalid(reading)):
                raise InvalidReadingError(reason)
        except BaseException as error:
            with contextlib.suppress(RigError):  # The first cause is about to be raised.
                self._recorder.put_point_discard(point.id, str(error))
            raise
        self._recorder.put_point_keep(point.id, reading)
        return reading

    def _wait_out(self, hold: HoldError, where: str) -> None:
        """Make the bench safe, then wait until no hold is in force. The force is still read: that
        is how the end of its silence is seen. HoldLimitError after too many holds; `where` is the
        point that is disturbed, for its message."""
        asked_for = hold.message == PAUSE
        self._run.event("info" if asked_for else "warning", "hold", hold.message)
        self._observers.making_safe()
        failures = self._switch_off(True)
        if failures:
            reasons = "; ".join(f"{f.name}: {f.reason}" for f in failures)
            raise RigError(reasons, None, ExitCode.INSTRUMENT) from hold
        if self._run.ending.failures:
            raise _not_safe(self._run.ending.failures) from hold
        self._phases.enter(RunPhase.ON_HOLD)
        self._run.event("info", ON_HOLD, hold.message)
        if not asked_for:
            self._count(hold, where)
            self._observers.event(
                "warning", f"on hold: {hold.message}; the bench is safe and the run waits"
            )
        self._observers.state(PAUSED if asked_for else HOLD)
        begun_s = self._run.clock.now()
        try:
            self._run.check_stop()
            while self._run.holds.active:
                self._stop.check_between_points(0.0)  # no point is under way
                self._run.clock.sleep(HOLD_POLL_S)
                self._run.check_force_stream()
        finally:
            self._outcome.on_hold_s += self._run.clock.now() - begun_s
        self._phases.enter(RunPhase.READY)
        self._run.event("info", HOLD_OVER, "the run arms the bench again")
        self._observers.state(RUNNING)

    def _count(self, hold: HoldError, where: str) -> None:
        """Count a hold that no one has asked for, and end the run where there were too many."""
        found = self._run.disturbances
        found.begin_hold()
        self._observers.hold_begun(hold.message, found.holds, found.presses)
        found.check(where, hold.message)

    def _make_safe_after(self, trip: TripError, point: Point) -> None:
        """Make the bench safe. Raises the trip if that failed: an object that may still be under
        force must not be pressed again."""
        self._run.event("error", "trip", trip.one_line())
        self._observers.making_safe()
        if self._switch_off(False) or self._run.ending.failures:
            raise trip
        self._phases.enter(RunPhase.READY)
        self._observers.event("warning", f"{trip.one_line()}; retaking point {point.id} once")
        self._run.check_stop()
        self._observers.state(RUNNING)

    @contextlib.contextmanager
    def _naming(self, point: Point) -> Iterator[None]:
        """Add the point's id to the refusal of a value that the point has computed."""
        try:
            yield
        except TripError:
            raise
        except LimitError as refused:
            hint = remedy(refused, self._run.bench)
            raise LimitError(f"point {point.id}: {refused.message}", hint) from refused


def _not_safe(failures: Sequence[RigError]) -> RigError:
    """Return why a run does not continue after a hold during which making safe has failed.

    That is UnsafeError in the words of the failure, since an object may still be under force and no
    other attempt follows. A trip alone keeps its exit code: the way back was completed after it.
    """
    for failure in failures:
        if not isinstance(failure, TripError):
            return UnsafeError(failure.message, failure.hint)
    return failures[0]
