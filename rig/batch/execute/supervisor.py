"""The supervisor: keeps a worker at work, hears people, and outlives what the worker dies of.

It holds no bench. A worker that dies is followed by another one, once the guard of the first has
made the bench safe (`rig.batch.execute.worker`). It tells people (`rig.batch.report.notify`) and
outside monitors (`rig.batch.report.heartbeat`), and has runs worked on that have been taken
(`rig.batch.execute.postprocess`). What people ask for from other terminals lies in the queue;
signals of this terminal are its stop requests. Its word to the worker goes through a pipe, whose
end tells the worker that the supervisor has died.
"""

from __future__ import annotations

import json
import os
import selectors
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rig.batch.execute.postprocess import Afterwards, Answer, Job
from rig.batch.folder import BatchFolder
from rig.batch.plan.settings import BatchFile, Occasion
from rig.batch.queue import Queue
from rig.batch.report.heartbeat import Beat, Heartbeat, State
from rig.batch.report.notify import Notifier
from rig.core.errors import ExitCode
from rig.run.stopping import StopFlag

LOOK_S = 0.1
"""How often stop requests and other terminals are looked at."""
STARTING_S = 300.0
"""From a claim to its run's plan: boot, connect, compile for the first time. Who takes longer
hangs; from then on the run's guard watches."""
CRASHES = 3
"""So many workers in a row that die without having begun a run: it is no use."""


@dataclass
class Now:
    """What the batch is doing, for people and monitors."""

    state: str = "starting"
    text: str = ""
    run: int | None = None
    attempt: int | None = None
    condition: str = ""
    point: str = ""
    points: str = ""


HEARTBEAT: dict[str, State] = {
    "starting": "waiting",
    "pausing": "running",
    "paused": "holding",
    "held": "holding",
}
"""States of a heartbeat that are called otherwise here."""
CLOSING_S = 10.0
"""How long work on a run's file is waited for when somebody waits for the command to end."""
FILE_PATIENCE_S = 120.0
"""How long the file is waited for that an earlier supervisor had begun to have worked on."""
FEW_PROCESSORS = 4
"""On a computer with less, nothing else works while a run needs its ticks in real time."""


