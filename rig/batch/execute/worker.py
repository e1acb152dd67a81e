"""The worker: the one process that holds the bench and takes the runs of a queue, one by one.

    python -m rig.batch.execute.worker [--paused=REASON] -- FOLDER

It is started by the supervisor (`rig.batch.execute.supervisor`), which sends commands on its
standard input ("stop-now", "stop-after-point", "stop-after-run", "stop-run", "stop-run 12",
"pause", "go", "signal 2") and gets one JSON object a line on its standard output. When its input
ends the supervisor has died: the worker then stops safely, as at a stop request.

What it decides is in `rig.batch.plan.policy`; that nothing is lost or doubled, in
`rig.batch.queue`.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import sys
import threading
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rig
from rig.batch.execute.batch_clock import clock_of
from rig.batch.execute.between_runs import (
    BENCH_IN_USE,
    BENCH_SAFE,
    BetweenRuns,
    EndOfBatchError,
    SelfEnding,
    room_on_disk,
    stopped_by_request,
)
from rig.batch.execute.crash_recovery import archive_files, journal_to_resume, outcome_from_journal
from rig.batch.execute.disk_room import has_room
from rig.batch.execute.drift_watch import DriftWatch
from rig.batch.execute.run_benches import RunBenches
from rig.batch.execute.terms import BatchTerms
from rig.batch.execute.worker_link import CommandListener, Reporter, SendEvent
from rig.batch.folder import BatchFolder
from rig.batch.plan.policy import after_failure, kind_of, reason_to_end, remedy_at_the_end
from rig.batch.plan.procedures import installed, procedure_of
from rig.batch.queue import Queue, give_up
from rig.batch.queue_file import QueueWriteError
from rig.batch.queue_records import AttemptResult, Claim, RunState, valid_of
from rig.core.errors import ExitCode, RigError
from rig.core.threads import thread_remains
from rig.core.units import counted
from rig.run.stopping import MAKING_SAFE_S, StopFlag, StopRequestedError, TimeOverError

if TYPE_CHECKING:
    from rig.batch.execute.drift import HoldReason
    from rig.bench.settings import BenchSettings
    from rig.run.outcome import RunOutcome

GUARD_PATIENCE_S = 600.0
"""Longest time in s that the guard of an earlier worker that died may take: with every instrument
silent some minutes (`longest_take_over_s`), and a long journal to be compiled."""

GIVEN_UP = "stopped by a person, who let the batch continue"
"""Reason of a run that was ended alone. It is not taken again."""


class Worker:
    """Takes the runs of a queue until none is left, or something ends the night."""

    def __init__(
        self,
        folder: BatchFolder,
        queue: Queue,
        lock: int,
        stop: StopFlag,
        send: SendEvent,
        commands: CommandListener,
    ):
        self._folder, self._queue, self._lock, self._stop = folder, queue, lock, stop
        self._send = send
        self._terms = BatchTerms.of(queue, folder)
        self._batch = self._terms.file.batch
        self._commands = commands
        self._benches = RunBenches(self._terms, folder, stop, send)
        self._clock = clock_of(queue)
        self._watch = DriftWatch(queue, self._terms.file, self._terms.bench, self._terms.results)
        self._between = BetweenRuns(
            folder,
            queue,
            self._batch.on_hold,
            self._clock,
            self._benches,
            stop,
            self._commands,
            send,
        )
        self._proven: set[str] = set()
        """Interlock contacts that were seen to open and close since this process began."""
        self._mounted: BenchSettings | None = None
        """The bench of the latest run."""
        queue.wait_for_disk = self._between.wait_for_the_queue

    def work(self) -> ExitCode:
        """Take the runs; the exit code of the batch."""
        try:
            with ExitStack() as at_the_end:
                at_the_end.callback(self._benches.abandon)
                self._recover()
                self._between.wait_for_the_window()
                while (claim := self._next()) is not None:
                    self._take(claim, at_the_end)
        except StopRequestedError as stopped:
            time_over = isinstance(stopped, TimeOverError)
            by = "" if time_over else self._commands.ended_by
            self._end("stopped", by or stopped.one_line(), stopped.code)
            return stopped.code
        except EndOfBatchError as ended:
            self._end("stopped", ended.one_line(), ended.code)
            return ended.code
        counts = self._queue.counts()
        doubtful, _ = self._queue.invalid(0)
        lost = counts["failed"] + counts["set-aside"]
        code = ExitCode.FINISHED_WITH_FAILURES if lost or doubtful else ExitCode.DONE
        self._end("complete", "", code)
        return code

    # --- between runs ---------------------------------------------------------------------------

    def _recover(self) -> None:
        """Conclude the run that an earlier worker left: it is done, or it is continued."""
        claim = self._queue.unfinished()
        if claim is None:
            return
        journal = self._folder.journal(claim.number, claim.condition.procedure)
        if self._terms.bench is None:
            ended = outcome_from_journal(journal)
            earlier_s = self._queue.bench_s(claim.number)
            ended = replace(
                ended,
                bench_s=max(0.0, ended.bench_s - earlier_s),
                # Of several attempts the journal does not say whose holds they were.
                on_hold_s=ended.on_hold_s if claim.attempt == 1 else 0.0,
            )
        else:
            ended = outcome_from_journal(journal, self._queue.began(claim))
        self._clock.used(ended.elapsed_s)
        if ended.reason:
            self._send("note", level="warning", text=f"run {claim.number}: {ended.reason}")
        self._conclude(claim, ended)

    def _next(self) -> Claim | None:
        """Return the next run, once nothing speaks against it; None after the last."""
        rested: int | None = None
        while True:
            self._between.check()
            upcoming = self._queue.upcoming()
            if upcoming is None:
                return None
            rest_s = 0.0 if rested == upcoming.number else self._rest_before(upcoming)
            counts, used_s = self._queue.counts(), self._queue.bench_s()
            if why := reason_to_end(self._batch, counts["done"], counts["failed"], used_s):
                remedy = remedy_at_the_end(self._batch, counts["done"], used_s)
                raise EndOfBatchError(why, remedy, ExitCode.STOPPED_BY_CONDITION)
            takes_s = rest_s + upcoming.estimate_s + MAKING_SAFE_S
            self._between.require_time(takes_s, upcoming.spread_s)
            if found := self._watch.before(upcoming, self._clock.now()):
                self._hold_for(found)
                continue
            if not rest_s:
                return upcoming
            self._send("state", state="resting", text=f"{rest_s:g} s")
            self._between.rest(rest_s)
            rested = upcoming.number  # what was asked above may have changed since

    def _rest_before(self, upcoming: Claim) -> float:
        """Return the rest before a run, in s; longer before another try."""
        again = upcoming.attempt > 1 and self._queue.attempts(upcoming.number)
        return upcoming.condition.rest_s + (self._batch.retries.rest_s if again else 0.0)

    def _hold_for(self, found: Sequence[HoldReason]) -> None:
        """Hold the batch for these reasons. A hold for want of room, or of the batch's folder, ends
        by itself as well."""
        kinds = {one.kind for one in found}
        over = None
        if kinds == {"disk"}:
            over = room_on_disk(self._disk_has_room)
        elif kinds == {"folder"}:
            over = SelfEnding(lambda: not self._watch.folder(), "the folder is in its place")
        self._between.hold(_text_of(found), over, by_resume="calibration" not in kinds)

    def _disk_has_room(self) -> bool:
        """Return whether the next run's files, and the rest of the batch, fit on the disk."""
        if self._watch.folder():  # one of its name may have been made again
            return False
        upcoming = self._queue.upcoming()
        size_B = 0 if upcoming is None else upcoming.size_B
        return has_room(self._folder.path / "runs", size_B) and not self._watch.disk()

    def _end(self, state: str, why: str, code: ExitCode) -> None:
        """Record why the batch ends, if the disk takes it, and have the supervisor end it."""
        text = why if why.startswith(state) else f"{state}: {why}" if why else state
        self._queue.wait_for_disk = give_up
        with contextlib.suppress(QueueWriteError):
            self._queue.set_meta("state", text)
            self._queue.add_event("info" if state == "complete" else "warning", text)
        self._send("end", state=state, text=why, code=int(code))

    # --- one run --------------------------------------------------------------------------------

    def _take(self, upcoming: Claim, at_the_end: ExitStack) -> None:
        """Claim a run, take it, record how it ended."""
        claim = self._queue.claim(upcoming.number)
        self._send(
            "run",
            number=claim.number,
            attempt=claim.attempt,
            condition=claim.condition.id,
            procedure=claim.condition.procedure,
            estimate_s=claim.estimate_s,
        )
        if claim.attempt > 1 and (ended := self._completed_elsewhere(claim)) is not None:
            self._conclude(claim, ended)
            return
        self._commands.run, self._commands.in_run = claim.number, True
        try:
            outcome = self._perform(claim, at_the_end)
        except StopRequestedError as stopped:  # nothing was connected yet
            ended = AttemptResult("stopped", code=int(stopped.code))
            ended = self._with_earlier_points(claim, ended)
            if self._commands.take_given_up():
                self._give_up(claim, ended)
                return
            self._queue.finish(claim, ended, "queued")
            raise
        except RigError as error:
            kind = kind_of(error.code, error.parts())
            ended = AttemptResult("failed", kind, int(error.code), error.one_line())
            ended = self._with_earlier_points(claim, ended)
        else:
            ended = _ended(outcome)
        finally:
            self._commands.in_run = False
        self._clock.used(ended.elapsed_s)
        self._conclude(claim, ended)

    def _completed_elsewhere(self, claim: Claim) -> AttemptResult | None:
        """Return the outcome of an interrupted run if `rig resume` has completed it since; else
        None."""
        ended = outcome_from_journal(self._folder.journal(claim.number, claim.condition.procedure))
        return replace(ended, bench_s=0.0) if ended.ending == "complete" else None

    def _with_earlier_points(self, claim: Claim, ended: AttemptResult) -> AttemptResult:
        """Return the result of an attempt that was over before it had a bench, with the points that
        earlier attempts at the run have recorded."""
        journal = self._folder.journal(claim.number, claim.condition.procedure)
        earlier = outcome_from_journal(journal)
        return replace(
            ended, points_done=earlier.points_done, points_planned=earlier.points_planned
        )

    def _conclude(self, claim: Claim, ended: AttemptResult) -> None:
        """Record how an attempt ended, and do what follows from it."""
        given_up = self._commands.take_given_up()
        if ended.ending == "complete":
            self._queue.finish(claim, ended, "done")
            self._finished(claim, ended, "done")
            if found := self._watch.after(claim, ended, self._mounted):
                self._between.hold(_text_of(found))
                self._watch.accept(claim, found)
            return
        if ended.ending == "stopped" and given_up:
            self._give_up(claim, ended)
            return
        if ended.ending == "stopped":
            self._queue.finish(claim, ended, "queued")
            self._finished(claim, ended, "queued")
            self._stop.check()
            if ended.code == ExitCode.STOPPED_BY_CONDITION:
                raise self._between.time_over(ended.reason)
            raise stopped_by_request("after a point")
        before = self._queue.attempts(claim.number)
        before[ended.kind] = before.get(ended.kind, 0) + 1
        verdict = after_failure(
            self._batch,
            ended.kind,  # type: ignore[arg-type]
            before,
            self._queue.failures_of(claim.condition.id),
            self._queue.failed_in_a_row(self._batch.hold_when.consecutive_failures),
            ended.reason,
        )
        state: RunState = "queued" if verdict.run == "again" else "failed"
        self._queue.finish(claim, ended, state)
        self._finished(claim, ended, state)
        if verdict.set_aside and not claim.condition.reference:
            self._set_aside(claim)
        if verdict.batch == "end":
            raise EndOfBatchError(verdict.why, None, ExitCode(ended.code or ExitCode.INTERNAL))
        if verdict.batch == "hold":
            if ended.kind == "storage" and (away := self._watch.folder()):
                self._hold_for(away)  # room on the disk would not help
                return
            over = room_on_disk(self._disk_has_room) if ended.kind == "storage" else None
            bench = BENCH_IN_USE if ended.kind == "in-use" else BENCH_SAFE
            self._between.hold(verdict.why, over, bench)

    def _give_up(self, claim: Claim, ended: AttemptResult) -> None:
        """Record that a person has ended this run and let the batch continue."""
        self._queue.finish(claim, replace(ended, reason=GIVEN_UP), "failed")
        self._finished(claim, ended, "failed")

    def _set_aside(self, claim: Claim) -> None:
        name = claim.condition.id
        failed = self._queue.failures_of(name)
        why = f"{counted(failed, 'run')} failed"
        left_out = self._queue.set_aside(name, why)
        text = f"condition {name}: {why}; {counted(left_out, 'queued run')} left out"
        self._queue.add_event("warning", text)
        self._send("note", level="warning", text=text)

    def _finished(self, claim: Claim, ended: AttemptResult, state: RunState) -> None:
        """Report how an attempt ended, and the state of its run since then."""
        journal = self._folder.journal(claim.number, claim.condition.procedure)
        noun = ("point", "points")
        with contextlib.suppress(RigError):  # it may be gone since, which has failed the run
            noun = installed(claim.condition.procedure).point_name
        points = f"{ended.points_done} of {counted(ended.points_planned, *noun)}"
        if ended.ending == "complete" and ended.code == ExitCode.FINISHED_WITH_FAILURES:
            points += f", {valid_of(ended.summary or {})}"
        self._send(
            "finished",
            number=claim.number,
            attempt=claim.attempt,
            condition=claim.condition.id,
            procedure=claim.condition.procedure,
            ending=ended.ending,
            state=state,
            code=ended.code,
            reason=ended.reason,
            bench_s=ended.bench_s,
            journal=str(journal),
            points=points,
            holds=ended.holds,
            presses=ended.presses,
            bench=ended.bench,
        )

    def _perform(self, claim: Claim, at_the_end: ExitStack) -> RunOutcome:
        """Make one attempt at a run, from choosing the bench to a journal that is closed."""
        from rig.run.execute import execute
        from rig.run.job import RunJob

        condition = claim.condition
        procedure = procedure_of(condition)
        path = self._folder.journal(claim.number, condition.procedure)
        resume = journal_to_resume(path)
        bench = self._benches.bench_for(claim, procedure, at_the_end)
        self._mounted = bench.plan.settings
        job = RunJob(
            procedure=procedure,
            seed=self._benches.seed,
            results=self._terms.results,
            user=self._batch.user,
            sample=self._batch.sample,
            notes=self._batch.notes,
            resume=resume,
            allow_expired=self._batch.allow_expired,
            recorded_toml=bench.recorded_toml,
            lock=bench.lock,
            collection=self._terms.batch_id,
            run_number=claim.number,
            journal=path,
            compiled=False,
            held=(self._lock,),
            proven=self._proven,
        )
        toml = bench.recorded_toml or bench.plan.text
        if resume is not None and self._queue.meta("despite changes"):
            began = (resume.header.fingerprint, resume.header.program.version)
            if began != (job.fingerprint(toml), rig.__version__):
                archive_files(path)
                job.resume = None
        if self._terms.bench is None and (upcoming := self._queue.upcoming()) is not None:
            self._benches.boot(upcoming)
        self._stop.time_limit = self._between.time_limit(bench.clock)
        try:
            outcome = execute(job, bench.plan, bench.clock, self._stop, Reporter(self._send))
        finally:
            self._stop.time_limit = None
            if bench.started is not None:
                bench.started.wait()
        return outcome


