"""The supervisor: the command that a person started, which keeps a worker at work to the end.

It holds no bench, so it outlives what a worker dies of: another worker follows, once the guard of
the first has made the bench safe (`rig.batch.execute.worker`). It notifies people
(`rig.batch.report.notify`), writes the heartbeat for outside monitors
(`rig.batch.report.heartbeat`) and has the files of finished runs made
(`rig.batch.execute.postprocess`). Requests of other terminals are rows of the queue; signals of its
own terminal are stop requests. Its commands reach the worker through a pipe, from whose end the
worker learns that the supervisor has died.

All of that is done in a thread, because a disk that does not answer keeps a thread waiting where no
signal reaches it. The main thread, in which signals are handled, uses no disk: it passes the stop
requests of the terminal on to the worker.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from typing import IO, Any

from rig.batch.execute.disk_room import DeferredWrites
from rig.batch.execute.run_files import RunFiles
from rig.batch.execute.worker_process import WorkerProcess
from rig.batch.execute.worker_reports import STARTING_S, WorkerReports
from rig.batch.folder import BatchFolder
from rig.batch.plan.settings import BatchFile
from rig.batch.queue import Queue
from rig.batch.queue_file import QueueDamagedError, QueueWriteError
from rig.batch.report.heartbeat import Heartbeat, HeartbeatRecord, HeartbeatState
from rig.batch.report.people import People
from rig.core.errors import ExitCode
from rig.core.threads import start_thread
from rig.core.units import counted
from rig.run.stopping import WORDS, StopFlag

POLL_EVERY_S = 0.1
"""Interval in s at which stop requests, other terminals and background processes are polled."""
CRASHES = 3
"""Number of workers that may die in a row before a run has begun; then the batch ends."""
HEARTBEAT: dict[str, HeartbeatState] = {
    "starting": "waiting",
    "pausing": "running",
    "paused": "holding",
    "held": "holding",
}
"""The heartbeat's word for a state, where it differs."""
REQUESTS = {
    "go": "resume",
    "stop-now": "stop now",
    "stop-run": "stop of this run only",
    "stop-after-point": "stop after this point",
    "stop-after-run": "stop after this run",
}
"""A command's name for people, where it differs."""
BENCH_WAITS = ("waiting", "resting", "paused", "held")
"""States in which no run needs the computer: the files of finished runs may be begun."""
FINISHED = (ExitCode.DONE, ExitCode.FINISHED_WITH_FAILURES)
"""Exit codes of a batch whose runs are done."""
CLOSING_S = 10.0
"""Longest time in s that the files under way may take when a person has asked the batch to stop."""
FILE_PATIENCE_S = 120.0
"""Longest time in s that a process that has outlived an earlier supervisor may take for the files
under way."""


class Supervisor:
    """Runs a batch to its end. `say` gets lines for the person who started it, and returns at once:
    the supervisor passes stop requests on, and the worker waits for its signs of life."""

    def __init__(self, folder: BatchFolder, stop: StopFlag, say: Callable[[str], None]):
        self._folder, self._say = folder, say
        self._terminal = TerminalStop(stop)
        self.bench = ""
        """How the latest run left its bench, as a sentence, once `run` has returned; empty where
        that is not known."""

    def run(self) -> ExitCode:
        """Take all runs and return the exit code of the batch. Call it from the main thread, which
        passes stop requests on meanwhile. Raises ConfigurationError if another supervisor runs the
        batch."""
        ended: Future[ExitCode] = Future()

        def run() -> None:
            try:
                ended.set_result(self._supervise())
            except BaseException as error:  # noqa: BLE001 - it is raised in the main thread
                ended.set_exception(error)

        thread = threading.Thread(target=run, name="supervisor", daemon=True)
        start_thread(thread)
        while thread.is_alive():
            thread.join(POLL_EVERY_S)
            self._terminal.pass_on()
        return ended.result()

    def _supervise(self) -> ExitCode:
        folder = self._folder
        with folder.held_by("supervisor", 0.0), Queue.open(folder.queue) as queue:
            # Left by an earlier supervisor, for whom they were meant.
            requests_in(queue)
            with (
                folder.held_by("postprocess", FILE_PATIENCE_S) as lock,
                folder.log.open("ab", buffering=0) as log,
            ):
                work = _Supervision(folder, queue, log, lock, self._terminal, self._say)
                try:
                    return work.to_the_end()
                finally:
                    self.bench = work.bench


