"""Viewers that never read cost a bounded amount of memory and delay no other."""

from __future__ import annotations

import http.client
import json
import socket
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import uvicorn

from rig.page import server
from rig.page.access import Access
from rig.page.frames import Cursor
from rig.page.history import RunIndex
from rig.page.server import PageState, application
from rig.page.watch import BenchWatch

FRAME_BYTES = 1 << 20
"""Size of a frame here: far more than usual, so that few of them fill a socket."""
READ = 60
"""Frames that are read by those who read."""
MOST_UNREAD = 12
"""Frames that the sockets of one connection may hold."""


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Number of frames that were made, by the right of the viewer: watch for those who never
    read."""
    count: Counter[str] = Counter()

    def next_frame(_: BenchWatch, cursor: Cursor, *, may_stop: bool, polled_s: float) -> Any:
        count["stop" if may_stop else "watch"] += 1
        return {"n": count.total(), "filling": "x" * FRAME_BYTES}

    monkeypatch.setattr(server, "next_frame", next_frame)
    return count


@pytest.fixture
def page(tmp_path: Path) -> Iterator[tuple[int, Access]]:
    """Port and tokens of a server in a thread of this process, which sends as fast as it can."""
    access = Access()
    state = PageState(BenchWatch(tmp_path), RunIndex(tmp_path), access, rate_Hz=1000.0)
    listening = socket.create_server(("127.0.0.1", 0))
    config = uvicorn.Config(application(state), lifespan="off", log_config=None, ws="none")
    config.timeout_graceful_shutdown = 1
    served = uvicorn.Server(config)
    thread = threading.Thread(target=served.run, kwargs={"sockets": [listening]})
    thread.start()
    yield listening.getsockname()[1], access
    served.should_exit = True
    thread.join(60)
    listening.close()
    assert state.viewers == 0


def test_who_never_reads_is_sent_no_more_than_the_sockets_hold_and_delays_no_other(
    page: tuple[int, Access], made: Counter[str]
) -> None:
    port, access = page
    idle = [socket.create_connection(("127.0.0.1", port)) for _ in range(2)]
    for viewer in idle:
        viewer.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 16)
        viewer.sendall(
            b"GET /api/live HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer "
            + access.watch_token.encode()
            + b"\r\n\r\n"
        )
    give_up = time.monotonic() + 60
    while made["watch"] < 2 and time.monotonic() < give_up:
        time.sleep(0.01)
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
    connection.request("GET", "/api/live", headers={"Authorization": f"Bearer {access.stop_token}"})
    answer = connection.getresponse()
    numbers = []
    while len(numbers) < READ:
        line = answer.readline()
        if line.startswith(b"data: "):
            numbers.append(json.loads(line[6:])["n"])
    connection.close()
    assert numbers == sorted(numbers)
    assert 2 <= made["watch"] <= 2 * MOST_UNREAD
    for viewer in idle:
        viewer.close()
