"""Small TCP servers that put a SCPI core on the network: raw socket and HiSLIP.

They may move bytes between connections and cores, number the connections for the World's log, and
let `WireFaults` disturb the replies. They may not know an instrument, and never wait for one: the
core answers at once. Everything runs in the event loop that called ``start``.
"""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from typing import cast

from drivers.simulated import hislip
from drivers.simulated.faults import FaultPlan, FaultyLink, WireFaults
from drivers.simulated.scpi import MessageSplitter, ScpiInstrument

MAX_UNSENT_BYTES = 256 << 20
"""A client that lets so much pile up unread is disconnected."""


class _TcpServer(ABC):
    """Listens on ``host``; ``port`` 0 takes any free one, which `port` then tells."""

    def __init__(
        self,
        instrument: ScpiInstrument,
        host: str = "127.0.0.1",
        port: int = 0,
        faults: WireFaults | None = None,
    ):
        self.instrument = instrument
        self.faults = faults if faults is not None else WireFaults(FaultPlan(), "")
        self.transports: set[asyncio.Transport] = set()
        self._host = host
        self._port = port
        self._server: asyncio.Server | None = None
        self._connections = 0

    @property
    def port(self) -> int:
        """The TCP port listened on."""
        return self._port

    async def start(self) -> None:
        """Begin to listen. Raises OSError when the port is taken."""
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(self._accept, self._host, self._port)
        self._port = self._server.sockets[0].getsockname()[1]

    async def close(self) -> None:
        """Stop listening and drop every connection."""
        if self._server is not None:
            self._server.close()
        for transport in list(self.transports):
            transport.abort()
        if self._server is not None:
            await self._server.wait_closed()
            self._server = None

    def next_number(self) -> int:
        """A number for a new connection, from 1."""
        self._connections += 1
        return self._connections

    @abstractmethod
    def _accept(self) -> asyncio.Protocol: ...


class _Peer(asyncio.Protocol):
    """One TCP connection; asyncio sets TCP_NODELAY on it."""

    def __init__(self, server: _TcpServer):
        self._transports = server.transports
        self.transport: asyncio.Transport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)
        self._transports.add(self.transport)

    def connection_lost(self, exc: Exception | None) -> None:
        if self.transport is not None:
            self._transports.discard(self.transport)

    def send(self, data: bytes) -> None:
        """Queue bytes for the client; drop a client that never reads."""
        if self.transport is None or self.transport.is_closing():
            return
        self.transport.write(data)
        if self.transport.get_write_buffer_size() > MAX_UNSENT_BYTES:
            self.transport.abort()

    def close(self) -> None:
        """Close once everything is sent."""
        if self.transport is not None:
            self.transport.close()


# --- raw socket ------------------------------------------------------------------------------


class ScpiSocketServer(_TcpServer):
    """SCPI over a raw TCP socket: messages end with LF. Commands are logged as ``socket#n``."""

    def _accept(self) -> asyncio.Protocol:
        return _SocketPeer(self)


class _SocketPeer(_Peer):
    def __init__(self, server: ScpiSocketServer):
        super().__init__(server)
        self._instrument = server.instrument
        self._link = server.faults.link()
        self._by = f"socket#{server.next_number()}"
        self._splitter = MessageSplitter()

    def data_received(self, data: bytes) -> None:
        for message in self._splitter.feed(data):
            delivery = self._link.exchange(message, self._instrument.process(message, self._by))
            for reply in delivery.replies:
                self.send(reply.data)
            if delivery.close:
                self.close()
                return


# --- HiSLIP ----------------------------------------------------------------------------------


class HislipServer(_TcpServer):
    """SCPI over HiSLIP. Commands are logged as ``hislip#n``, n being the session's number."""

    def __init__(
        self,
        instrument: ScpiInstrument,
        host: str = "127.0.0.1",
        port: int = 0,
        faults: WireFaults | None = None,
    ):
        super().__init__(instrument, host, port, faults)
        self.protocol = hislip.HislipServerProtocol()
        self.peers: dict[hislip.Connection, _HislipPeer] = {}
        self._links: dict[hislip.Session, FaultyLink] = {}

    def _accept(self) -> asyncio.Protocol:
        return _HislipPeer(self)

    def carry_out(self, events: list[hislip.Event]) -> None:
        """Do what the protocol core decided, in order; an answer may bring further events."""
        for event in events:
            match event:
                case hislip.Send(connection, data):
                    if peer := self.peers.get(connection):
                        peer.send(data)
                case hislip.Close(connection):
                    if peer := self.peers.get(connection):
                        peer.close()
                case hislip.ProgramMessage():
                    self.carry_out(self._answer(event))
                case hislip.Triggered(session):
                    self.instrument.trigger(_by(session))
                case hislip.StatusQuery(session):
                    status = self.instrument.status_byte(session.unread_reply)
                    self.carry_out(session.status(status))

    def forget(self, connection: hislip.Connection) -> None:
        """A TCP connection is gone."""
        self.peers.pop(connection, None)
        if connection.session is not None:
            self._links.pop(connection.session, None)
        self.carry_out(connection.lost())

    def _answer(self, message: hislip.ProgramMessage) -> list[hislip.Event]:
        session = message.session
        if session.state is hislip.SessionState.CLOSED:  # by a fault, one message earlier
            return []
        link = self._links.setdefault(session, self.faults.link())
        reply = self.instrument.process(message.data, _by(session))
        delivery = link.exchange(message.data, reply, message.message_id)
        events = [
            event for late in delivery.replies for event in session.reply(late.tag, late.data)
        ]
        return events + (self.protocol.close_session(session) if delivery.close else [])


def _by(session: hislip.Session) -> str:
    return f"hislip#{session.number}"


class _HislipPeer(_Peer):
    def __init__(self, server: HislipServer):
        super().__init__(server)
        self._server = server
        self._connection = server.protocol.connect()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self._server.peers[self._connection] = self

    def data_received(self, data: bytes) -> None:
        self._server.carry_out(self._connection.receive(data))

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._server.forget(self._connection)
