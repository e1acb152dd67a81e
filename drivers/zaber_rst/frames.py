"""Messages of the Zaber ASCII protocol: text in, text out, no I/O and no stage.

    command  /DEVICE AXIS ID words:LRC          LF
    reply    @DD A ID OK|RJ IDLE|BUSY FLAG data:LRC   CR LF

Ids run from 0 to 99, and a reply repeats the id of its command. The check is the two's complement
of the sum of all bytes between the first character and the colon; a reply carries one because its
command did. A reply's status and its warning flag, the gravest that stands, are those at the
moment it was sent. Lines that begin with ``#`` (information) or ``!`` (alert) answer nothing.

Source: traffic of the vendor's client zaber-motion 10.2.0.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

IDS = 100
NO_FLAG = "--"

_REPLY = re.compile(
    rb"@(?P<device>\d\d) (?P<axis>\d) (?P<id>\d\d) (?P<said>OK|RJ) (?P<status>IDLE|BUSY) "
    rb"(?P<flag>--|[A-Z]{2}) (?P<data>[ -~]+)"
)


class ZaberFrameError(ValueError):
    """A line that is not a message, or not the one that was sent."""


@dataclass(frozen=True)
class Reply:
    """The answer of a stage to a command."""

    device: int
    axis: int
    message_id: int
    accepted: bool
    """False where it rejected the command; `data` is then the reason."""
    busy: bool
    """True if a motion is under way."""
    flag: str
    """The gravest warning flag, or `NO_FLAG`."""
    data: str


def command(device: int, axis: int, message_id: int, words: str) -> bytes:
    """Return a command on the wire; `words` may be empty, which only asks for status and flag."""
    body = f"{device} {axis} {message_id:02d}{' ' if words else ''}{words}".encode("ascii")
    return b"/" + body + b":%02X\n" % check(body)


def check(body: bytes) -> int:
    """Return the check of a message without its first character: with it, the sum of bytes is 0."""
    return -sum(body) & 0xFF


def reply(line: bytes) -> Reply | None:
    """Return the reply in a line; None where the line is sound and answers nothing.

    What stands before the last ``@`` is the rest of a message that was cut short. Raises
    ZaberFrameError where the check is missing or wrong, or where the line is neither reply,
    information nor alert.
    """
    text = line.rstrip(b"\r\n")
    text = text[max(text.rfind(b"@"), 0) :]
    body, colon, given = text[1:].rpartition(b":")
    if text[:1] not in (b"@", b"#", b"!") or not colon or given != b"%02X" % check(body):
        raise ZaberFrameError(f"it does not fit its checksum: {_shown(line)}")
    if text[:1] != b"@":
        return None
    match = _REPLY.fullmatch(b"@" + body)
    if match is None:
        raise ZaberFrameError(f"it is not a reply: {_shown(line)}")
    return Reply(
        int(match["device"]),
        int(match["axis"]),
        int(match["id"]),
        match["said"] == b"OK",
        match["status"] == b"BUSY",
        match["flag"].decode(),
        match["data"].decode(),
    )


def _shown(line: bytes) -> str:
    return repr(line[:60])[1:]