class TerminalStop:
    """Passes a stop request of the supervisor's own terminal on to the worker that runs, once. From
    any thread."""

    def __init__(self, stop: StopFlag):
        self._stop = stop
        self._passing_on = threading.Lock()
        self._worker: WorkerProcess | None = None
        """The worker that runs, if there is one."""
        self._stopping: WorkerProcess | None = None
        """The worker to which the request was passed on."""

    @property
    def requested(self) -> signal.Signals | None:
        """Signal by which a person has asked for the end of the batch, if one has."""
        return self._stop.requested

    def passed_on_to(self, worker: WorkerProcess) -> signal.Signals | None:
        """Return the signal that was passed on to this worker, or None."""
        return self._stop.requested if self._stopping is worker else None

    @contextlib.contextmanager
    def passed_to(self, worker: WorkerProcess) -> Iterator[None]:
        """Have the request passed on to this worker during the block."""
        self._worker = worker
        try:
            yield
        finally:
            with self._passing_on:  # its pipe is closed next
                self._worker = None

    def pass_on(self) -> None:
        """Pass a request on, if there is one that the worker did not get."""
        with self._passing_on:
            worker, number = self._worker, self._stop.requested
            if worker is not None and number is not None and worker is not self._stopping:
                self._stopping = worker
                worker.send(f"signal {number.value}")


