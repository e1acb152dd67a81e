"""The worker: the one process that holds the bench and takes the runs of a queue, one by one.

    python -m rig.batch.execute.worker FOLDER

It is started by the supervisor (`rig.batch.execute.supervisor`), which tells it words on its
standard input ("stop-now", "stop-after-point", "stop-after-run", "pause", "go", "signal 2") and
gets one object of JSON a line on its standard output. When its input ends the supervisor has died:
it stops in order, as it does when it is told to.

What it decides is in `rig.batch.plan.policy`; that nothing is lost or doubled, in
`rig.batch.queue`.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rig
from rig.batch.execute.batch_clock import Night, SlavedNight, WallNight
from rig.batch.execute.crash_recovery import put_away, to_continue, what_became_of
from rig.batch.execute.drift_watch import Watch
from rig.batch.folder import BatchFolder
from rig.batch.plan.policy import after_failure, does_not_fit, kind_of, reason_to_end, window
from rig.batch.plan.procedures import installed
from rig.batch.plan.settings import BatchFile
from rig.batch.queue import Claim, Ended, Queue
from rig.core.errors import ExitCode, RigError
from rig.run.bench_selector import BenchRequest, Choosing, ChosenBench, start_simulated
from rig.run.holds import PAUSE
from rig.run.stopping import StopFlag, StopRequestedError

if TYPE_CHECKING:
    from rig.batch.execute.drift import Finding
    from rig.bench.bench import BenchSettings, Fixture, RunningBench
    from rig.run.outcome import Outcome
    from rig.run.points import Point, Reading
    from rig.run.procedure import Procedure

LOOK_S = 0.05
"""How often a worker that waits for a person looks whether it may go on."""
GUARD_PATIENCE_S = 60.0
"""How long the guard of a worker that died is waited for."""

Say = Callable[..., None]


@dataclass(frozen=True)
class Terms:
    """What a batch was begun with, as its queue keeps it."""

    file: BatchFile
    bench: Path | None
    """Bench file; None where simulated benches are started, one a run."""
    results: Path
    """Folder in which the batch's folder lies, and the guard's report of a real bench."""
    batch_id: str
    begun: datetime
    files_from: Path
    """Folder that the batch file's own file names are relative to."""

    @classmethod
    def of(cls, queue: Queue, folder: BatchFolder) -> Terms:
        """Read from a queue."""
        bench = queue.meta("bench")
        return cls(
            BatchFile.model_validate_json(queue.meta("file")),
            Path(bench) if bench else None,
            folder.path.parent,
            queue.meta("id"),
            datetime.fromisoformat(queue.meta("begun")),
            Path(queue.meta("files_from")),
        )


class _EndError(RigError):
    """The batch ends here, in order, before its last run."""


class _Words:
    """What the supervisor says, heard by a thread; acted on by the main thread."""

    def __init__(self, stop: StopFlag, say: Say):
        self._stop, self._say = stop, say
        self.paused = threading.Event()
        self.stop_after_run = False
        self.in_run = False
        threading.Thread(target=self._listen, name="words", daemon=True).start()

    def _listen(self) -> None:
        rest = b""
        while chunk := os.read(0, 4096):  # unbuffered: Python ends while this still listens
            *lines, rest = (rest + chunk).split(b"\n")
            for line in lines:
                self._hear(line.decode())
        os.kill(os.getpid(), signal.SIGHUP)  # nobody is there any more

    def _hear(self, word: str) -> None:
        if word.startswith("signal "):
            os.kill(os.getpid(), int(word.removeprefix("signal ")))
        elif word == "stop-now":
            os.kill(os.getpid(), signal.SIGTERM)
        elif word == "stop-after-point":
            self._stop.after_point = self.stop_after_run = True
        elif word == "stop-after-run":
            self.stop_after_run = True
        elif word == "pause" and not self.paused.is_set():
            self.paused.set()
            self._say("state", state="pausing")
            if self.in_run:  # one that still connects takes no notice: the batch waits after it
                os.kill(os.getpid(), signal.SIGTSTP)
        elif word == "go":
            if self.paused.is_set():
                self._say("state", state="running")
            self.paused.clear()
            if self.in_run:
                os.kill(os.getpid(), signal.SIGCONT)


