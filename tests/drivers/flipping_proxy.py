"""A TCP proxy that turns over one bit of what a server sends."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Iterator


class FlippingProxy:
    """Passes bytes on in both directions; listens on 127.0.0.1 at `port`."""

    def __init__(self, server_port: int):
        self._server_port = server_port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._open: list[socket.socket] = [self._listener]
        self._flip: tuple[int, int] | None = None
        threading.Thread(target=self._accept, daemon=True).start()

    def flip(self, byte: int, bit: int) -> None:
        """Turn over `bit` of byte number `byte`, from 0, of what the server sends next."""
        self._flip = byte, bit

    def close(self) -> None:
        """Close every connection."""
        for one in self._open:
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                server = socket.create_connection(("127.0.0.1", self._server_port))
                self._open += [client, server]
                for source, target, flips in ((client, server, False), (server, client, True)):
                    one = threading.Thread(
                        target=self._pass, args=(source, target, flips), daemon=True
                    )
                    one.start()

    def _pass(self, source: socket.socket, target: socket.socket, flips: bool) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                if flips and self._flip is not None and self._flip[0] < len(data):
                    (byte, bit), self._flip = self._flip, None
                    changed = bytearray(data)
                    changed[byte] ^= 1 << bit
                    data = bytes(changed)
                target.sendall(data)
            target.shutdown(socket.SHUT_WR)


@contextlib.contextmanager
def flipping(server_port: int) -> Iterator[FlippingProxy]:
    """A proxy in front of a server of this computer."""
    proxy = FlippingProxy(server_port)
    try:
        yield proxy
    finally:
        proxy.close()
