"""Waiting: sliced, interruptible, and on a slaved bench never ahead of what the readers saw."""

from __future__ import annotations

import asyncio
import json
import os
import pty
import socket
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import pytest

import rig.core.clock
from drivers.simulated.bench.control import ControlServer
from drivers.simulated.world.settings import WorldSettings
from drivers.simulated.world.world import World
from rig.core.clock import Clock, ControlLink, SlavedClock, WallClock
from rig.core.errors import InstrumentError
from rig.run.streams.stream_reader import StreamReader


class CountingClock(Clock):
    """A clock that remembers its slices."""

    def __init__(self) -> None:
        super().__init__()
        self.slices: list[float] = []
        self._now = 0.0

    def now(self) -> float:
        return self._now

    def _pass(self, seconds: float) -> None:
        self.slices.append(seconds)
        self._now += seconds


@dataclass
class SlavedBench:
    """A World behind its real control socket, in a thread, and what was asked of it."""

    world: World
    port: int = 0
    streams: dict[str, Callable[[], int]] = field(default_factory=dict)
    ended: threading.Event = field(default_factory=threading.Event)
    orphaned: threading.Event = field(default_factory=threading.Event)
    dead: Callable[[], None] = lambda: None


@contextmanager
def slaved_bench(**streams: Callable[[], int]) -> Iterator[SlavedBench]:
    bench = SlavedBench(World(WorldSettings(), 0, slaved=True), streams=streams)
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    server = ControlServer(
        bench.world, streams, bench.ended.set, bench.orphaned.set, bench.orphaned.set
    )
    bench.port = asyncio.run_coroutine_threadsafe(server.start(), loop).result(10)

    async def end() -> None:
        server.close()
        for task in asyncio.all_tasks():
            if task is not asyncio.current_task():
                task.cancel()
        await asyncio.sleep(0)

    try:
        yield bench
    finally:
        asyncio.run_coroutine_threadsafe(end(), loop).result(10)
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


@pytest.fixture
def slaved() -> Iterator[tuple[SlavedClock, SlavedBench]]:
    with slaved_bench() as bench:
        clock = SlavedClock(ControlLink(bench.port))
        yield clock, bench
        clock.close()


# --- any clock -------------------------------------------------------------------------------


def test_a_wait_is_cut_into_slices_of_at_most_20_ms() -> None:
    clock = CountingClock()
    clock.sleep(0.105)
    assert max(clock.slices) <= 0.02
    assert clock.now() == pytest.approx(0.105)


def test_callbacks_run_before_every_slice_and_at_the_end() -> None:
    clock, seen = CountingClock(), []
    clock.each_slice(lambda: seen.append(round(clock.now(), 3)))
    clock.sleep(0.05)
    assert seen == [0.0, 0.02, 0.04, 0.05]


@pytest.mark.parametrize("seconds", [0.0, -1.0])
def test_a_wait_of_nothing_still_looks_at_the_callbacks(seconds: float) -> None:
    clock, seen = CountingClock(), []
    clock.each_slice(lambda: seen.append(1))
    clock.sleep(seconds)
    assert seen == [1]
    assert clock.slices == []


def test_what_a_callback_raises_ends_the_wait_at_once() -> None:
    clock = CountingClock()

    def stop_later() -> None:
        if clock.now() > 0.05:
            raise KeyError("stop")

    clock.each_slice(stop_later)
    with pytest.raises(KeyError, match="stop"):
        clock.sleep(3600)
    assert clock.now() < 0.05 + 2 * 0.02


def test_an_unregistered_callback_is_not_called_again() -> None:
    clock, first, second = CountingClock(), [], []
    unregister = clock.each_slice(lambda: first.append(1))
    clock.each_slice(lambda: second.append(1))
    clock.sleep(0)
    unregister()
    unregister()
    clock.sleep(0)
    assert (len(first), len(second)) == (1, 2)


def test_a_callback_may_unregister_itself_while_it_runs() -> None:
    clock, seen = CountingClock(), []

    def once() -> None:
        seen.append(1)
        unregister()

    unregister = clock.each_slice(once)
    clock.sleep(0.1)
    assert seen == [1]