class _Supervision:
    """What the supervisor's thread does, with the queue and the log of the batch open."""

    def __init__(
        self,
        folder: BatchFolder,
        queue: Queue,
        log: IO[bytes],
        lock: int,
        terminal: TerminalStop,
        say: Callable[[str], None],
    ):
        self._folder, self._queue, self._log = folder, queue, log
        self._terminal, self._say = terminal, say
        batch = BatchFile.model_validate_json(queue.meta("file")).batch
        self._simulated = queue.meta("simulated") == "yes"
        self._writes = DeferredWrites()
        self._heartbeat = Heartbeat(folder.heartbeat)
        self._people = People(folder, batch, queue, say, self._simulated)
        self._files = RunFiles(folder, batch, queue, self._record, say, log, lock)
        self._reports = WorkerReports(folder, queue, self._record, self._people, self._files)
        self._asked_to_end = False
        """True if another terminal has asked for the end of the batch."""

    @property
    def bench(self) -> str:
        """How the latest run left its bench, as a sentence."""
        return self._reports.bench

    def to_the_end(self) -> ExitCode:
        """Take all runs, make their files, and return the exit code of the batch."""
        self._files.add_all(self._queue.unprocessed())
        self._record(self._queue.set_meta, "state", "running")
        self._record(self._queue.add_event, "info", f"started (process {os.getpid()})")
        self._people.notify("start", f"{counted(self._queue.remaining().runs, 'run')} to do")
        self._reports.say_that_it_waits()
        code = self._workers()
        with contextlib.suppress(QueueDamagedError):
            left_by = self._finish_files()
            number = self._terminal.requested or left_by
            if code in FINISHED and number is not None and self._queue.unprocessed():
                code = ExitCode(128 + number)
        self._write_heartbeat("ended")
        self._people.notify("end", self._reports.progress.text)
        self._people.close()
        self._writes.flush()
        if self._writes.why:
            self._say(f"warning: {self._writes.why}; how the batch ended is not in it")
        self._queue.close_log()
        return code

    def _record(self, write: Callable[..., object], *values: object) -> None:
        """Write to the queue, later where the disk is full."""
        self._writes.add(lambda: write(*values))

    def _set_end(self, text: str) -> None:
        self._reports.progress.text = text
        self._record(self._queue.set_meta, "state", text)

    def _workers(self) -> ExitCode:
        """Run one worker after the other, until one has come to the end, and return its exit
        code."""
        crashes = 0
        while True:
            self._reports.begun_a_run = False
            code = self._one_worker()
            if self._reports.end is not None:
                return self._conclude(self._reports.end)
            self._reports.close_attempt()
            crashes = 0 if self._reports.begun_a_run else crashes + 1
            how = f"signal {-code}" if code < 0 else f"exit code {code}"
            text = f"the worker died ({how}); see {self._folder.log}"
            self._record(self._queue.add_event, "error", text)
            self._say(f"warning: {text}")
            if self._terminal.requested is not None or self._asked_to_end:
                self._set_end("stopped: the worker died while it was stopping")
                return ExitCode.INTERNAL
            if crashes >= CRASHES:
                self._set_end(f"stopped: {text}")
                self._say(f"error: {crashes} workers in a row died before they began a run")
                return ExitCode.INTERNAL
            self._reports.say_that_it_waits()

    def _conclude(self, end: Mapping[str, Any]) -> ExitCode:
        """Record why a worker has ended the batch, which it may have been unable to record; returns
        the exit code of the batch."""
        state, why = end["state"], end["text"]
        self._set_end(why if why.startswith(state) else f"{state}: {why}" if why else state)
        return ExitCode(int(end["code"]))

    # --- one worker -----------------------------------------------------------------------------

    def _one_worker(self) -> int:
        """Start a worker and listen to it until it has ended; returns its exit code."""
        stop_recorded = False
        with (
            WorkerProcess(self._folder.path, self._log, self._reports.waits_because) as worker,
            self._terminal.passed_to(worker),
        ):
            self._record(self._queue.set_meta, "worker", str(worker.pid))
            while (lines := worker.lines(POLL_EVERY_S)) is not None:
                for line in lines:
                    self._handle(line)
                if (number := self._terminal.requested) is not None and not stop_recorded:
                    stop_recorded = True
                    self._terminal.pass_on()
                    self._record_request(f"stop by {WORDS[number]}")
                for command in requests_in(self._queue):
                    self._pass_request_on(worker, command)
                self._poll()
                worker.beat()
                self._kill_if_silent(worker)
            # The worker may have ended by it while the disk kept this thread waiting.
            if not stop_recorded and (number := self._terminal.passed_on_to(worker)) is not None:
                self._record_request(f"stop by {WORDS[number]}")
        return worker.exit_code

    def _pass_request_on(self, worker: WorkerProcess, command: str) -> None:
        """Pass a request of another terminal on to the worker, and record it."""
        self._asked_to_end |= _ends_the_batch(command)
        if command == "pause":
            self._reports.wait_because(self._reports.waits_because or "a person has paused it")
        elif command == "go":
            self._reports.wait_because("")
        worker.send(command)  # before the record, which the disk may keep waiting
        self._record_request(REQUESTS.get(command.split()[0], command))

    def _kill_if_silent(self, worker: WorkerProcess) -> None:
        """Kill a worker that has not reported the plan of the run that it has claimed in time."""
        due_s = self._reports.plan_due_s
        if due_s is None or time.monotonic() <= due_s:
            return
        self._reports.plan_due_s = None
        self._say(f"warning: the worker was silent for {STARTING_S:g} s and was killed")
        worker.kill()

    def _record_request(self, request: str) -> None:
        self._record(self._queue.add_event, "info", f"{request} requested")

    def _handle(self, line: bytes) -> None:
        """Take over one line from the worker; one that is not a report goes to the log."""
        if not self._reports.take(line):
            with contextlib.suppress(OSError):
                self._log.write(line + b"\n")

    def _poll(self) -> None:
        """Do what has to be done often, apart from reading the worker's messages."""
        self._writes.flush()
        state = self._reports.progress.state
        self._write_heartbeat(HEARTBEAT.get(state, state))
        self._make_files(start=self._simulated or state in BENCH_WAITS)
        self._people.poll()

    def _write_heartbeat(self, state: HeartbeatState | str) -> None:
        reports = self._reports
        now = reports.progress
        message = now.text or f"{now.condition} {now.points}".strip()
        self._heartbeat.write(
            HeartbeatRecord(
                state,  # type: ignore[arg-type]
                now.run or 0,
                reports.runs,
                now.point,
                self._simulated,
                reports.holds.total,
                reports.presses.total,
                message,
            )
        )

    # --- files of finished runs -------------------------------------------------------------------

    def _make_files(self, *, start: bool) -> None:
        wanted = start and self._terminal.requested is None and not self._writes.why
        self._files.poll(start=wanted)

    def _finish_files(self) -> signal.Signals | None:
        """Make the files of all finished runs. A stop request leaves out those that are not under
        way; `rig batch resume` makes them. Return SIGTERM where another terminal has asked for
        that."""
        left_by = None
        if self._reports.files_were_left:
            self._files.add_all(self._queue.unprocessed())
        if self._terminal.requested is None and len(self._files):
            self._say(f"finishing: making the files of {counted(len(self._files), 'run')} ...")
        while len(self._files) and self._terminal.requested is None:
            if any(_ends_the_batch(command) for command in requests_in(self._queue)):
                left_by = signal.SIGTERM
                break
            self._write_heartbeat("finishing")
            self._make_files(start=True)
            time.sleep(POLL_EVERY_S)
        self._files.close(CLOSING_S)
        unprocessed = self._queue.unprocessed()
        missing = self._folder.not_compiled(unprocessed)
        again = self._folder.resume_command
        if missing:
            self._say(f"not compiled yet: {counted(missing, 'run file')}; compile with: {again}")
        if compiled := len(unprocessed) - missing:
            runs = counted(compiled, "run")
            self._say(f"figures and results still to be made: {runs}; make them with: {again}")
        return left_by


def requests_in(queue: Queue) -> list[str]:
    """Take the requests of other terminals from the queue; on a full disk they stay there."""
    try:
        return queue.take_requests()
    except (QueueWriteError, QueueDamagedError):
        return []


def _ends_the_batch(command: str) -> bool:
    """Return whether a request of another terminal is for the end of the whole batch."""
    return command.startswith("stop-") and not command.startswith("stop-run")
