"""The execution of a job: the loop around the procedure, and what follows at every exit.

States: connecting -> checked -> recording -> armed, taking points -> safe -> compiled -> reported.
Whatever ends it, the order at the exit is the same: safe first, data second, report third. The
procedure runs in the main thread, so that a signal's flag is seen at its next wait; the recorder
and the stream readers have threads of their own, whose failures surface at the same place.
"""

from __future__ import annotations

import contextlib
import time
import zlib
from collections.abc import Callable, Iterator
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Protocol, TypeVar

from rig.bench import bench as benches
from rig.bench.bench import Bench, BenchPlan
from rig.core.clock import Clock
from rig.core.errors import ExitCode, LimitError, RigError
from rig.files.journal.reader import read_journal
from rig.files.journal.recorder import Recorder
from rig.files.runfile.compile import compile_run
from rig.run.arming import BEAT_EVERY_S, OffFailure
from rig.run.context import Run
from rig.run.guard import GuardLink
from rig.run.holds import PAUSE, HoldError, PauseSwitch
from rig.run.job import Job, Journal
from rig.run.outcome import Outcome
from rig.run.points import Point, Reading, check_points, require_roles
from rig.run.stopping import StopFlag, StopRequestedError
from rig.run.trip import TripError

HOLD_LOOK_S = 0.1
"""How often a run on hold looks whether it may go on."""

T = TypeVar("T")


class Reporter(Protocol):
    """Where a run's progress goes: the command line, or nowhere."""

    def planned(self, points: tuple[Point, ...], kept: set[str], overhead_s: float) -> None:
        """The run has these points, of which some were kept by an earlier attempt; bench time
        that goes into making ready and parking."""
        ...

    def point_kept(self, number: int, total: int, point: Point, reading: Reading) -> None:
        """Point `number` of `total` is in the journal."""
        ...

    def event(self, level: str, message: str) -> None:
        """Something a person should see now."""
        ...

    def state(self, name: str) -> None:
        """The run is "paused" (by the operator) or "held" (by a condition that passes), both with
        the bench safe; or it is "running" again."""
        ...

    def storing(self) -> None:
        """The bench is safe; the data are being brought into their file."""
        ...

    def stored(self, run_file: Path) -> None:
        """They are there."""
        ...


def execute(job: Job, plan: BenchPlan, clock: Clock, stop: StopFlag, reporter: Reporter) -> Outcome:
    """Run a job on a bench from connecting to the compiled file. Never raises a RigError: what
    went wrong is in the outcome."""
    outcome = Outcome("failed", ExitCode.INTERNAL)
    outcome.simulated = plan.settings.simulation is not None
    getattr(job.procedure, "import_ahead", lambda: None)()
    try:
        plan = plan.require_fixture(*job.procedure.FIXTURES)
        points = job.procedure.points(job.settings)
        outcome.points_done = len(job.kept)
        outcome.points_planned = len({point.id for point in points} | job.kept.keys())
        require_roles(points, plan)
        bench = benches.connect(plan, clock, stop.check)
    except RigError as error:
        clock.close()
        return _failed(outcome, error)
    outcome.simulated = bench.simulated
    with contextlib.closing(bench):
        try:
            now = datetime.now().astimezone()
            job.calibrations, warnings = benches.apply_calibrations(bench, now, job.allow_expired)
            check_points(points, bench)
            getattr(job.procedure, "check", lambda *_: None)(job.settings, bench)
            stop.check()
            journal = job.open_journal(bench, points)
        except RigError as error:
            return _failed(outcome, error)
        loop = _Loop(job, bench, points, journal, stop, reporter, outcome)
        for warning in warnings:
            loop.run.event("warning", "calibration", warning)
        for line in plan.stand_ins:
            loop.run.event("warning", "stand-in", line)
        loop.go()
    return outcome


class _InvalidError(RigError):
    """A reading does not count."""


