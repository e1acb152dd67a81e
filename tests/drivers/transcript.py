"""An instrument that knows one conversation by heart: expected bytes in order, canned replies.

It has the interface of a SCPI core, so the real servers put it on the real transports. What comes
in another order, too much or too little fails the test, with the place shown.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import takewhile
from typing import Any

from simulated.ideal import serving

from drivers.simulated.transports.scpi_servers import HislipServer, ScpiSocketServer

Reply = str | bytes | None


class Transcript:
    """Pairs of a message and its reply; text replies get their line feed, bytes go as they are."""

    def __init__(self, *exchanges: tuple[str, Reply]):
        self._due = list(exchanges)
        self._surprise = ""

    def process(self, message: bytes, by: str) -> bytes | None:
        """The reply to the next message, if it is the expected one."""
        text = message.decode("latin-1").rstrip("\n")
        if self._surprise:
            return None
        if not self._due:
            self._surprise = f"more came than expected: {text}"
            return None
        expected, reply = self._due.pop(0)
        if text != expected:
            same = sum(
                1
                for _ in takewhile(
                    lambda pair: pair[0] == pair[1], zip(text, expected, strict=False)
                )
            )
            self._surprise = f"expected {expected}\n     got {text}\n         {' ' * same}^"
            return None
        return reply.encode() + b"\n" if isinstance(reply, str) else reply

    def trigger(self, by: str) -> None:
        """Nothing here triggers."""
        self._surprise = "a trigger came"

    def status_byte(self, message_available: bool = False) -> int:
        """Nothing here asks for the status."""
        return 0

    def verify(self) -> None:
        """AssertionError where a message was not as expected or never came."""
        assert not self._surprise, "\n" + self._surprise
        assert not self._due, f"never sent: {self._due[0][0]} ({len(self._due)} messages left)"


@contextmanager
def playing(link: str, *exchanges: tuple[str, Reply]) -> Iterator[str]:
    """The VISA resource at which the conversation is played; verified at the end."""
    transcript: Any = Transcript(*exchanges)
    server = (HislipServer if link == "hislip" else ScpiSocketServer)(transcript)
    with serving(server):
        where = f"hislip0,{server.port}::INSTR" if link == "hislip" else f"{server.port}::SOCKET"
        try:
            yield f"TCPIP::127.0.0.1::{where}"
        except BaseException:
            assert not transcript._surprise, "\n" + transcript._surprise
            raise
    transcript.verify()
