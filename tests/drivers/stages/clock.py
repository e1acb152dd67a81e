"""Bench time that passes only when something sleeps."""

from __future__ import annotations

from collections.abc import Callable

from simulated.ideal import IdealBench

from rig.core.clock import Clock


class BenchClock(Clock):
    """Time passes on the bench when something sleeps, and only then."""

    def __init__(self, bench: IdealBench):
        super().__init__()
        self.bench = bench
        self.slept: Callable[[], None] | None = None
        """Called after every stretch of time that has passed."""

    def now(self) -> float:
        return self.bench.now_us * 1e-6

    def _pass(self, seconds: float) -> None:
        self.bench.now_us += max(1, round(seconds * 1e6))
        if self.slept is not None:
            self.slept()