class Supervisor:
    """Runs a batch to its end."""

    def __init__(self, folder: BatchFolder, stop: StopFlag, tell: Callable[[str], None]):
        self._folder, self._stop, self._tell = folder, stop, tell
        self._now = Now()
        self._end: dict[str, Any] | None = None
        self._begun_a_run = False
        self._give_up: float | None = None
        self._runs = 0
        self._numbers: dict[Path, int] = {}
        """Of runs that are being worked on, by journal."""

    def run(self) -> ExitCode:
        """Have all runs taken; the exit code of the batch. ConfigurationError where another
        supervisor has it."""
        with (
            self._folder.held_by("supervisor", 0.0),
            self._folder.held_by("afterwards", FILE_PATIENCE_S) as lock,
            Queue.open(self._folder.queue) as self._queue,
            self._folder.log.open("ab") as self._log,
        ):
            self._batch = BatchFile.model_validate_json(self._queue.meta("file")).batch
            self._simulated = self._queue.meta("simulated") == "yes"
            self._ticks = bool(self._queue.meta("bench")) and (os.cpu_count() or 1) < FEW_PROCESSORS
            self._runs = sum(self._queue.counts().values())
            self._heartbeat = Heartbeat(self._folder.heartbeat)
            self._notifier = Notifier(self._batch.notify)
            self._afterwards = Afterwards((lock,))
            for number, procedure in self._queue.unprocessed():
                self._work_on(number, procedure)
            self._queue.set_meta("state", "running")
            self._queue.tell("info", f"begun by pid {os.getpid()}")
            self._notify("start", f"{self._queue.left().runs} runs to take")
            code = self._workers()
            self._finish_files()
            self._now.text = self._queue.meta("state")
            self._beat("ended")
            self._notify("end", self._now.text)
            for warning in self._notifier.close():
                self._tell(f"warning: {warning}")
            self._queue.close_log()
            return code

    def _workers(self) -> ExitCode:
        """One worker after the other, until one has come to the end."""
        crashes = 0
        while True:
            self._begun_a_run = False
            code = self._one_worker()
            if self._end is not None:
                return ExitCode(int(self._end["code"]))
            crashes = 0 if self._begun_a_run else crashes + 1
            how = f"signal {-code}" if code < 0 else f"exit code {code}"
            text = f"the worker died ({how}); see {self._folder.log}"
            self._queue.tell("error", text)
            self._tell(f"warning: {text}")
            if self._stop.requested is not None:
                self._queue.set_meta("state", "stopped: the worker died while it was stopped")
                return ExitCode.INTERNAL
            if crashes >= CRASHES:
                self._queue.set_meta("state", f"stopped: {text}")
                self._tell(f"error: {crashes} workers in a row died before they began a run")
                return ExitCode.INTERNAL

    # --- one worker -----------------------------------------------------------------------------

    def _one_worker(self) -> int:
        """Start a worker and listen to it until it has ended; its exit code."""
        worker = subprocess.Popen(
            [sys.executable, "-P", "-m", "rig.batch.execute.worker", str(self._folder.path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            start_new_session=True,  # a terminal's Ctrl-C is the supervisor's to pass on
        )
        assert worker.stdin is not None
        assert worker.stdout is not None
        os.set_blocking(worker.stdout.fileno(), False)
        self._queue.set_meta("worker", str(worker.pid))
        told_to_stop = False
        buffer = b""
        with selectors.DefaultSelector() as selector, worker:
            selector.register(worker.stdout, selectors.EVENT_READ)
            while True:
                if selector.select(LOOK_S):
                    chunk = worker.stdout.read(65536)
                    if chunk == b"":
                        break
                    *lines, buffer = (buffer + (chunk or b"")).split(b"\n")
                    for line in lines:
                        self._hear(line)
                if self._stop.requested is not None and not told_to_stop:
                    told_to_stop = True
                    asked = self._stop.requested
                    self._say(worker, f"signal {asked.value}", f"stop by {asked.name}")
                for word in self._queue.asked():
                    self._say(worker, word)
                self._look_around()
                if self._give_up is not None and time.monotonic() > self._give_up:
                    self._give_up = None
                    self._tell(f"warning: the worker was silent for {STARTING_S:g} s; killed")
                    worker.kill()
            worker.stdin.close()
        return worker.returncode

    def _say(self, worker: subprocess.Popen[bytes], word: str, told: str = "") -> None:
        """Pass on what was asked for, `told` to a person in these words."""
        assert worker.stdin is not None
        self._queue.tell("info", f"asked for: {told or word}")
        try:
            worker.stdin.write(word.encode() + b"\n")
            worker.stdin.flush()
        except OSError:  # it has died, which is seen at its other end
            pass

    def _hear(self, line: bytes) -> None:
        """One line from the worker; what a library has printed goes to the log."""
        try:
            said = json.loads(line)
            heard = getattr(self, f"_on_{said['event']}")
        except (ValueError, TypeError, KeyError, AttributeError):
            self._log.write(line + b"\n")
            self._log.flush()
            return
        heard(said)

    def _look_around(self) -> None:
        """What is to be done besides, often."""
        self._beat(HEARTBEAT.get(self._now.state, self._now.state))
        for answer in self._afterwards.answers():
            self._keep(answer)
        for warning in self._notifier.warnings():
            self._tell(f"warning: {warning}")

    def _beat(self, state: State | str) -> None:
        now = self._now
        message = now.text or f"{now.condition} {now.points}".strip()
        self._heartbeat.write(
            Beat(state, now.run or 0, self._runs, now.point, self._simulated, message)  # type: ignore[arg-type]
        )

    def _notify(self, occasion: Occasion, text: str) -> None:
        marker = "SIMULATED " if self._simulated else ""
        title = f"{marker}batch {self._batch.name}: {occasion}"
        details = {"folder": str(self._folder.path), "runs": self._queue.counts()}
        self._notifier.tell(occasion, title, text, details)

    # --- runs that have been taken ---------------------------------------------------------------

    def _work_on(self, number: int, procedure: str) -> None:
        journal = self._folder.journal(number, procedure)
        self._numbers[journal] = number
        self._afterwards.give(Job(journal, self._batch.figures, self._batch.detect))

    def _keep(self, answer: Answer) -> None:
        """What was made of a run."""
        number = self._numbers.pop(answer.journal) if answer.journal in self._numbers else None
        for text in (*answer.warnings, *filter(None, [answer.error])):
            self._queue.tell("warning", text)
            self._tell(f"warning: {text}")
        if number is not None and not answer.error:
            made = {
                "file": None if answer.file is None else answer.file.name,
                "processed": None if answer.processed is None else answer.processed.name,
                "figures": [figure.name for figure in answer.figures],
            }
            self._queue.set_processed(number, made)

    def _finish_files(self) -> None:
        """Have everything worked on that was taken; a stop request ends it with the file under
        way."""
        self._afterwards.go()
        if self._stop.requested is None and self._numbers:
            self._tell(f"run files still to be made: {len(self._numbers)} ...")
        while self._numbers and self._stop.requested is None and not self._afterwards.lost:
            self._beat("finishing")
            for answer in self._afterwards.answers():
                self._keep(answer)
            time.sleep(LOOK_S)
        for answer in self._afterwards.close(CLOSING_S):
            self._keep(answer)
        if self._numbers:
            self._tell(
                f"runs that are journals still: {len(self._numbers)}; "
                f"rig batch resume {self._folder.path} makes their files"
            )

    # --- what the worker says --------------------------------------------------------------------

    def _on_run(self, said: Mapping[str, Any]) -> None:
        self._begun_a_run = True
        self._queue.set_meta("state", "running")
        if self._ticks:
            self._afterwards.hold()
        self._give_up = time.monotonic() + STARTING_S
        self._now = Now("running", "", said["number"], said["attempt"], said["condition"])
        again = f", attempt {said['attempt']}" if said["attempt"] > 1 else ""
        self._tell(
            f"run {said['number']}/{self._runs} {said['condition']}{again}: "
            f"about {said['estimate_s']:.0f} s"
        )

    def _on_planned(self, said: Mapping[str, Any]) -> None:
        self._give_up = None
        self._now.points = f"{said['kept']}/{said['points']}"

    def _on_point(self, said: Mapping[str, Any]) -> None:
        self._now.point, self._now.points = said["point"], f"{said['done']}/{said['of']}"

    def _on_note(self, said: Mapping[str, Any]) -> None:
        if said["level"] != "info":
            self._tell(f"{said['level']}: {said['text']}")

    def _on_state(self, said: Mapping[str, Any]) -> None:
        self._set_state(said["state"], said.get("text", ""))

    def _set_state(self, state: str, text: str = "") -> None:
        self._now.state, self._now.text = state, text
        told = f"{state}: {text}" if text else state
        self._queue.set_meta("state", told)
        self._tell(told)

    def _on_hold(self, said: Mapping[str, Any]) -> None:
        self._set_state("held", said["text"])
        self._notify("hold", said["text"])
        self._tell(f"the bench is safe and waits; go on with: rig batch resume {self._folder.path}")

    def _on_finished(self, said: Mapping[str, Any]) -> None:
        self._give_up = None
        text = f"run {said['number']}: {said['ending']}, {said['points']} points"
        if said["reason"]:
            text += f": {said['reason']}"
        if said["again"]:
            text += "; it is tried again"
        self._tell(text)
        self._afterwards.go()
        if said["ending"] != "complete" or said["code"]:
            self._queue.tell("warning", text)
        if said["ending"] != "stopped" and not said["again"]:
            self._work_on(said["number"], said["procedure"])
            if said["ending"] != "complete":
                self._notify("failure", text)

    def _on_end(self, said: Mapping[str, Any]) -> None:
        self._end = dict(said)