def _text_of(findings: Sequence[HoldReason]) -> str:
    return "; ".join(f"{found.text}: {found.hint}" for found in findings)


def _ended(outcome: RunOutcome) -> AttemptResult:
    """Return an execution's outcome as the queue keeps it."""
    failed = outcome.status == "failed"
    reasons = [failure.one_line() for failure in outcome.failures]
    reasons += [f"{off.name} not switched off: {off.reason}" for off in outcome.off_failures]
    safe_after_all = outcome.taken_over is not None and outcome.taken_over.safe
    if outcome.taken_over is not None:
        reasons.append(outcome.taken_over.summary)
    return AttemptResult(
        outcome.status,  # type: ignore[arg-type]
        kind_of(outcome.code, outcome.failures, safe_after_all) if failed else "",
        int(outcome.code),
        "; ".join(reasons),
        outcome.duration_s - outcome.on_hold_s,
        outcome.points_done,
        outcome.points_planned,
        dict(outcome.summary),
        outcome.holds,
        outcome.presses,
        outcome.on_hold_s,
        _bench_of(outcome),
    )


def _bench_of(outcome: RunOutcome) -> str:
    """Return how a run left its bench; empty where that is not known."""
    if outcome.off_failures:
        guarded = outcome.taken_over is not None and outcome.taken_over.safe
        return f"Bench {'was made safe by the guard' if guarded else 'is NOT safe'} (see above)."
    if outcome.left:
        found = " and ".join(outcome.left)
        return f"Bench is stopped, but {found} (see above): check stage_z first."
    if outcome.safe and (outcome.armed or outcome.own_bench):
        return "Bench is safe."
    return "Bench is stopped, but check it (see above)." if outcome.made_safe else ""