class _Loop:
    """The part of a run that has a journal."""

    def __init__(
        self,
        job: Job,
        bench: Bench,
        points: tuple[Point, ...],
        journal: Journal,
        stop: StopFlag,
        reporter: Reporter,
        outcome: Outcome,
    ):
        self.job, self.bench, self.points, self.journal = job, bench, points, journal
        self.stop, self.reporter, self.outcome = stop, reporter, outcome
        self.recorder = Recorder(journal.writer)
        held = job.held
        if job.lock is not None:
            job.lock.tell_run(journal.path)
            held += job.lock.files
        self.guard = GuardLink(bench.plan, journal.path, job.guard_report(bench, journal), held)
        self.readings = dict(journal.kept)
        self.run = Run(
            job.settings,
            bench,
            self.recorder,
            journal.stream_index,
            journal.elapsed_s,
            self.readings,
        )
        self._taking = False
        self._making_safe = False
        self._tripped: set[str] = set()
        """Points that a trip has disturbed: each is retaken once."""
        self._spare = False
        """Whether a reading that does not count is discarded: its point is taken again."""
        self._last_beat = 0.0
        self._guard_missed = False
        self._begun_s = bench.clock.now()

    def go(self) -> None:
        """Take the points, then safe, data, report."""
        unregister = self.bench.clock.each_slice(self._each_slice)
        self.bench.clock.while_computing(self.guard.beat)
        try:
            with PauseSwitch(self.run.holds):
                self._take_all()
            self.outcome.status, self.outcome.code = "complete", self._judged()
        except StopRequestedError as stopped:
            self.outcome.status, self.outcome.code = "stopped", stopped.code
            self.outcome.failures.append(stopped)
        except RigError as error:
            _failed(self.outcome, error)
        except Exception as error:  # noqa: BLE001 - a bug ends a run as safely as anything else
            _failed(self.outcome, _internal(error))
        finally:
            unregister()
            self._make_safe()
        self._finish_data()
        if self.outcome.off_failures:
            self.outcome.taken_over = self.guard.take_over()
        else:
            self.guard.done()

    def _judged(self) -> ExitCode:
        """Whether every reading that was kept counts; those that do not are told."""
        doubtful = {name: why for name, r in self.readings.items() if (why := self._invalid(r))}
        for name, why in doubtful.items():
            self.run.event("warning", "invalid", f"{name} does not count: {why}")
        return ExitCode.FINISHED_WITH_FAILURES if doubtful else ExitCode.DONE

    def _each_slice(self) -> None:
        """What every wait looks at, before every slice of at most 20 ms; while the bench is made
        safe nothing ends a wait."""
        now = time.monotonic()
        due = now - self._last_beat >= BEAT_EVERY_S
        if due:
            self._last_beat = now
            self.guard.beat()
        if self._making_safe:
            return
        if due:
            self._miss_guard()
        self.recorder.check()
        self.stop.check()
        if self._taking:
            self.run.check_watchers()

    def _miss_guard(self) -> None:
        """A run goes on without its guard rather than fail, and says so, once."""
        if self.guard.lost and not self._guard_missed:
            self._guard_missed = True
            text = "the guard has died: if this run dies as well, nobody makes the bench safe"
            self.run.event("warning", "guard", text)
            self.reporter.event("warning", text)

    def _take_all(self) -> None:
        self.outcome.points_done = len(self.readings)
        self._take_plan(self.points)
        refine = getattr(self.job.procedure, "refine", None)
        if refine is None:
            return
        further = tuple(refine(self.job.settings, self._in_order()))
        if further:
            check_points(further, self.bench, (point.id for point in self.points))
            self.points += further
            self.outcome.points_planned = len(self.points)
            self.run.event("info", "refined", f"{len(further)} further points where it matters")
            self._take_plan(self.points)

    def _take_plan(self, points: tuple[Point, ...]) -> None:
        remaining = [point for point in points if point.id not in self.readings]
        if not remaining:
            return
        armed = bool(self.run.arming.names)
        self.reporter.planned(points, set(self.readings), 0.0 if armed else self._overhead_s())
        if not armed:
            self._disturbable(self._arm)
        for point in remaining:
            self.run.check_stop()
            self.stop.check_between_points()
            reading = self._disturbable(partial(self._take_valid, point))
            self.readings[point.id] = reading
            self.outcome.points_done += 1
            self.reporter.point_kept(self.outcome.points_done, len(points), point, reading)

    def _overhead_s(self) -> float:
        told = getattr(self.job.procedure, "overhead_s", None)
        fixture = self.bench.settings.fixture
        return float(told(self.job.settings, fixture, False)) if told else 0.0

    def _arm(self) -> None:
        with self.run.first_cause():
            self.job.procedure.arm(self.run)

    def _disturbable(self, act: Callable[[], T]) -> T:
        """Do it; after a hold, when the bench is armed again, do it anew."""
        again = False
        while True:
            self.run.holds.acknowledge()
            self._taking = True
            try:
                if again and act != self._arm:
                    self._arm()
                return act()
            except HoldError as hold:
                self._taking = False
                self._wait_out(hold)
                again = True
            finally:
                self._taking = False

    def _wait_out(self, hold: HoldError) -> None:
        """Safe first; then wait until no hold is in force. The force is read on meanwhile: that
        is how the end of its silence is seen."""
        self.run.event("warning", "hold", hold.message)
        failures = self._switch_off(watch_on=True)
        if failures:
            reasons = "; ".join(f"{f.name}: {f.reason}" for f in failures)
            raise RigError(reasons, None, ExitCode.INSTRUMENT) from hold
        self.reporter.event("warning", f"hold: {hold.message}; the bench is safe")
        self.reporter.state("paused" if hold.message == PAUSE else "held")
        self.run.check_stop()
        while self.run.holds.active:
            self.bench.clock.sleep(HOLD_LOOK_S)
            self.run.check_force_stream()
        self.reporter.event("info", "going on")
        self.reporter.state("running")

    def _switch_off(self, watch_on: bool = False) -> list[OffFailure]:
        """Run the offs, undisturbed by stop requests, drives and threads that fail meanwhile."""
        self._making_safe = True
        try:
            with self.bench.keep_alives.while_making_safe(self.bench.clock):
                return self.run.arming.make_safe(self.guard.beat, watch_on)
        finally:
            self._making_safe = False

    def _take_valid(self, point: Point) -> Reading:
        """Take it, and again where it does not count, as often as the settings say."""
        for again in range(getattr(self.job.settings, "retry_invalid", 0), -1, -1):
            self._spare = again > 0
            try:
                return self._take_or_retake(point)
            except _InvalidError as invalid:
                self.run.event("warning", "invalid", f"{point.id}: {invalid.message}")
                self.reporter.event("warning", f"{point.id}: {invalid.message}; taken again")
        raise AssertionError("the last attempt is kept, valid or not")

    def _invalid(self, reading: Reading) -> str:
        """Why a reading does not count; empty where it does."""
        judge = getattr(self.job.procedure, "invalid", None)
        return "" if judge is None else str(judge(self.job.settings, reading))

    def _take_or_retake(self, point: Point) -> Reading:
        try:
            return self._take(point)
        except TripError as trip:
            if point.id in self._tripped:
                raise
            self._tripped.add(point.id)
            self.run.event("error", "trip", trip.one_line())
            self.reporter.event("warning", f"{trip.one_line()}; retaking point {point.id} once")
            self._taking = False  # watchers are not looked at: the bench is being made safe
            if self._switch_off() or self.run.failures:  # what may still be pressed is left alone
                raise
            self.run.check_stop()
        self._taking = True
        self._arm()
        return self._take(point)

    def _in_order(self) -> list[Reading]:
        return [self.readings[p.id] for p in self.points if p.id in self.readings]

    def _take(self, point: Point) -> Reading:
        self.bench.clock.announce(self.job.run_number, zlib.crc32(point.id.encode()))
        self.recorder.put_point_begin(point.id, {"time": self.run.elapsed_s()})
        try:
            with self.run.first_cause(), _naming(point):
                reading = self.job.procedure.take(self.run, point)
                self.run.check_watchers()  # also what came and went within its last blocking call
            if self._spare and (reason := self._invalid(reading)):
                raise _InvalidError(reason)
        except BaseException as error:
            with contextlib.suppress(RigError):  # the first cause is on its way
                self.recorder.put_point_discard(point.id, str(error))
            raise
        self.recorder.put_point_keep(point.id, reading)
        return reading

    def _make_safe(self) -> None:
        armed = self.run.arming.names
        failures = self._switch_off()
        self.outcome.duration_s = self.bench.clock.now() - self._begun_s
        failed = {failure.name for failure in failures}
        self.outcome.switched_off = tuple(name for name in armed if name not in failed)
        self.outcome.off_failures = [failure for failure in failures if not failure.watches]
        for failure in failures:
            if failure.watches:
                error = RigError(f"{failure.name}: {failure.reason}", None, ExitCode.INSTRUMENT)
                self._failed_late(error)
        for error in self.run.failures:
            if not self.outcome.failures:
                self._failed_late(error)
            else:  # the cause is told already: this is what came of it
                self.outcome.warnings.append(error.one_line())
        if self.outcome.off_failures:
            self.outcome.code = ExitCode.UNSAFE
            self.outcome.status = "failed"
        else:
            self.guard.safe()
        with contextlib.suppress(RigError):  # a failed recorder is reported by _finish_data
            for failure in self.outcome.off_failures:
                self.run.event("error", "off-failed", f"{failure.name}: {failure.reason}")

    def _finish_data(self) -> None:
        outcome = self.outcome
        compiled = self.job.compiled or outcome.status != "complete"
        if outcome.points_done and compiled:
            self.reporter.storing()
        outcome.warnings = self.run.warnings + outcome.warnings
        with self._storing():
            for failure in outcome.failures:
                if failure in self.run.failures:
                    continue  # it is in the journal
                self.run.event("error", type(failure).__name__, failure.one_line())
            self.recorder.put_end(self.journal.end(outcome, self.run.elapsed_s()))
        with self._storing():
            self.recorder.close()
        if outcome.status == "failed":
            self._count_what_is_kept()
        if compiled:
            with self._storing():
                outcome.file = compile_run(self.journal.path, retire=True)
                if outcome.points_done:
                    self.reporter.stored(outcome.file)
        if self.journal.path.exists():
            outcome.journal = self.journal.path
        outcome.summary = self.job.procedure.summarise(self.job.settings, self._in_order())

    def _count_what_is_kept(self) -> None:
        """Where the disk failed, only the points that the journal holds have been kept."""
        with contextlib.suppress(RigError, OSError):
            kept = {point.id for point in read_journal(self.journal.path).kept()}
            for lost in self.readings.keys() - kept:
                del self.readings[lost]
            self.outcome.points_done = len(self.readings)

    @contextlib.contextmanager
    def _storing(self) -> Iterator[None]:
        """One step of keeping the data; its failure is told and does not stop the next step."""
        try:
            yield
        except RigError as error:
            self._failed_late(error)
        except OSError as error:
            hint = f"free the disk, then run: rig recover {self.journal.path}"
            self._failed_late(RigError(f"cannot write the run file: {error}", hint))

    def _failed_late(self, error: RigError) -> None:
        """The first cause keeps its place; what fails after it follows, unless it is the cause."""
        if all(error.message != known.message for known in self.outcome.failures):
            self.outcome.failures.append(error)
        if self.outcome.code == ExitCode.DONE:
            self.outcome.code = error.code
        self.outcome.status = "failed"


def _failed(outcome: Outcome, error: RigError) -> Outcome:
    outcome.status = "stopped" if isinstance(error, StopRequestedError) else "failed"
    outcome.code = error.code
    outcome.failures.extend(error.parts())
    return outcome


@contextlib.contextmanager
def _naming(point: Point) -> Iterator[None]:
    """A value that a point has computed and that a limit refuses is told with the point's id."""
    try:
        yield
    except TripError:
        raise
    except LimitError as refused:
        raise LimitError(f"point {point.id}: {refused.message}", refused.hint) from refused


def _internal(error: Exception) -> RigError:
    wrapped = RigError(
        f"internal error: {type(error).__name__}: {error}",
        "this is a defect of the program: run again with --debug and report the traceback",
    )
    wrapped.__cause__ = error
    return wrapped
