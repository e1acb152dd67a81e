"""The time of a batch: real time, or virtual time on simulated benches that it starts for itself.

Virtual time begins when the batch begins and advances by the bench time of its runs and by its
rests, which take no real time.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import datetime, timedelta
from typing import Protocol

CHECK_EVERY_S = 0.2
"""How often a rest in real time checks for commands."""


class BatchClock(Protocol):
    """What time it is for the batch, and how it rests."""

    def now(self) -> datetime:
        """Date and time, with the offset from UTC."""
        ...

    def used(self, bench_s: float) -> None:
        """A run has taken this much bench time."""
        ...

    def rest(self, seconds: float, check: Callable[[], None]) -> None:
        """Wait this long. `check` is called often; what it raises ends the rest."""
        ...


class WallBatchClock:
    """Real time, for a bench of a bench file."""

    def now(self) -> datetime:
        """See `BatchClock`."""
        return datetime.now().astimezone()

    def used(self, bench_s: float) -> None:
        """See `BatchClock`; real time has passed by itself."""

    def rest(self, seconds: float, check: Callable[[], None]) -> None:
        """See `BatchClock`."""
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            check()
            time.sleep(min(left, CHECK_EVERY_S))


class VirtualBatchClock:
    """Virtual time, `passed_s` after the batch began. `save` gets each new value, in s, at once."""

    def __init__(self, begun: datetime, passed_s: float, save: Callable[[float], None]):
        self._begun, self._passed_s, self._save = begun, passed_s, save

    def now(self) -> datetime:
        """See `BatchClock`."""
        return self._begun + timedelta(seconds=self._passed_s)

    def used(self, bench_s: float) -> None:
        """See `BatchClock`."""
        self._pass(bench_s)

    def rest(self, seconds: float, check: Callable[[], None]) -> None:
        """See `BatchClock`."""
        check()
        self._pass(seconds)

    def _pass(self, seconds: float) -> None:
        self._passed_s += max(0.0, seconds)
        self._save(self._passed_s)
