"""The reader thread: has its source take in what comes, and keeps the failure that ended it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import pytest

from rig.core.errors import InstrumentError
from rig.run.streams.stream_reader import StreamReader

PATIENCE_S = 30.0


class Source:
    """Samples by hand: what is put is read, four bytes each, and judged by `watch`."""

    def __init__(self) -> None:
        self.bytes_consumed = 0
        self.watch: Callable[[list[int]], None] = lambda samples: None
        self.seen: list[int] = []
        self._batches: list[list[int] | Exception] = []
        self._news = threading.Condition()

    def put(self, batch: list[int] | Exception) -> None:
        with self._news:
            self._batches.append(batch)
            self._news.notify()

    def read(self) -> None:
        with self._news:
            self._news.wait_for(lambda: bool(self._batches), timeout=0.01)
            batch = self._batches.pop(0) if self._batches else []
        if isinstance(batch, Exception):
            raise batch
        self.bytes_consumed += 4 * len(batch)
        if batch:
            self.watch(batch)
            self.seen += batch


def eventually(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, "it never happened"
        time.sleep(0.002)


@pytest.fixture
def source() -> Source:
    return Source()


@pytest.fixture
def reader(source: Source) -> Iterator[StreamReader]:
    made = StreamReader("force", source)
    yield made
    made.stop()


def test_bytes_are_handled_once_the_source_has_judged_them(
    source: Source, reader: StreamReader
) -> None:
    judging, gate = threading.Event(), threading.Event()

    def slow(samples: list[int]) -> None:
        judging.set()
        gate.wait(PATIENCE_S)

    source.watch = slow
    reader.start()
    source.put([1])
    assert judging.wait(PATIENCE_S)
    assert source.bytes_consumed == 4
    assert reader.bytes_handled() == 0
    gate.set()
    eventually(lambda: reader.bytes_handled() == 4)


def test_the_source_is_read_until_everything_has_come(source: Source, reader: StreamReader) -> None:
    reader.start()
    for first in range(0, 300, 3):
        source.put(list(range(first, first + 3)))
    eventually(lambda: reader.bytes_handled() == 4 * 300)
    assert source.seen == list(range(300))


@pytest.mark.parametrize("where", ["link", "judgement"])
def test_what_ends_the_thread_is_raised_at_every_look(
    source: Source, reader: StreamReader, where: str
) -> None:
    error = InstrumentError("force", "stream", "3 frames were lost")

    def watch(samples: list[int]) -> None:
        if where == "judgement" and 13 in samples:
            raise error

    source.watch = watch
    reader.start()
    source.put([12])
    eventually(lambda: reader.bytes_handled() == 4)
    reader.check()
    source.put(error if where == "link" else [13])

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


def test_who_lets_the_reader_settle_knows_what_its_source_was_about(
    source: Source, reader: StreamReader
) -> None:
    acting, gate = threading.Event(), threading.Event()
    error = InstrumentError("force", "stream", "saturated")

    def act(samples: list[int]) -> None:
        acting.set()
        gate.wait(PATIENCE_S)
        raise error

    source.watch = act
    reader.start()
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


def test_stopping_ends_the_thread_and_may_be_repeated(source: Source, reader: StreamReader) -> None:
    reader.start()
    source.put([1])
    eventually(lambda: reader.bytes_handled() == 4)
    reader.stop()
    reader.stop()
    source.put([2])
    assert source.seen == [1]
    assert not any(t.name == "force" and t.is_alive() for t in threading.enumerate())


def test_a_reader_that_was_never_started_can_be_stopped(source: Source) -> None:
    StreamReader("force", source).stop()
    assert source.seen == []
