"""SCPI on the network: raw socket and HiSLIP.

These servers may move bytes between connections and cores, name the connections for the World's
log, and let `WireFaults` disturb the replies. They may not know an instrument, and never wait for
one: the core answers at once.
"""

from __future__ import annotations

import asyncio

from drivers.simulated.faults.wire import FaultyLink, WireDialect, WireFaults
from drivers.simulated.transports import hislip
from drivers.simulated.transports.scpi import ERROR_TEXT, MessageSplitter, ScpiInstrument
from drivers.simulated.transports.tcp import TcpPeer, TcpServer

_NO_ERROR = f'+0,"{ERROR_TEXT[0]}"'.encode()


def _queued_error(reply: bytes, code: int) -> bytes | None:
    """Return a reply to an error query, with an entry that the queue does not have."""
    if _NO_ERROR not in reply:
        return None
    return reply.replace(_NO_ERROR, b'%+d,"Device-specific error"' % code)


SCPI_DIALECT = WireDialect(error=_queued_error)
"""Neither a raw socket nor HiSLIP has a checksum of its own: TCP's is enough."""


class _ScpiServer(TcpServer):
    """One instrument on the network."""

    def __init__(
        self,
        instrument: ScpiInstrument,
        host: str = "127.0.0.1",
        port: int = 0,
        faults: WireFaults | None = None,
    ):
        super().__init__(host, port, faults)
        self.instrument = instrument


# --- raw socket ------------------------------------------------------------------------------


class ScpiSocketServer(_ScpiServer):
    """SCPI over a raw TCP socket: messages end with LF. Commands are logged as ``socket#n``."""

    def _accept(self) -> TcpPeer:
        return _SocketPeer(self)


class _SocketPeer(TcpPeer):
    def __init__(self, server: ScpiSocketServer):
        super().__init__(server)
        self._instrument = server.instrument
        self._link = server.faults.link()
        self._by = f"socket#{server.next_number()}"
        self._splitter = MessageSplitter()

    def data_received(self, data: bytes) -> None:
        for message in self._splitter.feed(data):
            if self._link.half_open:
                return
            delivery = self._link.exchange(message, self._instrument.process(message, self._by))
            self.deliver(delivery)
            if delivery.close:
                return


# --- HiSLIP ----------------------------------------------------------------------------------


class HislipServer(_ScpiServer):
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

    def _accept(self) -> TcpPeer:
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
        """Forget a TCP connection that has closed."""
        self.peers.pop(connection, None)
        if connection.session is not None:
            self._links.pop(connection.session, None)
        self.carry_out(connection.lost())

    def _answer(self, message: hislip.ProgramMessage) -> list[hislip.Event]:
        session = message.session
        if session.state is hislip.SessionState.CLOSED:  # by a fault, one message earlier
            return []
        link = self._links.setdefault(session, self.faults.link())
        if link.half_open:
            return []
        reply = self.instrument.process(message.data, _by(session))
        delivery = link.exchange(message.data, reply, message.message_id)
        events = [
            event for late in delivery.replies for event in session.reply(late.tag, late.data)
        ]
        if delivery.after_s:
            asyncio.get_running_loop().call_later(delivery.after_s, self.carry_out, events)
            return []
        if delivery.reset:
            for connection in (session.synchronous, session.asynchronous):
                if connection is not None and (peer := self.peers.get(connection)):
                    peer.reset()
        return events + (self.protocol.close_session(session) if delivery.close else [])


def _by(session: hislip.Session) -> str:
    return f"hislip#{session.number}"


class _HislipPeer(TcpPeer):
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
