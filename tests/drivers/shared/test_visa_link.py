"""The link of drivers that talk SCPI: blocks of bytes over a raw socket."""

from __future__ import annotations

import socketserver
import threading
from collections.abc import Iterator
from contextlib import closing

import pytest

from drivers.shared.visa_link import VisaLink
from rig.core.clock import WallClock
from rig.core.errors import InstrumentError, InstrumentTimeoutError

CONTENT = b"\n\x00\r\n" * 300
ANSWERS = {
    b"DATA?\n": b"#41200" + CONTENT + b"\n",
    b"PADDED?\n": b"#6001200" + CONTENT + b"\n",
    b"SHORT?\n": b"#41200" + CONTENT[:-8] + b"\n",
    b"OTHER?\n": b"#41196" + CONTENT[:-4] + b"\n",
    b"*CLS\n": b"",
    b"*IDN?\n": b"LAB,D5,1,1.0\n",
}


class _Unit(socketserver.StreamRequestHandler):
    def handle(self) -> None:
        for line in self.rfile:
            self.wfile.write(ANSWERS[line])


@pytest.fixture
def link() -> Iterator[VisaLink]:
    """A link to a unit on a raw socket that answers with blocks full of line ends."""
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), _Unit) as server:
        server.daemon_threads = True
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        resource = f"TCPIP::127.0.0.1::{server.server_address[1]}::SOCKET"
        with closing(VisaLink("daq", resource, 1.0, WallClock())) as opened:
            yield opened
        server.shutdown()


@pytest.mark.parametrize("query", ["DATA?", "PADDED?"])
def test_a_block_that_contains_line_ends_comes_whole_over_a_raw_socket(
    link: VisaLink, query: str
) -> None:
    for _ in range(2):
        assert link.query_block(query, len(CONTENT)) == CONTENT
    assert link.identify().model == "D5", "nothing of the block is left for the next answer"


def test_a_block_that_is_too_short_is_an_error_and_never_a_value(link: VisaLink) -> None:
    with pytest.raises(InstrumentTimeoutError, match=r"SHORT\?: no answer within 1 s"):
        link.query_block("SHORT?", len(CONTENT))
    with pytest.raises(InstrumentError, match="is not 1200 bytes"):
        link.query_block("OTHER?", len(CONTENT))
    assert link.query_block("DATA?", len(CONTENT)) == CONTENT