def test_the_wall_clock_waits_at_least_as_long_as_asked() -> None:
    clock = WallClock()
    before, begun = clock.now(), time.monotonic()
    clock.sleep(0.05)
    assert clock.now() - before >= 0.05
    assert time.monotonic() - begun >= 0.05


def test_a_time_out_is_made_up_for_only_where_time_stood_still() -> None:
    """On the wall clock it has been waited for once already; callbacks are due either way."""
    seen: list[str] = []
    wall, still = WallClock(), CountingClock()
    for name, clock in (("wall", wall), ("still", still)):
        clock.each_slice(lambda name=name: seen.append(name))  # type: ignore[misc]
        clock.charge(3600.0 if name == "wall" else 0.05)
    assert still.now() == pytest.approx(0.05)
    assert set(seen) == {"wall", "still"}


# --- the slaved clock ------------------------------------------------------------------------


def test_slaved_time_moves_only_by_sleeping_and_to_the_microsecond(
    slaved: tuple[SlavedClock, SlavedBench],
) -> None:
    clock, bench = slaved
    assert bench.world.now_us == 0
    clock.sleep(0.123457)
    assert bench.world.now_us == 123_457
    assert clock.now() == pytest.approx(0.123457)
    for _ in range(10):
        clock.sleep(0.0000014)  # each wait is rounded, not their sum
    assert bench.world.now_us == 123_467


def test_callbacks_see_the_bench_time_before_every_slice(
    slaved: tuple[SlavedClock, SlavedBench],
) -> None:
    clock, bench = slaved
    seen: list[int] = []
    clock.each_slice(lambda: seen.append(bench.world.now_us))
    clock.sleep(0.05)
    assert seen == [0, 20_000, 40_000, 50_000]


class NoReader:
    """Handles nothing, for nothing comes."""

    def bytes_handled(self) -> int:
        return 0

    def await_bytes(self, count: int, patience_s: float) -> int:
        return 0


def test_slices_are_10_ms_while_an_instrument_streams(
    slaved: tuple[SlavedClock, SlavedBench],
) -> None:
    clock, bench = slaved
    seen: list[int] = []
    clock.each_slice(lambda: seen.append(bench.world.now_us))
    unfollow = clock.follow_stream("force", NoReader())
    clock.sleep(0.02)
    unfollow()
    unfollow()
    clock.sleep(0.02)
    assert seen == [0, 10_000, 20_000, 20_000, 40_000]


def test_closing_the_clock_ends_the_bench_it_drives(
    slaved: tuple[SlavedClock, SlavedBench],
) -> None:
    clock, bench = slaved
    clock.close()
    assert bench.ended.wait(20)
    assert not bench.orphaned.is_set()
    clock.close()  # a bench that is gone already is as good


class PtyForce:
    """A force sensor's stream over a pty: the bench writes late, a reader thread reads."""

    def __init__(self, watch: Callable[[list[int]], None]) -> None:
        self._watch = watch
        self.received: list[int] = []
        self.master, self.slave = pty.openpty()
        tty.setraw(self.slave)
        os.set_blocking(self.slave, False)
        self.sent = 0
        self.bytes_consumed = 0
        self.stuck = False
        self._deliveries: list[threading.Thread] = []

    def send_late(self, data: bytes, delay_s: float) -> None:
        """Count the bytes as sent now, deliver them in two parts a while later."""
        self.sent += len(data)

        def deliver() -> None:
            time.sleep(delay_s)
            os.write(self.master, data[:3])
            time.sleep(delay_s)
            os.write(self.master, data[3:])

        self._deliveries.append(threading.Thread(target=deliver))
        self._deliveries[-1].start()

    def read(self) -> None:
        """Take what has arrived, one sample a byte."""
        if self.stuck:
            time.sleep(0.001)
            return
        try:
            data = os.read(self.slave, 4096)
        except BlockingIOError:
            time.sleep(0.001)
            return
        self.bytes_consumed += len(data)
        self.received += data
        self._watch(list(data))

    def close(self) -> None:
        for delivery in self._deliveries:
            delivery.join()
        os.close(self.master)
        os.close(self.slave)


