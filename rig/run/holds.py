"""Holds: recoverable conditions that disturb a run without ending it.

A hold makes the bench safe; when it is over, the bench is armed again and the disturbed point is
retaken. Holds are counted, so that one that began and ended during a blocking call of the procedure
is still noticed afterwards.
"""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Self

from rig.core.errors import RigError


class HoldError(RigError):
    """Raised in a wait that a hold disturbs; it is never the outcome of a run."""


class Holds:
    """The holds of one run: which are in force, and how many there have been."""

    def __init__(self) -> None:
        # Reentrant: a signal handler may run while the lock is held.
        self._lock = threading.RLock()
        self._active: dict[str, None] = {}
        self._count = 0
        self._seen = 0
        self._latest = ""

    @property
    def active(self) -> tuple[str, ...]:
        """Reasons of the holds in force, oldest first."""
        return tuple(self._active)

    @property
    def count(self) -> int:
        """Number of holds so far."""
        return self._count

    def begin(self, reason: str) -> None:
        """Begin a hold, from any thread; does nothing if it is in force already."""
        with self._lock:
            if reason not in self._active:
                self._active[reason] = None
                self._count += 1
                self._latest = reason

    def end(self, reason: str) -> None:
        """End a hold, from any thread."""
        with self._lock:
            self._active.pop(reason, None)

    def check(self) -> None:
        """Raise HoldError if a hold is in force, or has begun since the last `acknowledge`."""
        if self._active or self._count != self._seen:
            raise HoldError(self._latest)

    def acknowledge(self) -> None:
        """Note that every hold so far has been dealt with."""
        with self._lock:
            self._seen = self._count


PAUSE = "paused by the operator"
_SIGNALS = (signal.SIGTSTP, signal.SIGCONT)


class PauseSwitch:
    """Pauses and resumes a run by Ctrl-Z, in turn; ``kill -CONT`` resumes it. Main thread only."""

    def __init__(self, holds: Holds):
        self._holds = holds
        self._previous: dict[signal.Signals, object] = {}

    def __enter__(self) -> Self:
        for number in _SIGNALS:
            self._previous[number] = signal.signal(number, self._switch)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)  # type: ignore[arg-type]

    def _switch(self, number: int, _: FrameType | None) -> None:
        if number == signal.SIGCONT or PAUSE in self._holds.active:
            self._holds.end(PAUSE)
        else:
            self._holds.begin(PAUSE)
