"""What the worker hears from its supervisor, and what it reports of a run."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Sequence, Set
from typing import TYPE_CHECKING

from rig.run.observers import PAUSED, RunObserver
from rig.run.stopping import StopFlag

if TYPE_CHECKING:
    from rig.run.points import Point, Reading

STOP_NOW = "stopped by rig batch stop --now, or by STOP on the page"
SUPERVISOR_DIED = "stopped: its supervisor died, and the worker then ended in order"
"""What has ended a batch, which the worker hears as a signal of no meaning to people."""

SendEvent = Callable[..., None]
"""Sends one event to the supervisor, with its fields by name."""


class CommandListener:
    """Reads the supervisor's commands in a thread of its own; the main thread acts on them. With
    `paused_because`, the reason of a pause that an earlier worker left, the batch is paused from
    the beginning."""

    def __init__(self, stop: StopFlag, send: SendEvent, paused_because: str = ""):
        self._stop, self._send = stop, send
        self.paused_because = paused_because
        self.paused = threading.Event()
        self.for_a_person = bool(paused_because)
        """True if the pause ends only when a person resumes the batch, whatever else is over."""
        if paused_because:
            self.paused.set()
        self.stop_after_run = False
        self.in_run = False
        """True from the claim of a run to its end."""
        self.run: int | None = None
        """Number of the run under way, or of the latest."""
        self.ending = False
        """True if the batch was asked to end."""
        self.ended_by = ""
        """What has ended the batch, for people, where it was not the signal of a terminal."""
        self._run_given_up = False
        self.heard_s = time.monotonic()
        """Time of the supervisor's latest word, by the monotonic clock."""
        threading.Thread(target=self._listen, name="commands", daemon=True).start()

    def _listen(self) -> None:
        rest = b""
        while chunk := os.read(0, 4096):  # unbuffered: Python ends while this still listens
            self.heard_s = time.monotonic()
            *lines, rest = (rest + chunk).split(b"\n")
            for line in lines:
                self._handle(line.decode())
        if not self.ending:
            self.ended_by = SUPERVISOR_DIED
        self.ending = True
        os.kill(os.getpid(), signal.SIGHUP)

    def _handle(self, command: str) -> None:
        if command.startswith("signal "):
            self.ending = True
            os.kill(os.getpid(), int(command.removeprefix("signal ")))
        elif command == "stop-now":
            if not self.ending:
                self.ended_by = STOP_NOW
            self.ending = True
            os.kill(os.getpid(), signal.SIGTERM)
        elif command.split()[:1] == ["stop-run"]:
            meant = command.split()[1:] in ([], [str(self.run)])  # a different one may run by now
            if self.in_run and not self.ending and meant:
                self._run_given_up = True
                os.kill(os.getpid(), signal.SIGTERM)
        elif command == "stop-after-point":
            self._stop.after_point = self.stop_after_run = True
        elif command == "stop-after-run":
            self.stop_after_run = True
        elif command == "pause":
            self.for_a_person = True  # in a hold that ends by itself as well
            if self.paused.is_set():
                return
            self.paused.set()
            self._send("state", state="pausing")
            if self.in_run:  # a run that still connects takes no notice: the batch waits after it
                os.kill(os.getpid(), signal.SIGTSTP)
        elif command == "go":
            if self.paused.is_set():
                self._send("state", state="running")
            self.paused_because, self.for_a_person = "", False
            self.paused.clear()
            if self.in_run:
                os.kill(os.getpid(), signal.SIGCONT)

    def take_given_up(self) -> bool:
        """Return, once, whether the run that has just ended was to end by itself: the batch then
        continues. A batch that was asked to end as well ends."""
        given_up, self._run_given_up = self._run_given_up, False
        if not given_up or self.ending:
            return False
        self._stop.requested = None
        return True


class Reporter(RunObserver):
    """A run's progress, for the supervisor."""

    def __init__(self, send: SendEvent):
        self._send = send

    def planned(self, points: Sequence[Point], recorded: Set[str], overhead_s: float) -> None:
        """See `rig.run.observers.RunObserver`."""
        self._send("planned", points=len(points), kept=len(recorded))

    def point_recorded(self, number: int, total: int, point: Point, reading: Reading) -> None:
        """See `rig.run.observers.RunObserver`."""
        self._send("point", done=number, of=total, point=point.id)

    def event(self, level: str, message: str) -> None:
        """See `rig.run.observers.RunObserver`."""
        self._send("note", level=level, text=message)

    def hold_begun(self, reason: str, holds: int, presses: int) -> None:
        """See `rig.run.observers.RunObserver`."""
        self._send("disturbed", reason=reason, holds=holds, presses=presses)

    def pressed(self, presses: int) -> None:
        """See `rig.run.observers.RunObserver`. Nothing else counts the presses of a worker that
        dies."""
        self._send("pressed", presses=presses)

    def state(self, name: str) -> None:
        """See `rig.run.observers.RunObserver`. That it runs again is said when it is asked for."""
        if name == PAUSED:
            self._send("state", state="paused", text="the bench is safe")
