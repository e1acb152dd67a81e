"""The time of a batch: real time, or virtual time on simulated benches that it starts for itself.

Virtual time begins when the batch begins and advances by the bench time of its runs and by its
rests, which take no real time.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, time, timedelta
from time import monotonic, sleep
from typing import Protocol

from rig.batch.plan.settings import BatchFile
from rig.batch.plan.window import window
from rig.batch.queue import Queue
from rig.batch.queue_records import TIME_OVER
from rig.batch.queue_view import QueueView

PASSED_S = "night_s"
"""The queue's entry of the virtual time since the batch began."""
SINCE = "window since"
"""The queue's entry of when the present window was counted from, if not from the beginning."""
CHECK_EVERY_S = 0.2
"""Interval in s at which a wait in real time checks for commands."""


class BatchClock(Protocol):
    """The clock of a batch: gives the time and makes the batch rest."""

    def now(self) -> datetime:
        """Return the date and time, with the offset from UTC."""
        ...

    def used(self, bench_s: float) -> None:
        """Record that a run has taken this much bench time."""
        ...

    def rest(self, seconds: float, check: Callable[[], None]) -> None:
        """Wait this long. `check` is called often; what it raises ends the rest."""
        ...

    def wait_until(self, instant: datetime, check: Callable[[], None]) -> None:
        """Wait until it is this date and time, as `now` shows it; `check` as in `rest`."""
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
        until = monotonic() + seconds
        while (left := until - monotonic()) > 0:
            check()
            sleep(min(left, CHECK_EVERY_S))

    def wait_until(self, instant: datetime, check: Callable[[], None]) -> None:
        """See `BatchClock`. The computer's clock may be set, or the computer be suspended,
        meanwhile: it is read again and again."""
        while (left_s := (instant - self.now()).total_seconds()) > 0:
            check()
            sleep(min(left_s, CHECK_EVERY_S))


class VirtualBatchClock:
    """Virtual time, `passed_s` after the batch began. `save` is called with each new value, in
    s."""

    def __init__(self, begun: datetime, passed_s: float, save: Callable[[float], None]):
        self._begun, self._passed_s, self._save = begun, passed_s, save

    def now(self) -> datetime:
        """See `BatchClock`."""
        return (self._begun + timedelta(seconds=self._passed_s)).astimezone()

    def used(self, bench_s: float) -> None:
        """See `BatchClock`."""
        self._pass(bench_s)

    def rest(self, seconds: float, check: Callable[[], None]) -> None:
        """See `BatchClock`."""
        check()
        self._pass(seconds)

    def wait_until(self, instant: datetime, check: Callable[[], None]) -> None:
        """See `BatchClock`."""
        self.rest((instant - self.now()).total_seconds(), check)

    def _pass(self, seconds: float) -> None:
        self._passed_s += max(0.0, seconds)
        self._save(self._passed_s)


def clock_of(queue: Queue) -> BatchClock:
    """Return the clock of a batch, as its queue records it."""
    if queue.meta("bench"):
        return WallBatchClock()

    def keep(passed_s: float) -> None:
        queue.set_meta(PASSED_S, f"{passed_s:.6f}")

    begun = datetime.fromisoformat(queue.meta("begun"))
    return VirtualBatchClock(begun, float(queue.meta(PASSED_S, "0")), keep)


def window_of(queue: QueueView) -> tuple[datetime | None, datetime | None]:
    """Return the times between which a batch may use the bench."""
    batch = BatchFile.model_validate_json(queue.meta("file")).batch
    return window(batch, datetime.fromisoformat(queue.meta(SINCE) or queue.meta("begun")))


def renew_window(queue: Queue) -> None:
    """Give a batch that is resumed after a `stop_by` by time of day the next window; one that is
    resumed before it keeps its own. Call it once, when a person resumes the batch.

    Virtual time stands still between two commands: after a batch that has ended at its `stop_by` it
    is then `stop_by`.
    """
    batch = BatchFile.model_validate_json(queue.meta("file")).batch
    _, until = window_of(queue)
    if until is None or not isinstance(batch.stop_by, time):
        return
    clock = clock_of(queue)
    if isinstance(clock, VirtualBatchClock) and queue.meta(TIME_OVER):
        clock.used((until - clock.now()).total_seconds())
    if clock.now() >= until:
        queue.set_meta(SINCE, clock.now().isoformat())
    queue.set_meta(TIME_OVER, "")
