"""The execution of a job, from connecting to the run file.

    execute      connect, check the bench and the plan, open the journal
    PointLoop    arm the bench and record the points (`rig.run.point_loop`)
    WaitChecks   what is looked at in every wait meanwhile (`rig.run.wait_checks`)
    _Execution   around the loop: at every exit safe first, data second, report third
    RunSaving    the data (`rig.run.saving`)

The procedure is called from the thread that calls `execute`, and so are its ticks. Other threads
write the journal, read the force sensor and the contacts, talk on each link and run each shutdown
action, so that one that hangs holds up no other (docs/architecture.md has all of them). Their
failures, stop requests, trips and holds surface in the procedure's next wait; `rig.run.phases` says
which of them in which phase.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import threading
from datetime import datetime

from rig.bench.apply_calibrations import apply_calibrations
from rig.bench.connect import by_link, connect
from rig.bench.connected import Bench
from rig.bench.plan import BenchPlan
from rig.control.tick_loop import TooSlowError
from rig.core.clock import Clock
from rig.core.errors import ExitCode, InstrumentTimeoutError, RigError
from rig.core.threads import start_thread
from rig.files.journal.recorder import Recorder
from rig.run.arming import ShutdownFailure, Task
from rig.run.checked_procedure import (
    CheckedProcedure,
    ProcedureFaultError,
    UnexpectedFaultError,
    driver_fault,
    internal,
)
from rig.run.context import Run
from rig.run.hang_watch import HangWatch
from rig.run.holds import HoldError, PauseSwitch
from rig.run.interlocks.proof import prove
from rig.run.interlocks.store import InterlockStore
from rig.run.interlocks.watch import InterlockError
from rig.run.job import Journal, RunJob
from rig.run.locks.bench_mark import BenchMarks
from rig.run.making_safe.guard_link import GuardLink
from rig.run.observers import Observers, RunObserver
from rig.run.outcome import RunOutcome
from rig.run.parts import RunParts
from rig.run.passing import KeptBackError
from rig.run.phases import Phases, RunPhase
from rig.run.point_loop import PointLoop
from rig.run.points import Point, check_points, require_roles
from rig.run.press_references import PressReferences
from rig.run.saving import RunSaving
from rig.run.stopping import StopFlag, StopRequestedError
from rig.run.wait_checks import WaitChecks

log = logging.getLogger("rig")

BARRIER_S = 1.0
"""Longest wall time in s that the journal may take before a run leaves its bench to the guard."""
NOT_IN_REAL_TIME = (
    "a simulated bench that the command starts for itself, without --bench and bench.toml, waits "
    "for the computer"
)
"""What helps where the computer is too slow for a simulated bench in real time."""
SLOW_SAVING_S = 10.0
"""Time in s after which a person learns how the bench is although its data are not saved yet."""
SLOW_SAVING = {
    True: "the bench is safe; the data are still being saved: the file is large, or the disk "
    "does not answer",
    False: "the bench could NOT be made safe in full: look before you go near it; the data are "
    "still being saved: the file is large, or the disk does not answer",
}
"""What is shown then, by whether the bench is safe."""
AT_THE_GUARD = (
    "the bench could NOT be made safe in full: look before you go near it; its guard is trying, "
    "then the data are saved"
)
"""What is shown after the same time where the guard acts."""
HAND_OVER_S = 20.0
"""Longest time in s for closing the links of a bench that is left to its guard. After it the guard
acts all the same, and reaches what is not held by a link."""


def execute(
    job: RunJob, plan: BenchPlan, clock: Clock, stop: StopFlag, *observers: RunObserver
) -> RunOutcome:
    """Run a job on a bench, from connecting to the compiled file; return how it ended.

    No failure of a job, a bench or an observer is raised: all failures are in the outcome, first
    cause first. The clock is closed at the end.
    """
    outcome = RunOutcome("failed", ExitCode.INTERNAL)
    outcome.simulated = plan.settings.simulation is not None
    procedure = CheckedProcedure(job.procedure)
    try:
        procedure.import_ahead()
        # Without this, a full garbage collection would examine all modules and take several ticks.
        gc.collect()
        gc.freeze()
        plan = plan.require_fixture(*job.procedure.fixtures)
        with stop.nothing_connected():  # a procedure that plans for ever can be stopped
            points = procedure.points()
        recorded = job.recorded
        outcome.points_done = outcome.points_earlier = len(recorded)
        outcome.points_planned = len({point.id for point in points} | recorded.keys())
        require_roles(points, plan)
        if job.lock is not None:
            job.lock.check()
        bench = connect(plan, clock, stop.check, lambda text: _inform(observers, text))
    except RigError as error:
        clock.close()
        return outcome.end_with(error)
    outcome.simulated = bench.simulated
    with contextlib.closing(bench):
        try:
            now = datetime.now().astimezone()
            job.calibrations, warnings = apply_calibrations(bench, now, job.allow_expired)
            check_points(points, bench, settings=job.settings)
            procedure.check(bench)
            stop.check()
            journal = job.open_journal(bench, points)
            execution = _Execution(job, procedure, bench, journal, stop, observers, outcome)
        except RigError as error:
            return outcome.end_with(error)
        except Exception as error:
            if (fault := driver_fault(plan, error)) is None:
                raise
            return outcome.end_with(fault)
        for warning in warnings:
            execution.run.event("warning", "calibration", warning)
        for line in plan.stand_ins:
            execution.run.event("warning", "stand-in", line)
        execution.go(points)
    return outcome


def _inform(observers: tuple[RunObserver, ...], text: str) -> None:
    """Show a line about the progress before there is a run."""
    for observer in observers:
        with contextlib.suppress(Exception):  # an observer must not end what it observes
            observer.event("info", text)


class _Execution:
    """A run that has a journal: the loop over its points, and the steps that follow at every
    exit."""

    def __init__(
        self,
        job: RunJob,
        procedure: CheckedProcedure,
        bench: Bench,
        journal: Journal,
        stop: StopFlag,
        observers: tuple[RunObserver, ...],
        outcome: RunOutcome,
    ):
        self.job, self.procedure, self.bench, self.journal = job, procedure, bench, journal
        self.stop, self.outcome = stop, outcome
        self.observers = Observers(observers, self._warn_of_observer)
        self.recorder = Recorder(journal.writer)
        held, addresses = job.held, tuple[str, ...]()
        if job.lock is not None:
            job.lock.note_run(journal.path)
            held += job.lock.files
            addresses = job.lock.names
        report = job.guard_report(bench, journal)
        self.marks = BenchMarks(addresses, bench.settings.name, journal.path.resolve())
        self.guard = GuardLink(bench.plan, journal.path, report, held, addresses)
        self.readings = dict(journal.recorded)
        self.run = Run(
            job.settings,
            bench,
            self.recorder,
            journal.stream_index,
            journal.start_s,
            self.readings,
            InterlockStore(bench.plan, lasting=job.lock is not None),
        )
        begun = None if job.resume is None else job.resume.header.start_time
        self.run.references = PressReferences(
            job.results, bench.plan, job.sample, job.accept, begun
        )
        self.run.inform = lambda message: self.observers.event("info", message)
        self.run.on_press = self.observers.pressed
        self.run.ending.warn_at_once = self.observers.warn_at_once
        self.phases = Phases()
        parts = RunParts(
            job,
            procedure,
            self.run,
            journal,
            self.recorder,
            self.readings,
            self.phases,
            stop,
            self.observers,
            outcome,
        )
        self.loop = PointLoop(parts, self._switch_off)
        self.checks = WaitChecks(parts, self.guard, self._leave_to_guard)
        self.saving = RunSaving(parts, self.loop.readings)
        self._on_one_link = [
            {part.role for part in parts} for parts in by_link(bench.plan.instruments)
        ]
        self._leaving = False
        """True once the bench is left to the guard: the procedure cannot be ended."""
        self._begun_s = bench.clock.now()

    def go(self, points: tuple[Point, ...]) -> None:
        """Record the points, then make the bench safe, save the data and report."""
        # The contacts are read while the bench is made safe as well: an opening then must latch.
        unregister_interlocks = self.bench.clock.each_slice(self.run.interlocks.poll)
        unregister = self.bench.clock.each_slice(self.checks.each_slice)
        self.bench.clock.while_computing(self.guard.beat)
        # Until the bench is safe: with its own action Ctrl-Z would suspend the process meanwhile.
        with PauseSwitch(self.run.holds):
            try:
                self.marks.running(self.guard.pid)  # before anything is switched on
                with self._hang_watch():
                    self._begin_interlocks()
                    self.loop.record_all(points)
                self.outcome.status, self.outcome.code = "complete", self._judge()
            except StopRequestedError as stopped:
                self.outcome.end_with(stopped)
            except TooSlowError as late:
                self._stopped_or_too_slow(late)
            except RigError as error:
                # Where a driver or a procedure has said itself what is wrong, that stands.
                blamed = isinstance(error, (UnexpectedFaultError, ProcedureFaultError))
                unexpected = error.__cause__ if blamed else None
                self.outcome.end_with(driver_fault(self.bench.plan, unexpected) or error)
            except KeptBackError as kept:
                self.outcome.end_with(self._cause_of(kept))
                self.outcome.warnings.append(self.procedure.kept_back(kept))
            except BaseException as error:  # noqa: BLE001 - a bug ends a run as safely as anything else
                self.outcome.end_with(driver_fault(self.bench.plan, error) or internal(error))
            finally:
                unregister()
                self._make_safe()
                unregister_interlocks()
                self._end_interlocks()
        try:
            if self.outcome.off_failures:
                self._hand_over()
        finally:
            taken = self.outcome.taken_over
            safe = self.outcome.safe if taken is None else taken.safe
            level = "info" if safe else "warning"
            self.observers.unless_over(SLOW_SAVING_S, SLOW_SAVING[safe], level)
            self.phases.enter(RunPhase.SAVING)
            self.saving.save()
            self.observers.end()
        if not self.outcome.off_failures:
            self.guard.done()

    def _cause_of(self, kept: KeptBackError) -> RigError:
        """Return what has ended a run whose procedure has kept the first error back: a stop, where
        a person has asked for one meanwhile. A hold is an error then: the run did not wait."""
        if self.stop.requested is not None:
            return StopRequestedError(self.stop.requested)
        if isinstance(kept.cause, HoldError):
            text = f"the run could not be put on hold: {kept.cause.message}"
            return RigError(text, None, ExitCode.INSTRUMENT)
        return kept.cause

    def _stopped_or_too_slow(self, late: TooSlowError) -> None:
        """End the run because its ticks came too late; or as stopped, with the late ticks as a
        warning, where a person asked for that before the loop looked for a stop again."""
        if self.stop.requested is None:
            if self.bench.simulated and not self.bench.clock.is_virtual:
                late.hint = f"{late.hint}; {NOT_IN_REAL_TIME}"
            self.outcome.end_with(late)
            return
        self.outcome.end_with(StopRequestedError(self.stop.requested))
        with contextlib.suppress(RigError):  # a failed recorder is reported by `RunSaving`
            self.run.event("warning", "late-ticks", f"while the run stopped: {late.one_line()}")

    def _hand_over(self) -> None:
        """Leave the bench to the guard, and mark the bench as that leaves it. Before the data are
        saved, which may take long; the recorder writes meanwhile."""
        self.observers.unless_over(SLOW_SAVING_S, AT_THE_GUARD, "warning")
        # With signs of life: a link whose call hangs may keep this waiting.
        closing = Task(self.bench.hand_over)
        try:
            start_thread(threading.Thread(target=closing.run, name="hand over", daemon=True))
        except RigError:
            closing.run()
        closing.done_by(closing.begun_s + HAND_OVER_S, self.guard.beat)
        failures = self.outcome.off_failures
        reasons = "; ".join(f"{off.name}: {off.reason}" for off in failures)
        cause = f"the run could not make the bench safe: {reasons}"
        over_limit = [off.name for off in failures if off.over_limit]
        taken = self.outcome.taken_over = self.guard.take_over(over_limit, cause)
        # Between the two the guard's own mark stays: it says what may still be pressed.
        if taken.released or not taken.safe:
            self._mark()

    def _judge(self) -> ExitCode:
        """Return the exit code of a run that has all its points."""
        invalid = any(self.procedure.why_invalid(reading) for reading in self.readings.values())
        return ExitCode.FINISHED_WITH_FAILURES if invalid else ExitCode.DONE

    def _hang_watch(self) -> HangWatch:
        packages = self.procedure.packages(self.bench.plan)
        warn = self.observers.warn_at_once
        return HangWatch(self.bench.clock, packages, self.guard.hangs, warn)

    # --- during every wait ------------------------------------------------------------------------

    def _leave_to_guard(self, kept: RigError) -> None:
        """Run the emergency actions, then have the guard kill this run, make the bench safe and
        save the data: the procedure has kept back everything that was to end the run."""
        if self._leaving:  # an emergency action waits
            return
        self._leaving = True
        text = self.procedure.kept_back(KeptBackError(kept))
        # The guard may act before the steps below are done.
        self.guard.cause(f"{text}; the run was killed")
        self.guard.beat()
        self.run.arming.emergency_stop()
        self.guard.beat()
        with contextlib.suppress(Exception):  # the disk may be what ends the run
            self.run.event("error", "kept-back", text)
            self.recorder.barrier(BARRIER_S)
        if self.guard.died:  # then no one else lifts what is pressed
            with contextlib.suppress(Exception):
                failures = self._switch_off(False)
                self.outcome.off_failures = [failure for failure in failures if failure.drives]
                self._mark()
        self.guard.kill()

    # --- first: safe ------------------------------------------------------------------------------

    def _switch_off(self, keep_watching: bool) -> list[ShutdownFailure]:
        """Run the shutdown actions, undisturbed by stop requests and by drives and threads that
        fail meanwhile; return those that failed."""
        self.phases.enter(RunPhase.MAKING_SAFE)
        with self.run.ending.making_safe(), self.bench.links.making_safe():
            return self.run.arming.make_safe(self.guard.beat, keep_watching)

    def _make_safe(self) -> None:
        """Switch everything off, and inform the guard if that has worked."""
        self.run.ending.announce()
        self.run.ending.lost = tuple(
            error for error in self.outcome.failures if isinstance(error, InstrumentTimeoutError)
        )
        silent = {error.device for error in self.run.ending.lost}
        self.run.ending.silent = frozenset(
            role for roles in self._on_one_link if roles & silent for role in roles
        )
        self.observers.making_safe()
        failures = self._switch_off(False)
        self.outcome.duration_s = self.bench.clock.now() - self._begun_s
        found = self.run.disturbances
        self.outcome.holds, self.outcome.presses = found.holds, found.presses
        self.outcome.made_safe = tuple(self.run.ending.made_safe)
        self.outcome.armed = self.run.arming.begun
        self.outcome.own_bench = self.job.lock is None
        self.outcome.left = self.run.ending.left
        self.outcome.off_failures = [failure for failure in failures if failure.drives]
        for failure in failures:
            if not failure.drives:
                error = RigError(f"{failure.name}: {failure.reason}", None, ExitCode.INSTRUMENT)
                self.outcome.add_failure(error)
        for error in self.run.ending.failures:
            if not self.outcome.failures:
                self.outcome.add_failure(error)
            elif all(error.message != known.message for known in self.outcome.failures):
                # The cause is reported already: this followed from it.
                self.outcome.warnings.append(error.one_line())
        if self.outcome.off_failures:
            self.outcome.code = ExitCode.UNSAFE
            self.outcome.status = "failed"
            self._mark()
        else:
            self.outcome.safe = not (self.run.ending.failures or self.outcome.left)
            self._mark()
            self.guard.safe()
        with contextlib.suppress(RigError):  # a failed recorder is reported by `RunSaving`
            for failure in self.outcome.off_failures:
                self.run.event("error", "off-failed", f"{failure.name}: {failure.reason}")

    def _begin_interlocks(self) -> None:
        """Read the contacts before anything is armed; have those proved that the bench file wants
        to be. Raises InterlockError if one of a person is open or latched."""
        watch = self.run.interlocks
        watch.begin()
        watch.check()
        for contact in self.bench.settings.interlock:
            if contact.proof and contact.name not in self.job.proven:
                prove(watch, contact.name, lambda text: self.observers.event("info", text))
                self.job.proven.add(contact.name)

    def _end_interlocks(self) -> None:
        """End the watch over the contacts; report a person's contact that opened while the bench
        was made safe, and a latch that could not be recorded."""
        watch = self.run.interlocks
        watch.end()
        try:
            watch.check()
        except InterlockError as latched:
            if self.outcome.status == "complete":
                self.outcome.add_failure(latched)
            elif (
                all(error.message != latched.message for error in self.outcome.failures)
                # Where it was found while the bench was made safe, it is among them already.
                and latched.one_line() not in self.outcome.warnings
            ):
                self.outcome.warnings.append(latched.one_line())
        for error in watch.failures():
            self.outcome.add_failure(error)
            self.outcome.code = ExitCode.UNSAFE

    def _mark(self) -> None:
        """Mark the bench as the run leaves it; the mark of a safe one is removed."""
        outcome = self.outcome
        taken_over = outcome.taken_over is not None and outcome.taken_over.safe
        try:
            if outcome.off_failures and not taken_over:
                self.marks.unsafe({off.name: off.reason for off in outcome.off_failures})
            elif self.run.ending.failures:
                last = "; ".join(error.message for error in self.run.ending.failures)
                self.marks.stopped(f"the last run ended with: {last}")
            else:
                self.marks.clear()
        except RigError as error:
            self.outcome.add_failure(error)

    def _warn_of_observer(self, text: str) -> None:
        """Record that an observer failed; the outcome has it even where the journal is closed."""
        if self.phases.now is RunPhase.SAVING:
            self.outcome.warnings.append(text)
            return
        with contextlib.suppress(RigError):  # a failed recorder ends the run by itself
            self.run.event("warning", "observer", text)
