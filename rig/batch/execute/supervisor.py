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
import json
import os
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any

from rig.batch.execute.disk_room import DeferredWrites
from rig.batch.execute.run_files import RunFiles
from rig.batch.execute.worker_process import WorkerProcess
from rig.batch.folder import BatchFolder
from rig.batch.plan.settings import BatchFile, Occasion
from rig.batch.queue import Queue
from rig.batch.queue_file import QueueDamagedError, QueueWriteError
from rig.batch.queue_records import HOLDS, PRESSES, WAITS_FOR_A_PERSON
from rig.batch.report.heartbeat import Heartbeat, HeartbeatRecord, HeartbeatState
from rig.batch.report.notify import Notifier
from rig.core.errors import ExitCode
from rig.core.text import in_shell
from rig.core.threads import start_thread
from rig.core.units import counted
from rig.run.stopping import WORDS, StopFlag

POLL_EVERY_S = 0.1
"""Interval in s at which stop requests, other terminals and background processes are polled."""
STARTING_S = 300.0
"""Time limit from a claim to its run's plan: boot, connect, compile for the first time. From then
on the run's guard watches."""
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
CLOSING_S = 10.0
"""Longest time in s that the files under way may take when a person has asked the batch to stop."""
FILE_PATIENCE_S = 120.0
"""Longest time in s that a process that has outlived an earlier supervisor may take for the files
under way."""


@dataclass
class BatchProgress:
    """The present activity of a batch, for people and monitors."""

    state: str = "starting"
    text: str = ""
    run: int | None = None
    attempt: int | None = None
    condition: str = ""
    point: str = ""
    points: str = ""


@dataclass
class _Count:
    """A number that is counted over all attempts of a batch."""

    name: str
    """Name of its entry in the queue."""
    before: int = 0
    """Count in the attempts that have ended."""
    now: int = 0
    """Count in the attempt under way."""

    @property
    def total(self) -> int:
        """Count in all attempts."""
        return self.before + self.now

    def close_attempt(self) -> None:
        """Add the count of the attempt that has ended to those before."""
        self.before, self.now = self.total, 0


