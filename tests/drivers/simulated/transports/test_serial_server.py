"""The serial server on a real pseudo-terminal: bytes, counts, slow and several clients, faults."""

from __future__ import annotations

import asyncio
import os
import select
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import serial

from drivers.simulated.faults.plan import FaultPlan
from drivers.simulated.faults.wire import WireFaults
from drivers.simulated.ports import Exchange
from drivers.simulated.transports.serial_server import GONE_US, LONGEST_BACKLOG, PtyServer
from simulated.ideal import serving


class Parrot:
    """Answers each line with itself and says `chatter` bytes a microsecond of its own accord."""

    def __init__(self, chatter: bytes = b""):
        self.now_us = 0
        self._chatter = chatter
        self._said_us = 0
        self._line = b""

    def exchanges(self, data: bytes, by: str) -> Iterable[Exchange]:
        self._line += data
        while b"\n" in self._line:
            line, self._line = self._line.split(b"\n", 1)
            yield Exchange(line, line.upper() + b"\n" if line else None)

    def frames_until(self, now_us: int) -> bytes:
        said, self._said_us = self._said_us, now_us
        return self._chatter * (now_us - said)


def faults(**fault: Any) -> WireFaults:
    return WireFaults(FaultPlan.model_validate({"fault": [{"device": "it", **fault}]}), "it")


def in_loop(server: PtyServer, act: Callable[[], None]) -> None:
    """Do something where the server lives, and wait for it."""
    done = threading.Event()
    loop = server._loop
    assert loop is not None
    loop.call_soon_threadsafe(lambda: (act(), done.set()))
    assert done.wait(5)


def backlog(server: PtyServer) -> int:
    """The backlog as it stands between two of the server's steps: in the middle of one, bytes that
    a client has read already may still count."""
    seen: list[int] = []
    in_loop(server, lambda: seen.append(server.backlog))
    return seen[0]


@contextmanager
def client(path: str) -> Iterator[serial.Serial]:
    port = serial.Serial(path, 115200, timeout=1)
    try:
        yield port
    finally:
        port.close()


def test_requests_are_answered_and_every_byte_is_counted() -> None:
    server = PtyServer(parrot := Parrot(), parrot)
    with serving(server), client(server.path) as port:
        port.write(b"hello\nyou")
        assert port.readline() == b"HELLO\n"
        port.write(b"\n\n")
        assert port.readline() == b"YOU\n"
        assert server.bytes_sent == 10
        assert backlog(server) == server.bytes_lost == 0


@pytest.mark.parametrize("byte", [b"\x00", b"\x03", b"\x04", b"\r", b"\x11", b"\xff"])
def test_the_line_is_raw_both_ways(byte: bytes) -> None:
    server = PtyServer(parrot := Parrot(), parrot)
    with serving(server), client(server.path) as port:
        port.write(byte * 3 + b"\n")
        assert port.read(4) == byte * 3 + b"\n"


def test_in_slaved_time_it_speaks_when_pumped_and_has_sent_when_that_returns() -> None:
    server = PtyServer(parrot := Parrot(b"x"), parrot, slaved=True)
    with serving(server), client(server.path) as port:
        for total in (10, 20, 30):
            parrot.now_us = total
            in_loop(server, server.pump)
            assert server.bytes_sent == total
            assert port.read(10) == b"x" * 10
        parrot.now_us = 1000
        time.sleep(0.02)
        assert port.in_waiting == 0


def test_in_real_time_and_once_set_free_it_speaks_by_itself() -> None:
    server = PtyServer(parrot := Parrot(b"x"), parrot, slaved=True)
    with serving(server), client(server.path) as port:
        parrot.now_us = 5
        in_loop(server, server.set_free)
        assert port.read(5) == b"x" * 5
        parrot.now_us = 12
        assert port.read(7) == b"x" * 7


def test_what_fell_due_before_a_request_comes_before_its_reply() -> None:
    server = PtyServer(parrot := Parrot(b"x"), parrot, slaved=True)
    with serving(server), client(server.path) as port:
        parrot.now_us = 3
        port.write(b"now\n")
        assert port.read(7) == b"xxxNOW\n"


def test_more_than_the_kernel_holds_waits_and_arrives_in_order() -> None:
    server = PtyServer(parrot := Parrot(bytes(range(50))), parrot, slaved=True)
    with serving(server), client(server.path) as port:
        parrot.now_us = 1200
        in_loop(server, server.pump)
        assert server.bytes_sent == 60_000
        assert 0 < backlog(server) < 60_000
        port.write(b"end\n")
        assert port.read(60_000) == bytes(range(50)) * 1200
        assert port.readline() == b"END\n"
        assert backlog(server) == 0


