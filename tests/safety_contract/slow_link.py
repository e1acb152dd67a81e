"""A TCP link that is slow: what goes over it arrives so much later."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from queue import SimpleQueue


@contextlib.contextmanager
def slow_link(port: int, delay_s: float) -> Iterator[int]:
    """A port on this computer that leads to `port`, each way `delay_s` late."""
    listening = socket.create_server(("127.0.0.1", 0))
    opened: list[socket.socket] = [listening]

    def serve() -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = listening.accept()
                far = socket.create_connection(("127.0.0.1", port))
                opened.extend((near, far))
                for source, sink in ((near, far), (far, near)):
                    source.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    under_way: SimpleQueue[tuple[float, bytes]] = SimpleQueue()
                    for end in (_take_in, _hand_on):
                        given = (under_way, source if end is _take_in else sink, delay_s)
                        threading.Thread(target=end, args=given, daemon=True).start()

    threading.Thread(target=serve, daemon=True).start()
    try:
        yield listening.getsockname()[1]
    finally:
        for one in opened:
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()


def _take_in(
    under_way: SimpleQueue[tuple[float, bytes]], source: socket.socket, delay_s: float
) -> None:
    with contextlib.suppress(OSError):
        while data := source.recv(65536):
            under_way.put((time.monotonic() + delay_s, data))
    under_way.put((time.monotonic() + delay_s, b""))


def _hand_on(
    under_way: SimpleQueue[tuple[float, bytes]], sink: socket.socket, delay_s: float
) -> None:
    with contextlib.suppress(OSError):
        while True:
            due_s, data = under_way.get()
            time.sleep(max(0.0, due_s - time.monotonic()))
            if not data:
                sink.shutdown(socket.SHUT_WR)
                return
            sink.sendall(data)
