"""The time that a batch goes by: the wall's, or that of a simulated bench that it starts itself.

A simulated bench's time is slaved, and a rest on it costs nothing; its night begins when the batch
is begun and is as long as its runs and rests are.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import datetime, timedelta
from typing import Protocol

LOOK_S = 0.2
"""How often a rest looks whether it is over."""


class BatchClock(Protocol):
    """What time it is, and resting."""

    def now(self) -> datetime:
        """The time of the day, with its offset from UTC."""
        ...

    def used(self, bench_s: float) -> None:
        """A run has taken so much bench time."""
        ...

    def rest(self, seconds: float, look: Callable[[], None]) -> None:
        """Let that much time go by; what `look` raises ends it."""
        ...


class WallBatchClock:
    """Real time."""

    def now(self) -> datetime:
        """See `BatchClock`."""
        return datetime.now().astimezone()

    def used(self, bench_s: float) -> None:
        """It has gone by."""

    def rest(self, seconds: float, look: Callable[[], None]) -> None:
        """See `BatchClock`."""
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            look()
            time.sleep(min(left, LOOK_S))


class VirtualBatchClock:
    """The time of benches that stand still between runs. `passed` gets what goes by, in s, before
    it counts."""

    def __init__(self, begun: datetime, passed_s: float, passed: Callable[[float], None]):
        self._begun, self._passed_s, self._keep = begun, passed_s, passed

    def now(self) -> datetime:
        """See `BatchClock`."""
        return self._begun + timedelta(seconds=self._passed_s)

    def used(self, bench_s: float) -> None:
        """See `BatchClock`."""
        self._pass(bench_s)

    def rest(self, seconds: float, look: Callable[[], None]) -> None:
        """See `BatchClock`."""
        look()
        self._pass(seconds)

    def _pass(self, seconds: float) -> None:
        self._passed_s += max(0.0, seconds)
        self._keep(self._passed_s)