class _Reporter:
    """A run's progress, for the supervisor."""

    def __init__(self, say: Say):
        self._say = say

    def planned(self, points: tuple[Point, ...], kept: set[str], overhead_s: float) -> None:
        """See `rig.run.execute.Reporter`."""
        self._say("planned", points=len(points), kept=len(kept))

    def point_kept(self, number: int, total: int, point: Point, reading: Reading) -> None:
        """See `rig.run.execute.Reporter`."""
        self._say("point", done=number, of=total, point=point.id)

    def event(self, level: str, message: str) -> None:
        """See `rig.run.execute.Reporter`."""
        self._say("note", level=level, text=message)
        if PAUSE in message:
            self._say("state", state="paused", text="the bench is safe")

    def storing(self) -> None:
        """See `rig.run.execute.Reporter`."""

    def stored(self, run_file: Path) -> None:
        """See `rig.run.execute.Reporter`."""


@dataclass(frozen=True)
class _Ahead:
    """A simulated bench that boots while the run before its own is taken."""

    request: BenchRequest
    fixture: Fixture
    started: RunningBench


class Worker:
    """Takes the runs of a queue until none is left, or something ends the night."""

    def __init__(self, folder: BatchFolder, queue: Queue, lock: int, stop: StopFlag, say: Say):
        self._folder, self._queue, self._lock, self._stop = folder, queue, lock, stop
        self._say = say
        self._terms = Terms.of(queue, folder)
        self._batch = self._terms.file.batch
        self._words = _Words(stop, say)
        self._night = self._nights()
        self._bench: ChosenBench | None = None
        """Of a bench file: locked once, for all runs."""
        self._ahead: _Ahead | None = None
        """Of the next run, while this one is taken."""
        self._watch = Watch(queue, self._terms.file, self._terms.bench, self._terms.results)
        self._mounted: BenchSettings | None = None
        """The bench of the latest run."""
        self._from, self._until = window(self._batch, self._terms.begun)

    def work(self) -> ExitCode:
        """Take the runs; the exit code of the batch."""
        try:
            with ExitStack() as at_the_end:
                at_the_end.callback(self._abandon)
                self._settle()
                self._wait_for_the_window()
                while (claim := self._next()) is not None:
                    self._take(claim, at_the_end)
        except StopRequestedError as stopped:
            self._end("stopped", stopped.one_line(), stopped.code)
            return stopped.code
        except _EndError as ended:
            self._end("stopped", ended.one_line(), ended.code)
            return ended.code
        counts = self._queue.counts()
        lost = counts["failed"] + counts["set-aside"]
        code = ExitCode.FINISHED_WITH_FAILURES if lost else ExitCode.DONE
        self._end("complete", "", code)
        return code

    # --- between runs ---------------------------------------------------------------------------

    def _settle(self) -> None:
        """What an earlier worker left: its run is done, or goes on where it was interrupted."""
        claim = self._queue.unfinished()
        if claim is None:
            return
        ended = what_became_of(self._folder.journal(claim.number, claim.condition.procedure))
        earlier_s = self._queue.bench_s(claim.number)
        ended = replace(ended, bench_s=max(0.0, ended.bench_s - earlier_s))
        self._night.used(ended.bench_s)
        if ended.reason:
            self._say("note", level="warning", text=f"run {claim.number}: {ended.reason}")
        self._conclude(claim, ended)

    def _next(self) -> Claim | None:
        """The next run, once nothing stands against it."""
        while True:
            self._between_runs()
            upcoming = self._queue.upcoming()
            if upcoming is None:
                return None
            counts = self._queue.counts()
            why = reason_to_end(
                self._batch, counts["done"], counts["failed"], self._queue.bench_s()
            ) or does_not_fit(
                self._night.now(),
                self._until,
                upcoming.condition.rest_s + upcoming.estimate_s,
                upcoming.spread_s,
            )
            if why:
                raise _EndError(why, "rig batch resume", ExitCode.STOPPED_BY_CONDITION)
            if found := self._watch.before(upcoming, self._night.now()):
                self._hold(_told(found))
                continue
            rest_s = upcoming.condition.rest_s
            if upcoming.attempt > 1 and self._queue.attempts(upcoming.number):
                rest_s += self._batch.retries.rest_s
            if rest_s:
                self._say("state", state="resting", text=f"{rest_s:g} s")
                self._night.rest(rest_s, self._between_runs)
            return upcoming

    def _between_runs(self) -> None:
        """Look whether the batch shall stop or pause; the bench is safe."""
        self._stop.check()
        if self._words.stop_after_run:
            raise StopRequestedError(signal.SIGTERM, " between runs")
        if self._words.paused.is_set():
            self._say("state", state="paused", text="between runs")
            self._wait("paused")

    def _hold(self, why: str) -> None:
        """Something wants a person: wait for one, or end, as the batch says."""
        self._queue.tell("hold", why)
        if self._batch.on_hold == "stop":
            raise _EndError(why, "rig batch resume", ExitCode.STOPPED_BY_CONDITION)
        self._words.paused.set()
        self._say("hold", text=why)
        self._wait("held")

    def _wait(self, state: str) -> None:
        while self._words.paused.is_set():
            self._stop.check()
            if self._words.stop_after_run:
                raise StopRequestedError(signal.SIGTERM, f" while {state}")
            time.sleep(LOOK_S)

    def _wait_for_the_window(self) -> None:
        if self._from is None or (wait_s := (self._from - self._night.now()).total_seconds()) <= 0:
            return
        self._say("state", state="waiting", text=f"not before {self._from:%Y-%m-%d %H:%M:%S}")
        self._night.rest(wait_s, self._between_runs)
        self._say("state", state="running")

    def _end(self, state: str, why: str, code: ExitCode) -> None:
        told = f"{state}: {why.removeprefix(state + ' ')}" if why else state
        self._queue.set_meta("state", told)
        self._queue.tell("info" if code == ExitCode.DONE else "warning", told)
        self._say("end", state=state, text=why, code=int(code))

    # --- one run --------------------------------------------------------------------------------

    def _take(self, upcoming: Claim, at_the_end: ExitStack) -> None:
        """Claim it, take it, keep what became of it."""
        claim = self._queue.claim(upcoming.number)
        self._say(
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
        try:
            outcome = self._perform(claim, at_the_end)
        except StopRequestedError as stopped:  # nothing was connected yet
            self._queue.finish(claim, Ended("stopped", code=int(stopped.code)), "queued")
            raise
        except RigError as error:
            kind = kind_of(error.code, error.parts())
            ended = Ended("failed", kind, int(error.code), error.one_line())
        else:
            ended = _ended(outcome)
        self._night.used(ended.bench_s)
        self._conclude(claim, ended)

    def _completed_elsewhere(self, claim: Claim) -> Ended | None:
        """How a run ended that was interrupted, and that somebody has completed with `rig resume`
        since; None of any other."""
        ended = what_became_of(self._folder.journal(claim.number, claim.condition.procedure))
        return replace(ended, bench_s=0.0) if ended.ending == "complete" else None

    def _conclude(self, claim: Claim, ended: Ended) -> None:
        """Keep how an attempt ended, and do what follows from it."""
        if ended.ending == "complete":
            self._queue.finish(claim, ended, "done")
            self._finished(claim, ended)
            if self._mounted is not None and (
                found := self._watch.after(claim, ended, self._mounted)
            ):
                self._hold(_told(found))
                self._watch.accept(claim)
            return
        if ended.ending == "stopped":
            self._queue.finish(claim, ended, "queued")
            self._finished(claim, ended)
            self._stop.check()
            raise StopRequestedError(signal.SIGTERM, " after a point")
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
        state = "queued" if verdict.run == "again" else "failed"
        self._queue.finish(claim, ended, state)  # type: ignore[arg-type]
        self._finished(claim, ended, again=state == "queued")
        if verdict.set_aside and not claim.condition.reference:
            self._set_aside(claim)
        if verdict.batch == "end":
            raise _EndError(verdict.why, None, ExitCode(ended.code or ExitCode.INTERNAL))
        if verdict.batch == "hold":
            self._hold(verdict.why)

    def _set_aside(self, claim: Claim) -> None:
        name = claim.condition.id
        failed = self._queue.failures_of(name)
        why = f"{failed} of its runs failed"
        left_out = self._queue.set_aside(name, why)
        text = f"condition {name} is set aside: {why}; {left_out} runs are left out"
        self._queue.tell("warning", text)
        self._say("note", level="warning", text=text)

    def _finished(self, claim: Claim, ended: Ended, again: bool = False) -> None:
        journal = self._folder.journal(claim.number, claim.condition.procedure)
        self._say(
            "finished",
            number=claim.number,
            attempt=claim.attempt,
            condition=claim.condition.id,
            procedure=claim.condition.procedure,
            ending=ended.ending,
            again=again,
            code=ended.code,
            reason=ended.reason,
            bench_s=ended.bench_s,
            journal=str(journal),
            points=f"{ended.points_done}/{ended.points_planned}",
        )

    def _perform(self, claim: Claim, at_the_end: ExitStack) -> Outcome:
        """One attempt at a run, from choosing the bench to a journal that is closed."""
        from rig.run.execute import execute
        from rig.run.job import Job

        condition = claim.condition
        procedure = installed(condition.procedure)
        settings = procedure.Settings.model_validate_json(json.dumps(dict(condition.settings)))
        path = self._folder.journal(claim.number, condition.procedure)
        resume = to_continue(path)
        bench = self._bench_for(claim, procedure, at_the_end)
        self._mounted = bench.plan.settings
        job = Job(
            procedure=procedure,
            settings=settings,
            seed=self._seed,
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
        )
        toml = bench.recorded_toml or bench.plan.text
        if resume is not None and self._queue.meta("despite changes"):
            began = (resume.header.fingerprint, resume.header.program.version)
            if began != (job.fingerprint(toml), rig.__version__):
                put_away(path)
                job.resume = None
        self._boot_next()
        self._words.in_run = True
        try:
            outcome = execute(job, bench.plan, bench.clock, self._stop, _Reporter(self._say))
        finally:
            self._words.in_run = False
            if bench.started is not None:
                bench.started.wait()
        return outcome

    def _bench_for(self, claim: Claim, procedure: Procedure, at_the_end: ExitStack) -> ChosenBench:
        """The bench file's bench, locked once for all runs; or a simulated one for this run."""
        fixture = procedure.FIXTURES[0]
        choosing = Choosing(lambda text: self._say("note", level="info", text=text))
        if self._terms.bench is None:
            request = self._simulated(claim)
            with self._stop.nothing_connected(), ExitStack() as nothing:
                return choosing.bench_for(request, nothing, fixture, self._booted(request, fixture))
        if self._bench is None:
            request = BenchRequest(bench=self._terms.bench, results=self._terms.results)
            self._bench = choosing.bench_for(request, at_the_end, fixture)
        from rig.core.clock import WallClock

        return replace(self._bench, clock=WallClock())

    def _booted(self, request: BenchRequest, fixture: Fixture) -> RunningBench | None:
        """The simulated bench that was started ahead, if it is the one that is asked for."""
        ahead, self._ahead = self._ahead, None
        if ahead is not None and (ahead.request, ahead.fixture) != (request, fixture):
            ahead.started.abandon()
            return None
        return None if ahead is None else ahead.started

    def _boot_next(self) -> None:
        """Have the next run's simulated bench boot beside this run. One with a fault plan waits:
        its plan may strike this process's disk."""
        if self._terms.bench is not None or (upcoming := self._queue.upcoming()) is None:
            return
        request = self._simulated(upcoming)
        fixture = installed(upcoming.condition.procedure).FIXTURES[0]
        if request.fault is None:
            self._ahead = _Ahead(request, fixture, start_simulated(request, fixture))

    def _abandon(self) -> None:
        if self._ahead is not None:
            self._ahead.started.abandon()

    def _simulated(self, claim: Claim) -> BenchRequest:
        """What the simulated bench of a run is, and what befalls it."""
        own = self._terms.file.simulation
        request = BenchRequest(seed=self._seed, results=self._folder.path / "runs")
        if own is None:
            return request
        worlds = [own.world] + [c.settings for c in own.change if c.from_run <= claim.number]
        world = worlds[-1]
        fault = next(
            (f.plan for f in own.fault if claim.number in f.runs and claim.attempt <= f.attempts),
            None,
        )
        return replace(
            request,
            stages=own.stages,
            world=None if world is None else self._terms.files_from / world,
            fault=None if fault is None else self._terms.files_from / fault,
            world_log=self._folder.world_log(claim.number) if own.world_log else None,
        )

    @property
    def _seed(self) -> int:
        own = self._terms.file.simulation
        return 0 if own is None else own.seed

    def _nights(self) -> Night:
        if self._terms.bench is not None:
            return WallNight()
        queue = self._queue

        def keep(passed_s: float) -> None:
            queue.set_meta("night_s", f"{passed_s:.6f}")

        return SlavedNight(self._terms.begun, float(queue.meta("night_s", "0")), keep)


def _told(findings: Sequence[Finding]) -> str:
    return "; ".join(f"{found.text}: {found.hint}" for found in findings)


def _ended(outcome: Outcome) -> Ended:
    """An execution's outcome as the queue keeps it."""
    failed = outcome.status == "failed"
    reasons = [failure.one_line() for failure in outcome.failures]
    reasons += [f"{off.name} not switched off: {off.reason}" for off in outcome.off_failures]
    safe_after_all = outcome.taken_over is not None and outcome.taken_over.safe
    if outcome.taken_over is not None:
        reasons.append(outcome.taken_over.told)
    return Ended(
        outcome.status,  # type: ignore[arg-type]
        kind_of(outcome.code, outcome.failures, safe_after_all) if failed else "",
        int(outcome.code),
        "; ".join(reasons),
        outcome.duration_s,
        outcome.points_done,
        outcome.points_planned,
        dict(outcome.summary),
    )


def main(arguments: Sequence[str]) -> int:
    """The program."""
    folder = BatchFolder(Path(arguments[0]))
    lines = threading.Lock()

    def say(event: str, **fields: Any) -> None:
        line = json.dumps({"event": event, **fields}) + "\n"
        with lines:
            try:
                sys.stdout.write(line)
                sys.stdout.flush()
            except OSError:  # nobody listens: the end of standard input says so, too
                sys.stdout = Path(os.devnull).open("w")  # noqa: SIM115 - until the process ends

    signal.signal(signal.SIGTSTP, signal.SIG_IGN)  # between runs; a run has its own switch
    with StopFlag() as stop:
        try:
            with folder.held_by("worker", GUARD_PATIENCE_S) as lock, Queue.open(folder.queue) as q:
                os.set_inheritable(lock, True)
                return int(Worker(folder, q, lock, stop, say).work())
        except StopRequestedError as stopped:
            say("end", state="stopped", text=stopped.one_line(), code=int(stopped.code))
            return int(stopped.code)
        except RigError as error:
            say("end", state="failed", text=error.one_line(), code=int(error.code))
            return int(error.code)


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.exit(main(sys.argv[1:]))