def test_a_client_that_does_not_read_loses_whole_batches_but_no_answer() -> None:
    server = PtyServer(parrot := Parrot(b"0123456789"), parrot, slaved=True)
    with serving(server), client(server.path) as port:
        for step in range(1, 21):
            parrot.now_us = step * 1000
            in_loop(server, server.pump)
        port.write(b"here\n")
        deadline = time.monotonic() + 5
        while server.bytes_sent % 10 == 0 and time.monotonic() < deadline:
            time.sleep(0.001)
        assert server.bytes_lost > 0
        assert server.bytes_lost + server.bytes_sent == 200_000 + 5
        assert backlog(server) <= LONGEST_BACKLOG + 5
        everything = port.read(server.bytes_sent)
        assert everything == b"0123456789" * (server.bytes_sent // 10) + b"HERE\n"


def test_a_second_client_hears_and_is_heard() -> None:
    server = PtyServer(parrot := Parrot(), parrot)
    with serving(server), client(server.path) as first:
        with client(server.path) as second:
            second.write(b"two\n")
            assert second.readline() == b"TWO\n"
        first.write(b"one\n")
        assert first.readline() == b"ONE\n"


def test_clients_come_and_go_and_nothing_from_before_spoils_the_next() -> None:
    server = PtyServer(parrot := Parrot(), parrot)
    with serving(server):
        for name in (b"a", b"b", b"c"):
            with client(server.path) as port:
                port.write(name + b"\n")
                assert port.readline() == name.upper() + b"\n"


def test_an_unplugged_port_vanishes_and_its_path_leads_to_a_new_one() -> None:
    server = PtyServer(parrot := Parrot(), parrot, faults=faults(kind="close", command="bye"))
    with serving(server):
        with client(server.path) as port:
            before = os.path.realpath(server.path)
            port.write(b"bye\n")
            with pytest.raises((serial.SerialException, OSError)):
                port.read(1)
        assert os.path.realpath(server.path) != before
        with client(server.path) as port:
            port.write(b"again\n")
            assert port.readline() == b"AGAIN\n"


def test_a_port_that_is_reset_is_gone_for_a_while_and_leads_nowhere_meanwhile() -> None:
    server = PtyServer(parrot := Parrot(), parrot, slaved=True, faults=faults(kind="reset"))
    with serving(server):
        with client(server.path) as port:
            port.write(b"a\n")
            with pytest.raises((serial.SerialException, OSError)):
                port.read(1)
        parrot.now_us = GONE_US - 1
        in_loop(server, server.pump)
        assert not os.path.lexists(server.path)
        parrot.now_us = GONE_US
        in_loop(server, server.pump)
        with client(server.path) as port:
            port.write(b"b\n")
            assert port.readline() == b"B\n"


def test_behind_a_line_that_is_cut_nothing_is_obeyed_on_any_opening_of_the_port() -> None:
    half_open = faults(kind="half-open", at=2)
    server = PtyServer(parrot := Parrot(b"x"), parrot, slaved=True, faults=half_open)
    with serving(server):
        for asked, heard in ((b"a\nb\nc\n", b"A\n"), (b"d\n", b"")):
            with client(server.path) as port:
                port.timeout = 0.2
                port.write(asked)
                assert port.read(20) == heard
        parrot.now_us = 1000
        in_loop(server, server.pump)
        assert server.bytes_sent == 2, "what it says of its own accord does not arrive either"


def test_an_answer_that_is_late_arrives_after_the_time_for_which_a_client_waits() -> None:
    late = faults(kind="late", at=1, by_s=0.4)
    server = PtyServer(parrot := Parrot(), parrot, faults=late)
    with serving(server), client(server.path) as port:
        port.timeout = 0.1
        port.write(b"a\n")
        assert port.readline() == b""
        port.timeout = 10
        assert port.readline() == b"A\n"


@pytest.mark.parametrize(
    ("kind", "heard"),
    [
        ("silence", b"C\n"),
        ("truncate", b"BBC\n"),
        ("stale", b"BBB\nC\n"),
        ("flip", b"BBB\x0bC\n"),
    ],
)
def test_faults_disturb_replies_by_request(kind: str, heard: bytes) -> None:
    server = PtyServer(parrot := Parrot(), parrot, faults=faults(kind=kind, at=2))
    with serving(server), client(server.path) as port:
        port.write(b"a\nbbb\nc\n")
        assert port.read(2 + len(heard)) == b"A\n" + heard


def test_the_answer_before_last_comes_once_more() -> None:
    server = PtyServer(parrot := Parrot(), parrot, faults=faults(kind="before-last", at=3))
    with serving(server), client(server.path) as port:
        port.write(b"a\nb\nc\nd\n")
        assert port.read(8) == b"A\nB\nA\nD\n"


def test_faults_disturb_the_stream_batch_by_batch_and_no_reply() -> None:
    lost = faults(kind="silence", at=2, command="STREAM")
    server = PtyServer(parrot := Parrot(b"x"), parrot, slaved=True, stream_faults=lost)
    with serving(server), client(server.path) as port:
        for total in (4, 8, 12):
            parrot.now_us = total
            in_loop(server, server.pump)
        port.write(b"reply\n")
        assert port.read(14) == b"x" * 8 + b"REPLY\n"
        assert server.bytes_sent == 14


def test_closing_takes_the_path_away_and_leaves_no_descriptor() -> None:
    before = len(os.listdir("/proc/self/fd"))  # noqa: PTH208

    async def scenario() -> str:
        server = PtyServer(parrot := Parrot(), parrot)
        await server.start()
        path = server.path
        reader = os.open(path, os.O_RDWR | os.O_NOCTTY)
        await server.close()
        assert select.select([reader], [], [], 1)[0], "the client hears of it"
        os.close(reader)
        return path

    path = asyncio.run(scenario())
    assert not os.path.lexists(path)
    assert len(os.listdir("/proc/self/fd")) == before  # noqa: PTH208
