"""What the workers of a batch report: taken over into its queue, and passed on to people."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from rig.batch.execute.run_files import Record, RunFiles
from rig.batch.folder import BatchFolder
from rig.batch.queue import Queue
from rig.batch.queue_records import HOLDS, PRESSES, WAITS_FOR_A_PERSON
from rig.batch.report.people import People
from rig.core.units import counted

STARTING_S = 300.0
"""Time limit from a claim to its run's plan: boot, connect, compile for the first time. From then
on the run's guard watches."""


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
class AttemptCount:
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


class WorkerReports:
    """What the workers of a batch have reported so far, and how the batch stands by it."""

    def __init__(
        self,
        folder: BatchFolder,
        queue: Queue,
        record: Record,
        people: People,
        files: RunFiles,
    ):
        """Take over reports into `queue`, by `record`. `files` has the files of finished runs
        made."""
        self._folder, self._queue, self._record = folder, queue, record
        self._people, self._files = people, files
        self.runs = sum(queue.counts().values())
        """Number of runs of the batch."""
        self.progress = BatchProgress()
        self.holds, self.presses = (
            AttemptCount(name, int(queue.meta(name, "0"))) for name in (HOLDS, PRESSES)
        )
        self.waits_because = queue.meta(WAITS_FOR_A_PERSON)
        """Reason why the batch waits until a person resumes it; empty where it does not. It is kept
        here, and in the queue, because the worker that waits may die, and this process, too."""
        self.bench = ""
        """How the latest run left its bench, as a sentence; empty where that is not known."""
        self.begun_a_run = False
        """True if the present worker has begun a run."""
        self.plan_due_s: float | None = None
        """Time of `time.monotonic` until which the run that was claimed has to report its plan;
        None if none is awaited."""
        self.end: dict[str, Any] | None = None
        """The report of a worker that has come to the end of the batch."""
        self.files_were_left = False
        """True if files of runs may not have been made, because the disk was full or the batch's
        folder away."""
        self._held_for = ""
        """Reason why the batch was held last, until a run has ended."""
        self._handlers: dict[str, Callable[[Mapping[str, Any]], None]] = {
            "run": self._on_run,
            "planned": self._on_planned,
            "point": self._on_point,
            "note": self._on_note,
            "pressed": self._count,
            "disturbed": self._on_disturbed,
            "state": self._on_state,
            "hold": self._on_hold,
            "finished": self._on_finished,
            "end": self._on_end,
        }

    def close_attempt(self) -> None:
        """Add the holds and presses of the attempt that has ended to those of earlier ones."""
        self.holds.close_attempt()
        self.presses.close_attempt()

    def take(self, line: bytes) -> bool:
        """Take over one line from a worker; returns False if it is not a report."""
        try:
            event = json.loads(line)
            handler = self._handlers[event["event"]]
        except (ValueError, TypeError, KeyError):
            return False
        handler(event)
        return True

    def wait_because(self, reason: str) -> None:
        """Have the batch wait until a person resumes it, for this reason; if empty, for none."""
        self.waits_because = reason
        self._record(self._queue.set_meta, WAITS_FOR_A_PERSON, reason)

    def say_that_it_waits(self) -> None:
        """Say that the batch waits for a person, if it does, and how it is resumed."""
        if self.waits_because:
            self._people.say(
                f"the batch still waits: {self.waits_because}; it continues with: "
                f"{self._folder.resume_command}"
            )

    def _on_run(self, event: Mapping[str, Any]) -> None:
        self.begun_a_run = True
        self.bench = ""
        self._record(self._queue.set_meta, "state", "running")
        self.plan_due_s = time.monotonic() + STARTING_S
        number, attempt = event["number"], event["attempt"]
        self.progress = BatchProgress("running", "", number, attempt, event["condition"])
        again = f", attempt {attempt}" if attempt > 1 else ""
        self._people.say(
            f"run {number}/{self.runs} {event['condition']}{again}: "
            f"about {event['estimate_s']:.0f} s"
        )

    def _on_planned(self, event: Mapping[str, Any]) -> None:
        self.plan_due_s = None
        self.progress.points = f"{event['kept']}/{event['points']}"

    def _on_point(self, event: Mapping[str, Any]) -> None:
        self.progress.point = event["point"]
        self.progress.points = f"{event['done']}/{event['of']}"

    def _on_note(self, event: Mapping[str, Any]) -> None:
        if event["level"] != "info":
            self._people.say(f"{event['level']}: {event['text']}")

    def _count(self, event: Mapping[str, Any]) -> None:
        """Take over the numbers of holds and presses of the attempt under way, as far as they are
        reported."""
        for count in (self.holds, self.presses):
            if count.now != (number := event.get(count.name, count.now)):
                count.now = number
                self._record(self._queue.set_meta, count.name, str(count.total))

    def _on_disturbed(self, event: Mapping[str, Any]) -> None:
        """Record that a run is on hold; people are notified of the first hold of a run only."""
        now, holds = self.progress, event["holds"]
        self._count(event)
        counts = f"{counted(holds, 'hold')}, {counted(event['presses'], 'press', 'presses')}"
        text = f"run {now.run} at {now.points or 'its start'}: {event['reason']} ({counts})"
        self._record(self._queue.add_event, "warning", f"hold: {text}")
        if holds == 1:
            self._people.notify(
                "hold", f"{text}; the bench is safe, and the run continues when that is over"
            )

    def _on_state(self, event: Mapping[str, Any]) -> None:
        self._set_state(event["state"], event.get("text", ""))

    def _set_state(self, state: str, text: str = "") -> None:
        self.progress.state, self.progress.text = state, text
        shown = f"{state}: {text}" if text else state
        self._record(self._queue.set_meta, "state", shown)
        self._people.say(shown)

    def _on_hold(self, event: Mapping[str, Any]) -> None:
        """Record that the batch is held; people are notified once for each reason until another run
        has ended."""
        self._set_state("held", event["text"])
        self.files_were_left |= bool(event["by_itself"])
        if not event["by_itself"]:  # otherwise another worker finds out itself whether it is over
            self.wait_because(event["text"])
        if event["text"] != self._held_for:
            self._held_for = event["text"]
            self._people.notify("hold", event["text"])
        if not event.get("by_resume", True):  # the reason says what to do
            self._people.say(f"{event['bench']} and the batch waits")
            return
        by_itself = f"when {event['by_itself']}, or " if event["by_itself"] else ""
        self._people.say(
            f"{event['bench']} and the batch waits; it continues {by_itself}with: "
            f"{self._folder.resume_command}"
        )

    def _on_finished(self, event: Mapping[str, Any]) -> None:
        self.plan_due_s = None
        self._held_for = ""
        self.bench = event["bench"]
        self._count(event)
        self.close_attempt()
        text = f"run {event['number']}: {event['ending']}, {event['points']}"
        if event["reason"]:
            text += f": {event['reason']}"
        over = event["state"] != "queued"
        if not over and event["ending"] != "stopped":
            text += "; it stays queued for another attempt"
        self._people.say(text)
        if event["ending"] != "complete" or event["code"]:
            self._record(self._queue.add_event, "warning", text)
        if over:
            self._files.add(event["number"], event["procedure"])
        if over and event["ending"] not in ("complete", "stopped"):
            self._people.notify("failure", text)

    def _on_end(self, event: Mapping[str, Any]) -> None:
        self.end = dict(event)
