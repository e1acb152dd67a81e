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
from collections.abc import Iterator
from typing import Protocol

from rig import bench as benches
from rig.bench import Bench, BenchPlan
from rig.clock import Clock
from rig.errors import ExitCode, RigError
from rig.recording.compiled import compile_run
from rig.recording.recorder import Recorder
from rig.runner.guard import GuardLink
from rig.runner.jobs import Job, Journal
from rig.runner.outcome import Outcome
from rig.runner.points import Point, Reading, check_points
from rig.runner.run import Run
from rig.runner.stopping import StopFlag, StopRequestedError
from rig.runner.trip import TripError

BEAT_EVERY_S = 0.2


class Reporter(Protocol):
    """Where a run's progress goes: the command line, or nowhere."""

    def planned(self, points: tuple[Point, ...], kept: set[str]) -> None:
        """The run has these points, of which some were kept by an earlier attempt."""
        ...

    def point_kept(self, number: int, total: int, point: Point, reading: Reading) -> None:
        """Point `number` of `total` is in the journal."""
        ...

    def event(self, level: str, message: str) -> None:
        """Something a person should see now."""
        ...


def execute(job: Job, plan: BenchPlan, clock: Clock, stop: StopFlag, reporter: Reporter) -> Outcome:
    """Run a job on a bench from connecting to the compiled file. Never raises a RigError: what
    went wrong is in the outcome."""
    outcome = Outcome("failed", ExitCode.INTERNAL)
    try:
        stop.check()
        bench = benches.connect(plan, clock)
    except RigError as error:
        clock.close()
        return _failed(outcome, error)
    outcome.simulated = bench.simulated
    with contextlib.closing(bench):
        try:
            points = job.procedure.points(job.settings)
            outcome.points_planned = len(points)
            bench.require_fixture(*job.procedure.FIXTURES)
            check_points(points, bench)
            stop.check()
            journal = job.open_journal(bench, points)
        except RigError as error:
            return _failed(outcome, error)
        _Loop(job, bench, points, journal, stop, reporter, outcome).go()
    return outcome


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
        self.guard = GuardLink(bench.plan, journal.path, job.guard_report(bench, journal))
        self.run = Run(job.settings, bench, self.recorder, journal.stream_index, journal.elapsed_s)
        self.readings = dict(journal.kept)
        self._last_beat = 0.0
        self._begun_s = bench.clock.now()

    def go(self) -> None:
        """Take the points, then safe, data, report."""
        unregister = self.bench.clock.each_slice(self._each_slice)
        try:
            self._take_all()
            self.outcome.status, self.outcome.code = "complete", ExitCode.DONE
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
            self.outcome.guard_report = self.guard.take_over()
        else:
            self.guard.done()

    def _each_slice(self) -> None:
        """What every wait looks at, before every slice of at most 20 ms."""
        now = time.monotonic()
        if now - self._last_beat >= BEAT_EVERY_S:
            self._last_beat = now
            self.guard.beat()
        self.recorder.check()
        self.stop.check()

    def _take_all(self) -> None:
        self.outcome.points_done = len(self.readings)
        self.reporter.planned(self.points, set(self.readings))
        remaining = [point for point in self.points if point.id not in self.readings]
        if not remaining:
            return
        self.job.procedure.arm(self.run)
        for point in remaining:
            self.run.check_stop()
            self.readings[point.id] = reading = self._take_or_retake(point)
            self.outcome.points_done += 1
            self.reporter.point_kept(self.outcome.points_done, len(self.points), point, reading)

    def _take_or_retake(self, point: Point) -> Reading:
        try:
            return self._take(point)
        except TripError as trip:
            self.run.event("error", "trip", trip.one_line())
            self.reporter.event("warning", f"{trip.one_line()}; retaking point {point.id} once")
            failures = self.run.arming.make_safe(self.guard.beat)
            if failures:
                raise
        self.job.procedure.arm(self.run)
        return self._take(point)

    def _take(self, point: Point) -> Reading:
        self.bench.clock.announce(self.job.run_number, zlib.crc32(point.id.encode()))
        self.recorder.put_point_begin(point.id, {"time": self.run.elapsed_s()})
        try:
            reading = self.job.procedure.take(self.run, point)
        except BaseException as error:
            with contextlib.suppress(RigError):  # the first cause is on its way
                self.recorder.put_point_discard(point.id, str(error))
            raise
        self.recorder.put_point_keep(point.id, reading)
        return reading

    def _make_safe(self) -> None:
        self.outcome.duration_s = self.bench.clock.now() - self._begun_s
        armed = self.run.arming.names
        self.outcome.off_failures = self.run.arming.make_safe(self.guard.beat)
        failed = {failure.name for failure in self.outcome.off_failures}
        self.outcome.switched_off = tuple(name for name in armed if name not in failed)
        if failed:
            self.outcome.code = ExitCode.UNSAFE
            self.outcome.status = "failed"
        else:
            self.guard.safe()
        with contextlib.suppress(RigError):  # a failed recorder is reported by _finish_data
            for failure in self.outcome.off_failures:
                self.run.event("error", "off-failed", f"{failure.name}: {failure.reason}")

    def _finish_data(self) -> None:
        outcome = self.outcome
        outcome.warnings = list(self.run.warnings)
        with self._storing():
            for failure in outcome.failures:
                self.run.event("error", type(failure).__name__, failure.one_line())
            self.recorder.put_end(self.journal.end(outcome, self.run.elapsed_s()))
        with self._storing():
            self.recorder.close()
        with self._storing():
            outcome.file = compile_run(self.journal.path, retire=True)
        if self.journal.path.exists():
            outcome.journal = self.journal.path
        in_order = [self.readings[p.id] for p in self.points if p.id in self.readings]
        outcome.summary = self.job.procedure.summarise(self.job.settings, in_order)

    @contextlib.contextmanager
    def _storing(self) -> Iterator[None]:
        """One step of keeping the data; its failure is told and does not stop the next step."""
        try:
            yield
        except RigError as error:
            self._data_failed(error)
        except OSError as error:
            hint = f"free the disk, then run: rig recover {self.journal.path}"
            self._data_failed(RigError(f"cannot write the run file: {error}", hint))

    def _data_failed(self, error: RigError) -> None:
        """The first cause keeps its place; a storage error follows it unless it is the cause."""
        if all(error.message != known.message for known in self.outcome.failures):
            self.outcome.failures.append(error)
        if self.outcome.code == ExitCode.DONE:
            self.outcome.code = error.code
        self.outcome.status = "failed"


def _failed(outcome: Outcome, error: RigError) -> Outcome:
    outcome.status = "stopped" if isinstance(error, StopRequestedError) else "failed"
    outcome.code = error.code
    outcome.failures.append(error)
    return outcome


def _internal(error: Exception) -> RigError:
    wrapped = RigError(
        f"internal error: {type(error).__name__}: {error}",
        "this is a defect of the program: run again with --debug and report the traceback",
    )
    wrapped.__cause__ = error
    return wrapped
