"""A simulated serial instrument on a TCP port, as a terminal server or a chain's own port puts it.

It may move bytes between connections and a core, name the connections, and let `WireFaults` disturb
the replies. It may not know an instrument, and never waits for one: the core answers at once. Each
connection of a `SerialTcpServer` has a line of its own to the instrument, so that two clients do
not spoil each other's commands; an `InstrumentTcpServer` has one instrument, which streams to all.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from drivers.simulated.faults.plan import FaultPlan
from drivers.simulated.faults.wire import WireFaults
from drivers.simulated.ports import SerialInstrument, TimePort
from drivers.simulated.transports.serial_server import TICK_S
from drivers.simulated.transports.tcp import TcpPeer, TcpServer


class SerialTcpServer(TcpServer):
    """An instrument on TCP; `line` makes what a connection talks to. Commands are logged as
    ``tcp#n``."""

    def __init__(
        self,
        line: Callable[[], SerialInstrument],
        host: str = "127.0.0.1",
        port: int = 0,
        faults: WireFaults | None = None,
    ):
        super().__init__(host, port, faults)
        self.line = line

    def _accept(self) -> TcpPeer:
        return _LinePeer(self)


class _LinePeer(TcpPeer):
    def __init__(self, server: SerialTcpServer):
        super().__init__(server)
        self._line = server.line()
        self._link = server.faults.link()
        self._by = f"tcp#{server.next_number()}"

    def data_received(self, data: bytes) -> None:
        if self._link.half_open:
            return
        for exchange in self._line.exchanges(data, self._by):
            delivery = self._link.exchange(exchange.request, exchange.reply)
            self.deliver(delivery)
            if delivery.close or self._link.half_open:
                return


class InstrumentTcpServer(TcpServer):
    """One instrument with a TCP port of its own, which also sends without being asked.

    Every connection hears what it sends; answers go to the connection that asked. `stream_faults`
    disturb what it says of its own accord, one `pump` that has something counting as one request
    named ``STREAM``; a fault of kind ``close`` then closes all connections.

    In slaved time the owner of the time calls `pump` after every advance. In real time, from
    `start` or from `set_free` on, the server does that by itself.
    """

    def __init__(
        self,
        instrument: SerialInstrument,
        timeline: TimePort,
        slaved: bool = False,
        faults: WireFaults | None = None,
        stream_faults: WireFaults | None = None,
    ):
        super().__init__(faults=faults)
        self.instrument = instrument
        self.bytes_sent = 0
        """Bytes of answers and stream that were sent while a client was connected; what several
        clients hear is counted once."""
        self.peers: list[_SharedPeer] = []
        self._stream_link = (stream_faults or WireFaults(FaultPlan(), "")).link()
        self._timeline = timeline
        self._slaved = slaved
        self._ticking: asyncio.Task[None] | None = None

    async def start(self) -> None:
        """Begin to listen. Raises OSError when the port is taken."""
        await super().start()
        if not self._slaved:
            self.set_free()

    async def close(self) -> None:
        """Stop listening and drop every connection."""
        if self._ticking is not None:
            self._ticking.cancel()
        await super().close()

    def set_free(self) -> None:
        """Follow the timeline by itself from now on; call it from the event loop's thread."""
        if self._ticking is None:
            self._ticking = asyncio.get_running_loop().create_task(self._tick())

    def pump(self) -> None:
        """Send what the instrument has to say up to now; without a client it is lost."""
        data = self.instrument.frames_until(self._timeline.now_us)
        if not data or not self.peers:
            return
        delivery = self._stream_link.exchange(b"STREAM", data)
        for reply in delivery.replies:
            self.bytes_sent += len(reply.data)
            for peer in self.peers:
                peer.send(reply.data)
        if delivery.close:
            for peer in tuple(self.peers):
                peer.reset() if delivery.reset else peer.close()

    async def _tick(self) -> None:
        while True:
            self.pump()
            await asyncio.sleep(TICK_S)

    def _accept(self) -> TcpPeer:
        return _SharedPeer(self)


class _SharedPeer(TcpPeer):
    """One of the connections to the instrument."""

    def __init__(self, server: InstrumentTcpServer):
        super().__init__(server)
        self._server = server
        self._link = server.faults.link()
        self._by = f"tcp#{server.next_number()}"

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self._server.peers.append(self)

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._server.peers.remove(self)

    def data_received(self, data: bytes) -> None:
        if self._link.half_open:
            return
        self._server.pump()  # what fell due before the request goes out before its reply
        for exchange in self._server.instrument.exchanges(data, self._by):
            delivery = self._link.exchange(exchange.request, exchange.reply)
            self._server.bytes_sent += sum(len(reply.data) for reply in delivery.replies)
            self.deliver(delivery)
            if delivery.close or self._link.half_open:
                return
