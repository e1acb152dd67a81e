"""A clock that a test moves by hand."""

from __future__ import annotations

from rig.core.clock import Clock


class HandClock(Clock):
    """Time passes where it is waited for and where a test says so."""

    is_virtual = True

    def __init__(self) -> None:
        super().__init__()
        self._now = 0.0
        self.woken_late_s = 0.0

    def now(self) -> float:
        return self._now

    def spend(self, seconds: float) -> None:
        self._now += seconds

    def _pass(self, seconds: float) -> None:
        self._now += seconds + self.woken_late_s
