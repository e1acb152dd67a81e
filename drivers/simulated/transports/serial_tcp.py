"""A simulated serial instrument on a TCP port, as a terminal server or a chain's own port puts it.

It may move bytes between connections and a core, name the connections, and let `WireFaults` disturb
the replies. It may not know an instrument, and never waits for one: the core answers at once. Every
connection has a line of its own to the instrument, so that two clients do not spoil each other's
commands.
"""

from __future__ import annotations

from collections.abc import Callable

from drivers.simulated.faults.wire import WireFaults
from drivers.simulated.ports import SerialInstrument
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
            for reply in delivery.replies:
                self.send(reply.data)
            if delivery.close:
                self.reset() if delivery.reset else self.close()
            if delivery.close or self._link.half_open:
                return