def main(arguments: Sequence[str]) -> int:
    """Run the worker program."""
    parser = argparse.ArgumentParser("python -m rig.batch.execute.worker")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--paused", type=json.loads, default='""')  # a default is read as well
    given = parser.parse_args(arguments)
    folder = BatchFolder(given.folder)
    lines = threading.Lock()
    # What a package or a library prints goes to the log: in a line of a report it would spoil it.
    reports = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())

    def send(event: str, **fields: Any) -> None:
        line = json.dumps({"event": event, **fields}) + "\n"
        # Where it cannot be sent the supervisor has died: the end of standard input says so, too.
        with lines, contextlib.suppress(OSError):
            reports.write(line)
            reports.flush()

    signal.signal(signal.SIGTSTP, signal.SIG_IGN)  # between runs; a run has its own switch
    # By it the worker learns that its supervisor has died. nohup has it ignored; but no terminal
    # reaches this process, whose session is its own.
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    with StopFlag() as stop:
        commands = CommandListener(stop, send, given.paused)  # also while an earlier guard acts

        def check() -> None:
            stop.check()
            if commands.stop_after_run:  # no run has begun
                raise stopped_by_request("before a run")

        try:
            with (
                folder.held_by("worker", GUARD_PATIENCE_S, check) as lock,
                Queue.open(folder.queue) as queue,
            ):
                os.set_inheritable(lock, True)
                return int(Worker(folder, queue, lock, stop, send, commands).work())
        except (StopRequestedError, EndOfBatchError) as stopped:
            why = commands.ended_by or stopped.one_line()
            send("end", state="stopped", text=why, code=int(stopped.code))
            return int(stopped.code)
        except RigError as error:
            send("end", state="failed", text=error.one_line(), code=int(error.code))
            return int(error.code)


def _say_at_the_end(line: str) -> None:
    with contextlib.suppress(OSError):  # a full disk
        os.write(2, f"{line}\n".encode())


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    ended = main(sys.argv[1:])
    if thread_remains(_say_at_the_end):
        os._exit(ended)
    sys.exit(ended)
