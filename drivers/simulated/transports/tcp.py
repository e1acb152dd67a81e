"""A TCP server for a simulated instrument, whatever is spoken on it.

It listens, numbers the connections and drops them. What the bytes mean is its subclasses' affair.
Everything runs in the event loop that called ``start``.
"""

from __future__ import annotations

import asyncio
import socket
import struct
from abc import ABC, abstractmethod
from typing import cast

from drivers.simulated.faults.plan import FaultPlan
from drivers.simulated.faults.wire import Delivery, WireFaults

MAX_UNSENT_BYTES = 256 << 20
"""A client that lets so much pile up unread is disconnected."""
_LINGER = struct.pack("ii", 1, 0)
"""SO_LINGER of no time: what is aborted then is reset, not ended."""


class TcpServer(ABC):
    """Listens on ``host``; ``port`` 0 takes any free one, which `port` then holds."""

    def __init__(self, host: str = "127.0.0.1", port: int = 0, faults: WireFaults | None = None):
        self.faults = faults if faults is not None else WireFaults(FaultPlan(), "")
        self.transports: set[asyncio.Transport] = set()
        self._host = host
        self._port = port
        self._server: asyncio.Server | None = None
        self._deaf: socket.socket | None = None
        """Holds the port without listening on it: a connection to it is refused."""
        self._connections = 0
        self._accepted = 0

    @property
    def port(self) -> int:
        """The TCP port listened on."""
        return self._port

    async def start(self) -> None:
        """Begin to listen. Raises OSError when the port is taken."""
        if self.faults.refused_from == 1:
            self._refuse()
            return
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(self._accept_counted, self._host, self._port)
        self._port = self._server.sockets[0].getsockname()[1]

    async def close(self) -> None:
        """Stop listening and drop every connection."""
        server, self._server = self._server, None
        if server is not None:
            server.close()
        if self._deaf is not None:
            self._deaf.close()
        for transport in list(self.transports):
            transport.abort()
        if server is not None:
            await server.wait_closed()

    def next_number(self) -> int:
        """Return a number for a new connection, from 1."""
        self._connections += 1
        return self._connections

    @abstractmethod
    def _accept(self) -> TcpPeer:
        """Return the handler of a new connection."""

    def _accept_counted(self) -> TcpPeer:
        self._accepted += 1
        if self.faults.refused_from == self._accepted + 1:
            asyncio.get_running_loop().call_soon(self._refuse)  # once this one stands
        return self._accept()

    def _refuse(self) -> None:
        """Listen no longer, and keep the port, so that no other program answers there."""
        self.faults.report("refused")
        if self._server is not None:
            self._server.close()
        self._deaf = socket.socket()
        self._deaf.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._deaf.bind((self._host, self._port))
        self._port = self._deaf.getsockname()[1]


class TcpPeer(asyncio.Protocol):
    """One TCP connection; asyncio sets TCP_NODELAY on it."""

    def __init__(self, server: TcpServer):
        self._transports = server.transports
        self.transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Add the connection to those of the server."""
        self.transport = cast(asyncio.Transport, transport)
        self._transports.add(self.transport)

    def connection_lost(self, exc: Exception | None) -> None:
        """Remove the connection from those of the server."""
        if self.transport is not None:
            self._transports.discard(self.transport)

    def send(self, data: bytes) -> None:
        """Queue bytes for the client; drop a client that never reads."""
        if self.transport is None or self.transport.is_closing():
            return
        self.transport.write(data)
        if self.transport.get_write_buffer_size() > MAX_UNSENT_BYTES:
            self.abort()

    def deliver(self, delivery: Delivery) -> None:
        """Do what becomes of a reply: send it, or send it later; close or break the connection."""
        data = b"".join(reply.data for reply in delivery.replies)
        if delivery.after_s:
            asyncio.get_running_loop().call_later(delivery.after_s, self.send, data)
        elif data:
            self.send(data)
        if delivery.close:
            self.reset() if delivery.reset else self.close()

    def close(self) -> None:
        """Close once everything is sent."""
        if self.transport is not None:
            self.transport.close()

    def abort(self) -> None:
        """Drop the connection with what was not sent."""
        if self.transport is not None:
            self.transport.abort()

    def reset(self) -> None:
        """Break the connection: the client sees a reset."""
        if self.transport is not None:
            own: socket.socket = self.transport.get_extra_info("socket")
            own.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER)
            self.transport.abort()
