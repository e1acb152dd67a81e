"""The control socket: who moves the World's time, and what happens when its owner dies."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from drivers.simulated.bench.control import LONGEST_ADVANCE_US, ControlServer
from drivers.simulated.bench.options import Options
from drivers.simulated.bench.start import start
from drivers.simulated.world.settings import WorldSettings
from drivers.simulated.world.world import World

PATIENCE_S = 30.0


class Bench:
    """A World under its control server, and what the server asked for."""

    def __init__(self) -> None:
        self.world = World(WorldSettings(), 0, slaved=True)
        self.sent = {"force": 0}
        self.stopped = threading.Event()
        self.orphaned = threading.Event()
        self.freed = threading.Event()
        self.server = ControlServer(
            self.world,
            {"force": lambda: self.sent["force"]},
            self.stopped.set,
            self._orphan,
            self.freed.set,
        )
        self.port = 0

    def _orphan(self) -> None:
        self.world.timeline.set_free()
        self.orphaned.set()

    def ask(self, **request: object) -> dict[str, Any]:
        return self.server.answer(json.dumps(request).encode())


class Client:
    """Somebody at the control socket."""

    def __init__(self, port: int):
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)
        self.lines = self.socket.makefile("rb")

    def ask(self, **request: object) -> dict[str, Any]:
        self.socket.sendall(json.dumps(request).encode() + b"\n")
        answer: dict[str, Any] = json.loads(self.lines.readline())
        return answer

    def leave(self) -> None:
        self.lines.close()
        self.socket.close()


@contextmanager
def listening() -> Iterator[Bench]:
    bench = Bench()
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    bench.port = asyncio.run_coroutine_threadsafe(bench.server.start(), loop).result(10)

    async def end() -> None:
        bench.server.close()
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)

    try:
        yield bench
    finally:
        asyncio.run_coroutine_threadsafe(end(), loop).result(10)
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


def test_an_advance_moves_time_and_tells_what_was_sent() -> None:
    bench = Bench()
    assert bench.ask(do="advance", us=1500) == {"now_us": 1500, "streams": {"force": 0}}
    bench.sent["force"] = 56
    assert bench.ask(do="advance", us=0) == {"now_us": 1500, "streams": {"force": 56}}


@pytest.mark.parametrize(
    "line",
    [
        b'{"do": "advance", "us": -1}',
        b'{"do": "advance", "us": %d}' % (LONGEST_ADVANCE_US + 1),
        b'{"do": "advance", "us": 1e400}',
        b'{"do": "advance", "us": "soon"}',
        b'{"do": "advance"}',
        b'{"do": "dance"}',
        b'{"us": 5}',
        b'{"do": "point", "run": 1}',
        b"[]",
        b"3",
        b"not json",
        b"\xff\xfe",
        b"",
    ],
)
def test_a_wrong_request_is_answered_with_an_error_and_moves_nothing(line: bytes) -> None:
    bench = Bench()
    assert "error" in bench.server.answer(line)
    assert bench.world.now_us == 0
    assert not bench.stopped.is_set()


def test_a_free_bench_cannot_be_advanced() -> None:
    bench = Bench()
    bench.world.timeline.set_free()
    assert "real time" in bench.ask(do="advance", us=5)["error"]


def test_a_stop_ends_the_bench_and_all_its_processes() -> None:
    with listening() as bench:
        client = Client(bench.port)
        client.ask(do="advance", us=10)
        assert client.ask(do="stop") == {"now_us": 10}
        assert bench.stopped.wait(PATIENCE_S)
        client.leave()
    assert not bench.orphaned.is_set()


def test_an_owner_that_hands_the_bench_over_sets_its_time_free_and_can_still_end_it() -> None:
    with listening() as bench:
        owner = Client(bench.port)
        owner.ask(do="free")
        assert bench.freed.wait(PATIENCE_S)
        owner.ask(do="stop")
        assert bench.stopped.wait(PATIENCE_S)


@pytest.mark.parametrize("last_word", [b"", b'{"do": "adv'])
def test_time_continues_when_the_owner_is_gone(last_word: bytes) -> None:
    with listening() as bench:
        owner = Client(bench.port)
        owner.ask(do="advance", us=10_000)
        assert bench.world.now_us == 10_000
        owner.socket.sendall(last_word)
        owner.leave()
        assert bench.orphaned.wait(PATIENCE_S)
        deadline = time.monotonic() + PATIENCE_S
        while bench.world.now_us <= 20_000 and time.monotonic() < deadline:
            time.sleep(0.005)
        assert bench.world.now_us > 20_000


def test_a_visitor_who_leaves_does_not_take_the_time_from_its_owner() -> None:
    with listening() as bench:
        owner = Client(bench.port)
        owner.ask(do="advance", us=10)
        visitor = Client(bench.port)
        visitor.ask(do="advance", us=0)
        visitor.leave()
        for _ in range(20):
            assert "error" not in owner.ask(do="advance", us=10)
            time.sleep(0.005)
        assert bench.world.timeline.slaved
        assert bench.world.now_us == 210
        owner.leave()
        assert bench.orphaned.wait(PATIENCE_S)


def test_the_process_continues_in_real_time_without_its_owner_then_ends(tmp_path: Path) -> None:
    log = tmp_path / "world.jsonl"
    started = start({"world_log": str(log), "linger_s": 0.3})
    owner = Client(started.ready()["control_port"])
    owner.ask(do="advance", us=5_000)
    owner.leave()
    started.wait(PATIENCE_S)
    gone, end = [json.loads(line) for line in log.read_text().splitlines()]
    assert (gone["what"], end["what"]) == ("owner-gone", "end")
    assert gone["t_us"] >= 5_000
    assert end["t_us"] - gone["t_us"] >= 290_000
    assert Options().linger_s > 1, "by default a guard has time to come"