class Supervisor:
    """Runs a batch to its end. `say` gets lines for the person who started it, and returns at once:
    the supervisor passes stop requests on, and the worker waits for its signs of life."""

    def __init__(self, folder: BatchFolder, stop: StopFlag, say: Callable[[str], None]):
        self._folder, self._stop, self._say = folder, stop, say
        self._writes = DeferredWrites()
        self._progress = BatchProgress()
        self._end: dict[str, Any] | None = None
        self._begun_a_run = False
        self._give_up: float | None = None
        self._runs = 0
        self._passing_on = threading.Lock()
        self._worker: WorkerProcess | None = None
        """The worker that runs, if there is one."""
        self._stopping: WorkerProcess | None = None
        """The worker to which a stop request of the terminal was passed on."""
        self._asked_to_end = False
        """True if another terminal has asked for the end of the batch."""
        self._held_for = ""
        """Reason why the batch was held last, until a run has ended."""
        self._waits_because = ""
        """Reason why the batch waits until a person resumes it; empty where it does not. It is kept
        here, and in the queue, because the worker that waits may die, and this process, too."""
        self.bench = ""
        """How the latest run left its bench, as a sentence; empty where that is not known."""
        self._files_were_left = False
        """True if files of runs may not have been made, because the disk was full or the batch's
        folder away."""

    def run(self) -> ExitCode:
        """Take all runs and return the exit code of the batch. Call it from the main thread, which
        passes stop requests on meanwhile. Raises ConfigurationError if another supervisor runs the
        batch."""
        ended: Future[ExitCode] = Future()

        def run() -> None:
            try:
                ended.set_result(self._run())
            except BaseException as error:  # noqa: BLE001 - it is raised in the main thread
                ended.set_exception(error)

        thread = threading.Thread(target=run, name="supervisor", daemon=True)
        start_thread(thread)
        while thread.is_alive():
            thread.join(POLL_EVERY_S)
            self._pass_stop_on()
        return ended.result()

    def _run(self) -> ExitCode:
        with (
            self._folder.held_by("supervisor", 0.0),
            Queue.open(self._folder.queue) as self._queue,
        ):
            self._requests()  # left by an earlier supervisor: they were not meant for this one
            self._waits_because = self._queue.meta(WAITS_FOR_A_PERSON)
            return self._supervise()

    def _supervise(self) -> ExitCode:
        with (
            self._folder.held_by("postprocess", FILE_PATIENCE_S) as lock,
            self._folder.log.open("ab", buffering=0) as self._log,
        ):
            self._batch = BatchFile.model_validate_json(self._queue.meta("file")).batch
            self._simulated = self._queue.meta("simulated") == "yes"
            self._runs = sum(self._queue.counts().values())
            self._holds, self._presses = (
                _Count(name, int(self._queue.meta(name, "0"))) for name in (HOLDS, PRESSES)
            )
            self._heartbeat = Heartbeat(self._folder.heartbeat)
            self._notifier = Notifier(self._batch.notify)
            self._files = RunFiles(
                self._folder, self._batch, self._queue, self._record, self._say, self._log, lock
            )
            self._files.add_all(self._queue.unprocessed())
            self._record(self._queue.set_meta, "state", "running")
            self._record(self._queue.add_event, "info", f"started (process {os.getpid()})")
            self._notify("start", f"{counted(self._queue.remaining().runs, 'run')} to do")
            self._say_that_it_waits()
            code = self._workers()
            with contextlib.suppress(QueueDamagedError):
                self._finish_files()
            self._write_heartbeat("ended")
            self._notify("end", self._progress.text)
            for warning in self._notifier.close():
                self._say(f"warning: {warning}")
            self._writes.flush()
            if self._writes.why:
                self._say(f"warning: {self._writes.why}; how the batch ended is not in it")
            self._queue.close_log()
            return code

    def _record(self, write: Callable[..., object], *values: object) -> None:
        """Write to the queue, later where the disk is full."""
        self._writes.add(lambda: write(*values))

    def _set_end(self, text: str) -> None:
        self._progress.text = text
        self._record(self._queue.set_meta, "state", text)

    def _workers(self) -> ExitCode:
        """Run one worker after the other, until one has come to the end, and return its exit
        code."""
        crashes = 0
        while True:
            self._begun_a_run = False
            code = self._one_worker()
            if self._end is not None:
                return self._conclude(self._end)
            self._holds.close_attempt()
            self._presses.close_attempt()
            crashes = 0 if self._begun_a_run else crashes + 1
            how = f"signal {-code}" if code < 0 else f"exit code {code}"
            text = f"the worker died ({how}); see {self._folder.log}"
            self._record(self._queue.add_event, "error", text)
            self._say(f"warning: {text}")
            if self._stop.requested is not None or self._asked_to_end:
                self._set_end("stopped: the worker died while it was stopping")
                return ExitCode.INTERNAL
            if crashes >= CRASHES:
                self._set_end(f"stopped: {text}")
                self._say(f"error: {crashes} workers in a row died before they began a run")
                return ExitCode.INTERNAL
            self._say_that_it_waits()

    def _wait_because(self, reason: str) -> None:
        self._waits_because = reason
        self._record(self._queue.set_meta, WAITS_FOR_A_PERSON, reason)

    def _say_that_it_waits(self) -> None:
        if self._waits_because:
            self._say(
                f"the batch still waits: {self._waits_because}; it continues with: "
                f"rig batch resume {in_shell(self._folder.path)}"
            )

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
            WorkerProcess(self._folder.path, self._log, self._waits_because) as worker,
            self._stopped_with_the_batch(worker),
        ):
            self._record(self._queue.set_meta, "worker", str(worker.pid))
            while (lines := worker.lines(POLL_EVERY_S)) is not None:
                for line in lines:
                    self._handle(line)
                if self._stop.requested is not None and not stop_recorded:
                    stop_recorded = True
                    self._pass_stop_on()
                    self._record_request(f"stop by {WORDS[self._stop.requested]}")
                for command in self._requests():
                    self._asked_to_end |= _ends_the_batch(command)
                    if command == "pause":
                        self._wait_because(self._waits_because or "a person has paused it")
                    elif command == "go":
                        self._wait_because("")
                    self._send(worker, command, REQUESTS.get(command.split()[0], command))
                self._poll()
                worker.beat()
                if self._give_up is not None and time.monotonic() > self._give_up:
                    self._give_up = None
                    self._say(f"warning: the worker was silent for {STARTING_S:g} s and was killed")
                    worker.kill()
            # The worker may have ended by it while the disk kept this thread waiting.
            if self._stopping is worker and not stop_recorded and self._stop.requested is not None:
                self._record_request(f"stop by {WORDS[self._stop.requested]}")
        return worker.exit_code

    def _requests(self) -> list[str]:
        try:
            return self._queue.take_requests()
        except (QueueWriteError, QueueDamagedError):  # on a full disk they stay
            return []

    def _send(self, worker: WorkerProcess, command: str, request: str) -> None:
        """Pass a command on to the worker; `request` says for people what was requested."""
        worker.send(command)  # first: the disk may keep the record waiting
        self._record_request(request)

    def _record_request(self, request: str) -> None:
        self._record(self._queue.add_event, "info", f"{request} requested")

    @contextlib.contextmanager
    def _stopped_with_the_batch(self, worker: WorkerProcess) -> Iterator[None]:
        """Have stop requests of the terminal passed on to this worker during the block."""
        self._worker = worker
        try:
            yield
        finally:
            with self._passing_on:  # its pipe is closed next
                self._worker = None

    def _pass_stop_on(self) -> None:
        """Pass a stop request of the terminal on to the worker, once. From any thread."""
        with self._passing_on:
            worker, number = self._worker, self._stop.requested
            if worker is not None and number is not None and worker is not self._stopping:
                self._stopping = worker
                worker.send(f"signal {number.value}")

    def _handle(self, line: bytes) -> None:
        """One line from the worker; one that is not a report goes to the log."""
        try:
            event = json.loads(line)
            handler = getattr(self, f"_on_{event['event']}")
        except (ValueError, TypeError, KeyError, AttributeError):
            with contextlib.suppress(OSError):
                self._log.write(line + b"\n")
            return
        handler(event)

    def _poll(self) -> None:
        """Do what has to be done often, apart from reading the worker's messages."""
        self._writes.flush()
        self._write_heartbeat(HEARTBEAT.get(self._progress.state, self._progress.state))
        self._make_files(start=self._simulated or self._progress.state in BENCH_WAITS)
        for warning in self._notifier.poll():
            self._say(f"warning: {warning}")

    def _write_heartbeat(self, state: HeartbeatState | str) -> None:
        now = self._progress
        message = now.text or f"{now.condition} {now.points}".strip()
        self._heartbeat.write(
            HeartbeatRecord(
                state,  # type: ignore[arg-type]
                now.run or 0,
                self._runs,
                now.point,
                self._simulated,
                self._holds.total,
                self._presses.total,
                message,
            )
        )

    def _notify(self, occasion: Occasion, text: str) -> None:
        marker = "SIMULATED " if self._simulated else ""
        title = f"{marker}batch {self._batch.name}: {occasion}"
        details: dict[str, Any] = {"folder": str(self._folder.path)}
        with contextlib.suppress(QueueDamagedError):
            details["runs"] = self._queue.counts()
        self._notifier.notify(occasion, title, text, details)

    # --- files of finished runs -------------------------------------------------------------------

    def _make_files(self, *, start: bool) -> None:
        wanted = start and self._stop.requested is None and not self._writes.why
        self._files.poll(start=wanted)

    def _finish_files(self) -> None:
        """Make the files of all finished runs. A stop request leaves out those that are not under
        way; `rig batch resume` makes them."""
        if self._files_were_left:
            self._files.add_all(self._queue.unprocessed())
        if self._stop.requested is None and len(self._files):
            self._say(f"finishing: making the files of {counted(len(self._files), 'run')} ...")
        while len(self._files) and self._stop.requested is None:
            if any(_ends_the_batch(command) for command in self._requests()):
                break
            self._write_heartbeat("finishing")
            self._make_files(start=True)
            time.sleep(POLL_EVERY_S)
        self._files.close(CLOSING_S)
        unprocessed = self._queue.unprocessed()
        missing = self._folder.not_compiled(unprocessed)
        again = f"rig batch resume {in_shell(self._folder.path)}"
        if missing:
            self._say(f"not compiled yet: {counted(missing, 'run file')}; compile with: {again}")
        if compiled := len(unprocessed) - missing:
            runs = counted(compiled, "run")
            self._say(f"figures and results still to be made: {runs}; make them with: {again}")

    # --- events from the worker -------------------------------------------------------------------

    def _on_run(self, event: Mapping[str, Any]) -> None:
        self._begun_a_run = True
        self.bench = ""
        self._record(self._queue.set_meta, "state", "running")
        self._give_up = time.monotonic() + STARTING_S
        number, attempt = event["number"], event["attempt"]
        self._progress = BatchProgress("running", "", number, attempt, event["condition"])
        again = f", attempt {attempt}" if attempt > 1 else ""
        self._say(
            f"run {number}/{self._runs} {event['condition']}{again}: "
            f"about {event['estimate_s']:.0f} s"
        )

    def _on_planned(self, event: Mapping[str, Any]) -> None:
        self._give_up = None
        self._progress.points = f"{event['kept']}/{event['points']}"

    def _on_point(self, event: Mapping[str, Any]) -> None:
        self._progress.point = event["point"]
        self._progress.points = f"{event['done']}/{event['of']}"

    def _on_note(self, event: Mapping[str, Any]) -> None:
        if event["level"] != "info":
            self._say(f"{event['level']}: {event['text']}")

    def _count(self, event: Mapping[str, Any]) -> None:
        """Take over the numbers of holds and presses of the attempt under way."""
        for count in (self._holds, self._presses):
            if count.now != event[count.name]:
                count.now = event[count.name]
                self._record(self._queue.set_meta, count.name, str(count.total))

    def _on_disturbed(self, event: Mapping[str, Any]) -> None:
        """Record that a run is on hold; people are notified of the first hold of a run only."""
        now, holds = self._progress, event["holds"]
        self._count(event)
        counts = f"{counted(holds, 'hold')}, {counted(event['presses'], 'press', 'presses')}"
        text = f"run {now.run} at {now.points or 'its start'}: {event['reason']} ({counts})"
        self._record(self._queue.add_event, "warning", f"hold: {text}")
        if holds == 1:
            self._notify(
                "hold", f"{text}; the bench is safe, and the run continues when that is over"
            )

    def _on_state(self, event: Mapping[str, Any]) -> None:
        self._set_state(event["state"], event.get("text", ""))

    def _set_state(self, state: str, text: str = "") -> None:
        self._progress.state, self._progress.text = state, text
        shown = f"{state}: {text}" if text else state
        self._record(self._queue.set_meta, "state", shown)
        self._say(shown)

    def _on_hold(self, event: Mapping[str, Any]) -> None:
        """Record that the batch is held; people are notified once for each reason until another run
        has ended."""
        self._set_state("held", event["text"])
        self._files_were_left |= bool(event["by_itself"])
        if not event["by_itself"]:  # otherwise another worker finds out itself whether it is over
            self._wait_because(event["text"])
        if event["text"] != self._held_for:
            self._held_for = event["text"]
            self._notify("hold", event["text"])
        by_itself = f"when {event['by_itself']}, or " if event["by_itself"] else ""
        self._say(
            f"{event['bench']} and the batch waits; it continues {by_itself}with: "
            f"rig batch resume {in_shell(self._folder.path)}"
        )

    def _on_finished(self, event: Mapping[str, Any]) -> None:
        self._give_up = None
        self._held_for = ""
        self.bench = event["bench"]
        self._count(event)
        self._holds.close_attempt()
        self._presses.close_attempt()
        text = f"run {event['number']}: {event['ending']}, {event['points']}"
        if event["reason"]:
            text += f": {event['reason']}"
        if event["again"]:
            text += "; it stays queued for another attempt"
        self._say(text)
        if event["ending"] != "complete" or event["code"]:
            self._record(self._queue.add_event, "warning", text)
        if event["ending"] != "stopped" and not event["again"]:
            self._files.add(event["number"], event["procedure"])
            if event["ending"] != "complete":
                self._notify("failure", text)

    def _on_end(self, event: Mapping[str, Any]) -> None:
        self._end = dict(event)


def _ends_the_batch(command: str) -> bool:
    """Return whether a request of another terminal is for the end of the whole batch."""
    return command.startswith("stop-") and not command.startswith("stop-run")