@contextmanager
def streaming(
    watch: Callable[[list[int]], None] = lambda samples: None,
) -> Iterator[tuple[SlavedClock, SlavedBench, PtyForce, StreamReader]]:
    force = PtyForce(watch)
    reader = StreamReader("force", force)
    with slaved_bench(force=lambda: force.sent) as bench:
        clock = SlavedClock(ControlLink(bench.port))
        clock.follow_stream("force", reader)
        reader.start()
        try:
            yield clock, bench, force, reader
        finally:
            reader.stop()
            clock.close()
            force.close()


def test_sleep_returns_only_when_the_reader_has_seen_what_the_bench_sent() -> None:
    with streaming() as (clock, _, force, _reader):
        for step in range(5):
            sample = bytes([step] * 8)
            force.send_late(sample, delay_s=0.01)
            clock.sleep(0.01)
            assert force.received[-8:] == list(sample), (
                "late bytes belong to the step that sent them"
            )


def test_watchers_have_acted_before_sleep_returns() -> None:
    seen: list[int] = []

    def slow_watcher(samples: list[int]) -> None:
        time.sleep(0.02)
        seen.extend(samples)

    with streaming(slow_watcher) as (clock, _, force, _):
        force.send_late(b"abcdef", delay_s=0.005)
        clock.sleep(0.01)
        assert bytes(seen) == b"abcdef"


def test_a_stuck_reader_is_an_error_that_counts_the_missing_bytes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(rig.core.clock, "STREAM_PATIENCE_S", 0.2)
    with streaming() as (clock, _, force, reader):
        force.stuck = True
        reader.settle()  # a read that has begun may still take what comes
        force.send_late(b"abcdef", delay_s=0)
        with pytest.raises(
            InstrumentError, match=r"force: stream: [1-6] of 6 bytes did not arrive"
        ):
            clock.sleep(0.01)


def test_a_reader_that_died_is_reported_with_its_own_cause() -> None:
    """Nobody waits for the patience with a reader whose watcher has tripped."""

    def trip(samples: object) -> None:
        raise KeyError("force over its limit")

    with streaming(trip) as (clock, _, force, _):
        force.send_late(b"abcdef", delay_s=0)
        with pytest.raises(KeyError, match="over its limit"):
            clock.sleep(0.01)


def answering(lines: list[bytes], after: threading.Event | None = None) -> int:
    """A bench that gives these answers, once `after` has happened, and dies; its port."""
    server = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        connection, _ = server.accept()
        with server, connection, connection.makefile("rb") as asked:
            for line in lines:
                asked.readline()
                if after is not None:
                    after.wait(30)
                connection.sendall(line)

    threading.Thread(target=serve, daemon=True).start()
    return int(server.getsockname()[1])


@pytest.mark.parametrize(
    "last_words",
    [b"", b'{"now_us": 20', b"garbage\n", b'{"error": "no"}\n'],
    ids=["nothing", "half a line", "garbage", "an error"],
)
def test_a_bench_that_dies_or_refuses_is_an_instrument_error(last_words: bytes) -> None:
    good = json.dumps({"now_us": 20_000}).encode() + b"\n"
    clock = SlavedClock(ControlLink(answering([good, last_words])))
    with pytest.raises(InstrumentError, match="simulated bench: control request 'advance'"):
        clock.sleep(1.0)
    assert clock.now() == pytest.approx(0.02)
    clock.close()


def test_a_bench_that_is_not_there_is_an_instrument_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(InstrumentError, match="connect"):
        ControlLink(port)


def test_who_waits_for_a_bench_that_computes_gives_signs_of_life() -> None:
    """Its guard would take it for hung otherwise."""
    waited_for = threading.Event()
    good = json.dumps({"now_us": 20_000}).encode() + b"\n"
    clock = SlavedClock(ControlLink(answering([good], waited_for)))
    clock.while_computing(waited_for.set)
    clock.sleep(0.02)
    assert waited_for.is_set()
    assert clock.now() == pytest.approx(0.02)
    clock.close()
