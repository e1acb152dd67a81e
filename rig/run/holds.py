"""Holds: recoverable conditions that disturb a run without ending it.

A hold makes the bench safe; when it is over, the bench is armed again and the disturbed point is
retaken. Holds are counted, so that one that began and ended during a blocking call of the procedure
is still noticed afterwards.
"""

from __future__ import annotations

import signal
import threading
from dataclasses import dataclass
from types import FrameType
from typing import Self

from rig.bench.settings import HoldLimits
from rig.core.errors import ExitCode, RigError
from rig.core.units import counted

ON_HOLD, HOLD_OVER = "on-hold", "hold-over"
"""Codes of a run's events when it begins to wait, with its bench safe, and when it continues."""


class HoldError(RigError):
    """Raised in a wait that a hold disturbs; it is never the outcome of a run."""


class HoldLimitError(RigError):
    """Raised when a run has had more holds than the bench file allows. The bench is safe."""

    def __init__(self, message: str, hint: str):
        super().__init__(message, hint, ExitCode.INSTRUMENT)


@dataclass
class Disturbances:
    """Number of disturbances of a run by holds, pauses by the operator not included."""

    limits: HoldLimits
    holds: int = 0
    """Holds of the run so far."""
    presses: int = 0
    """Number of times that z has gone down to press the object so far."""
    at_point: int = 0
    """Holds since the point under way was begun for the first time, with its arming."""

    def begin_hold(self) -> None:
        """Count a hold."""
        self.holds += 1
        self.at_point += 1

    def check(self, point: str, reason: str) -> None:
        """Raise HoldLimitError where there have been more holds than allowed, at this point or in
        the run; `reason` is that of the latest."""
        for key, limit, number, where in (
            ("per_point", self.limits.per_point, self.at_point, f"at {point}"),
            ("per_run", self.limits.per_run, self.holds, "in this run"),
        ):
            if number > limit:
                raise HoldLimitError(
                    f"{counted(number, 'hold')} {where}, the limit is {limit} ([holds] {key} of "
                    f"the bench file), the latest: {reason}; in this run "
                    f"{counted(self.holds, 'hold')}, {counted(self.presses, 'press', 'presses')}",
                    "check the sensor's plug and cable, the contacts of the process interlock, and "
                    "whether the computer is too busy; then resume the run",
                )


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
