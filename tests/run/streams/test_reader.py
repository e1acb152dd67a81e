"""The reader thread: keeps what comes, lets watchers see it first, and keeps its own failure."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence

import pytest

from rig.core.errors import InstrumentError
from rig.run.streams.stream_reader import StreamReader, Watcher

PATIENCE_S = 30.0


class Source:
    """Samples by hand: what is put is read, four bytes each."""

    def __init__(self) -> None:
        self.bytes_consumed = 0
        self._batches: list[list[int] | Exception] = []
        self._news = threading.Condition()

    def put(self, batch: list[int] | Exception) -> None:
        with self._news:
            self._batches.append(batch)
            self._news.notify()

    def read(self) -> Sequence[int]:
        with self._news:
            self._news.wait_for(lambda: bool(self._batches), timeout=0.01)
            batch = self._batches.pop(0) if self._batches else []
        if isinstance(batch, Exception):
            raise batch
        self.bytes_consumed += 4 * len(batch)
        return batch


def eventually(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, "it never happened"
        time.sleep(0.002)


Started = Callable[..., StreamReader[int]]


@pytest.fixture
def source() -> Source:
    return Source()


@pytest.fixture
def started(source: Source) -> Iterator[Started]:
    readers: list[StreamReader[int]] = []

    def start(*watchers: Watcher, samples_kept: int = 1000) -> StreamReader[int]:
        reader: StreamReader[int] = StreamReader("force", source, watchers, samples_kept)
        reader.start()
        readers.append(reader)
        return reader

    yield start
    for reader in readers:
        reader.stop()


def test_the_latest_samples_come_oldest_first(source: Source, started: Started) -> None:
    reader = started()
    source.put([1, 2, 3])
    source.put([4])
    eventually(lambda: reader.bytes_handled() == 16)
    assert reader.latest(2) == [3, 4]
    assert reader.latest(10) == [1, 2, 3, 4]
    assert reader.latest(0) == []


def test_only_so_many_are_kept(source: Source, started: Started) -> None:
    reader = started(samples_kept=3)
    source.put(list(range(10)))
    eventually(lambda: reader.bytes_handled() == 40)
    assert reader.latest(100) == [7, 8, 9]


def test_bytes_count_as_handled_when_every_watcher_has_seen_them(
    source: Source, started: Started
) -> None:
    gate, order = threading.Event(), []

    def slow(samples: Sequence[int]) -> None:
        gate.wait(PATIENCE_S)
        order.append("slow")

    reader = started(slow, lambda samples: order.append("second"))
    source.put([1])
    eventually(lambda: reader.latest(1) == [1])
    assert reader.bytes_handled() == 0
    gate.set()
    eventually(lambda: reader.bytes_handled() == 4)
    assert order == ["slow", "second"]


def test_watchers_see_every_sample_in_order(source: Source, started: Started) -> None:
    seen: list[int] = []
    reader = started(seen.extend)
    for first in range(0, 300, 3):
        source.put(list(range(first, first + 3)))
    eventually(lambda: reader.bytes_handled() == 4 * 300)
    assert seen == list(range(300))


@pytest.mark.parametrize("where", ["source", "watcher"])
def test_what_ends_the_thread_is_raised_at_every_look(
    source: Source, started: Started, where: str
) -> None:
    error = InstrumentError("force", "stream", "3 frames were lost")

    def watch(samples: Sequence[int]) -> None:
        if where == "watcher" and 13 in samples:
            raise error

    reader = started(watch)
    source.put([12])
    eventually(lambda: reader.bytes_handled() == 4)
    reader.check()
    source.put(error if where == "source" else [13])

    def failed() -> bool:
        try:
            reader.check()
        except InstrumentError:
            return True
        return False

    eventually(failed)
    for look in (reader.check, reader.bytes_handled, reader.check):
        with pytest.raises(InstrumentError) as caught:
            look()
        assert caught.value is error
    assert reader.latest(1) == [13 if where == "watcher" else 12], "what came before is kept"


def test_who_lets_the_reader_settle_knows_what_a_watcher_was_about(
    source: Source, started: Started
) -> None:
    acting, gate = threading.Event(), threading.Event()
    error = InstrumentError("force", "stream", "saturated")

    def act(samples: Sequence[int]) -> None:
        acting.set()
        gate.wait(PATIENCE_S)
        raise error

    reader = started(act)
    source.put([1])
    assert acting.wait(PATIENCE_S)
    threading.Timer(0.05, gate.set).start()
    reader.check()
    reader.settle()
    assert gate.is_set()
    for _ in range(2):  # a thread that has ended is settled
        with pytest.raises(InstrumentError, match="saturated"):
            reader.check()
        reader.settle()


def test_stopping_ends_the_thread_and_may_be_repeated(source: Source, started: Started) -> None:
    reader = started()
    source.put([1])
    eventually(lambda: reader.bytes_handled() == 4)
    reader.stop()
    reader.stop()
    source.put([2])
    time.sleep(0.05)
    assert reader.latest(5) == [1]
    assert not any(t.name == "force" and t.is_alive() for t in threading.enumerate())


def test_a_reader_that_was_never_started_can_be_stopped(source: Source) -> None:
    reader: StreamReader[int] = StreamReader("force", source)
    reader.stop()
    assert reader.latest(1) == []
