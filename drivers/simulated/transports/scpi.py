"""The SCPI grammar of an instrument: program messages in, response messages out, no I/O.

This module may parse messages, find commands in a table, keep the error queue and the status
registers of IEEE 488.2. It may not open a connection, know an instrument, or wait.

An instrument is a table of `Command` rows over a `ScpiInstrument`. A row's pattern is written as
manuals write it: ``[SOURce#:]FREQuency[:CW|:FIXed]?`` has an optional node with a numeric suffix,
long and short forms, two optional alternatives, and is a query. Sources: SCPI-1999 volume 1
(headers, paths, parameters) and volume 2 chapter 21 (errors); IEEE 488.2-1992 (common commands).
"""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

MAX_MESSAGE_BYTES = 64 << 20
"""A longer program message is not taken: it would be a runaway block length."""

ERROR_TEXT: dict[int, str] = {
    0: "No error",
    -101: "Invalid character",
    -102: "Syntax error",
    -104: "Data type error",
    -108: "Parameter not allowed",
    -109: "Missing parameter",
    -113: "Undefined header",
    -114: "Header suffix out of range",
    -131: "Invalid suffix",
    -211: "Trigger ignored",
    -221: "Settings conflict",
    -222: "Data out of range",
    -224: "Illegal parameter value",
    -230: "Data corrupt or stale",
    -350: "Queue overflow",
    -363: "Input buffer overrun",
}


class ScpiError(Exception):
    """A command that could not be carried out: its number and text go to the error queue."""

    def __init__(self, code: int, detail: str = ""):
        self.code = code
        self.text = ERROR_TEXT[code] + (f"; {detail}" if detail else "")
        super().__init__(f"{code}: {self.text}")


# --- splitting: blocks, strings and lists hide separators -------------------------------------

_BLOCK_HEADER = re.compile(rb"#([1-9])")
_SPECIAL = {mark: re.compile(rb"[\"'(#" + mark + rb"]") for mark in (b";", b",")}
_BOUNDARY = re.compile(rb"\n|(?<=[ ,\t])#(?=[1-9])")


def block(data: bytes) -> bytes:
    """Return ``data`` as a definite-length block with eight length digits, ``#8dddddddd...``."""
    return b"#8%08d" % len(data) + data


def _after_block(data: bytes | bytearray, at: int) -> int | None:
    """Return where the block that begins at ``at`` ends; None while its length is still incomplete.

    What turns out not to be a block ends after its ``#``. The end may lie beyond the data.
    """
    header = _BLOCK_HEADER.match(data, at)
    if header is None:
        return at + 1
    digits = bytes(data[header.end() : header.end() + int(header.group(1))])
    if len(digits) < int(header.group(1)):
        return None if digits.isdigit() or not digits else at + 1
    if not digits.isdigit() or int(digits) > MAX_MESSAGE_BYTES:
        return at + 1
    return header.end() + len(digits) + int(digits)


def _after(data: bytes, at: int) -> int:
    """Return where the string, list or block that begins at ``at`` ends."""
    mark = data[at : at + 1]
    if mark == b"#":
        end = _after_block(data, at)
        return len(data) if end is None else end
    close = data.find(b")" if mark == b"(" else mark, at + 1)
    return len(data) if close < 0 else close + 1


def _split(data: bytes, separator: bytes) -> list[bytes]:
    special = _SPECIAL[separator]
    pieces, start, position = [], 0, 0
    while hit := special.search(data, position):
        if hit.group() == separator:
            pieces.append(data[start : hit.start()])
            start = position = hit.end()
        else:
            position = _after(data, hit.start())
    return [*pieces, data[start:]]


class MessageSplitter:
    """Cuts a byte stream into program messages at LF; an LF inside a block does not count."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._scanned = 0

    def feed(self, data: bytes) -> list[bytes]:
        """Return the messages that ``data`` completes, without their terminators."""
        self._buffer += data
        messages, start = [], 0
        while hit := _BOUNDARY.search(self._buffer, self._scanned):
            if hit.group() == b"\n":
                messages.append(bytes(self._buffer[start : hit.start()]))
                start = self._scanned = hit.end()
                continue
            end = _after_block(self._buffer, hit.start())
            if end is None:
                break
            self._scanned = end
        else:
            self._scanned = max(self._scanned, len(self._buffer) - 1)
        del self._buffer[:start]
        self._scanned -= start
        if len(self._buffer) > MAX_MESSAGE_BYTES + 64:
            self.clear()
        return messages

    def clear(self) -> None:
        """Forget an unfinished message."""
        self._buffer.clear()
        self._scanned = 0


# --- parameters ------------------------------------------------------------------------------


@dataclass(frozen=True)
class ScpiQuantity:
    """A numeric parameter: a value in its base unit, or one of MIN, MAX, DEF, INF."""

    value: float = 0.0
    unit: str = ""
    keyword: str = ""


class Parameter(Protocol):
    """A kind of program data: turns one parameter's bytes into a value, or raises ScpiError."""

    def parse(self, data: bytes) -> Any:
        """Return the value of one parameter. Raises ScpiError with the number of the SCPI error."""
        ...


_NUMBER = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*([A-Za-z]*)")
_MULTIPLIER = {
    "EX": 1e18, "PE": 1e15, "T": 1e12, "G": 1e9, "MA": 1e6, "K": 1e3, "": 1.0,
    "M": 1e-3, "U": 1e-6, "N": 1e-9, "P": 1e-12, "F": 1e-15, "A": 1e-18,
}  # fmt: skip
_MEGA_UNITS = ("HZ", "OHM")  # MHZ and MOHM mean mega: SCPI-1999 volume 1, 7.3
_KEYWORDS = ("MINimum", "MAXimum", "DEFault", "INFinity")


@dataclass(frozen=True)
class Numeric:
    """Decimal numbers, with a multiplier and a unit (``1 kHz``), and the allowed keywords."""

    units: tuple[str, ...] = ()
    keywords: tuple[str, ...] = ("MIN", "MAX", "DEF")

    def parse(self, data: bytes) -> ScpiQuantity:
        """Return the quantity or keyword. Raises ScpiError (-104, or -131 for another unit)."""
        text = data.decode("latin-1").strip()
        keyword = _match_choice(text, _KEYWORDS)
        if keyword in self.keywords:
            return ScpiQuantity(keyword=keyword)
        found = _NUMBER.fullmatch(text)
        if found is None:
            raise ScpiError(-104)
        scale, unit = self._unit(found.group(2).upper())
        return ScpiQuantity(float(found.group(1)) * scale, unit)

    def _unit(self, suffix: str) -> tuple[float, str]:
        if not suffix:
            return 1.0, ""
        for unit in self.units:
            prefix = suffix.removesuffix(unit)
            if suffix.endswith(unit) and prefix in _MULTIPLIER:
                mega = prefix == "M" and unit in _MEGA_UNITS
                return (1e6 if mega else _MULTIPLIER[prefix]), unit
        raise ScpiError(-131)


@dataclass(frozen=True)
class Boolean:
    """ON, OFF, or a number that is rounded: zero is OFF."""

    def parse(self, data: bytes) -> bool:
        """Return whether it is on. Raises ScpiError (-104) for anything else."""
        text = data.decode("latin-1").strip().upper()
        if text in ("ON", "OFF"):
            return text == "ON"
        try:
            return round(float(text)) != 0
        except (ValueError, OverflowError):
            raise ScpiError(-104) from None


class Choice:
    """One of some words, long or short; the value is the short form."""

    def __init__(self, *words: str):
        self.words = words

    def parse(self, data: bytes) -> str:
        """Return the short form. Raises ScpiError (-104, or -224 for a word not among them)."""
        text = data.decode("latin-1").strip()
        if not re.fullmatch(r"[A-Za-z]\w*", text):
            raise ScpiError(-104)
        short = _match_choice(text, self.words)
        if not short:
            raise ScpiError(-224)
        return short


@dataclass(frozen=True)
class ChannelList:
    """``(@101,103:105)`` as (101, 103, 104, 105), in the order written."""

    def parse(self, data: bytes) -> tuple[int, ...]:
        """Return the channels. Raises ScpiError (-104, or -102 for a bad number or range)."""
        found = re.fullmatch(rb"\(\s*@([\d\s,:]+)\)", data.strip())
        if found is None:
            raise ScpiError(-104)
        channels: list[int] = []
        for part in found.group(1).split(b","):
            found = re.fullmatch(rb"\s*(\d{1,6})\s*(?::\s*(\d{1,6})\s*)?", part)
            if found is None:
                raise ScpiError(-102)
            first, last = int(found.group(1)), int(found.group(2) or found.group(1))
            if not first <= last < first + 1000:
                raise ScpiError(-102)
            channels.extend(range(first, last + 1))
        return tuple(channels)


@dataclass(frozen=True)
class Text:
    """A name or a quoted string."""

    def parse(self, data: bytes) -> str:
        """Return the text without its quotes; every text is accepted."""
        return data.decode("latin-1").strip().strip("\"'")


@dataclass(frozen=True)
class Rest:
    """Everything that is left, as the list of its parameters' bytes; only as the last kind."""

    def parse(self, data: bytes) -> list[bytes]:
        """Return the bytes of each parameter that is left."""
        return _split(data, b",")


def short_form(word: str) -> str:
    """Return the short form of a mnemonic written as in manuals: ``FREQuency`` gives ``FREQ``."""
    return "".join(letter for letter in word if not letter.islower())


def _match_choice(text: str, words: Iterable[str]) -> str:
    typed = text.upper()
    return next((short_form(w) for w in words if typed in (short_form(w), w.upper())), "")


# --- commands --------------------------------------------------------------------------------


class Call(NamedTuple):
    """One command as received: who sent it, its header's numeric suffixes, its parameters."""

    by: str
    suffixes: tuple[int, ...]
    arguments: tuple[Any, ...]


@dataclass(frozen=True)
class ScpiBlock:
    """A reply that is a binary block."""

    data: bytes


Reply = str | ScpiBlock | None


@dataclass(frozen=True)
class ScpiCommand:
    """A row of an instrument's command table; the last ``optional`` parameters may be left out."""

    pattern: str
    run: Callable[[Call], Reply]
    parameters: tuple[Parameter, ...] = ()
    optional: int = 0


_PATTERN_TOKEN = re.compile(r"[\[\]:|?]|\*?[A-Za-z]+#?")


def compile_pattern(pattern: str) -> re.Pattern[str]:
    """Return a manual's notation as an expression over upper-case headers; a group for every
    ``#``."""
    parts = []
    for token in _PATTERN_TOKEN.findall(pattern):
        if token in "[]:|?":
            parts.append({"[": "(?:", "]": ")?", "?": r"\?"}.get(token, token))
            continue
        word = token.removesuffix("#")
        forms = "|".join(re.escape(form) for form in (short_form(word), word.upper()))
        parts.append(f"(?:{forms})" + (r"(\d{0,3})" if token.endswith("#") else ""))
    return re.compile("".join(parts))


class _CommandTable:
    """Finds the row of a header, and remembers headers already found."""

    def __init__(self, commands: Sequence[ScpiCommand]):
        self._rows = [(compile_pattern(command.pattern), command) for command in commands]
        self._known: dict[str, tuple[ScpiCommand, tuple[int, ...]]] = {}

    def find(self, header: str) -> tuple[ScpiCommand, tuple[int, ...]]:
        header = header.upper()
        if header not in self._known:
            if len(self._known) > 1000:  # a client that sends garbage for hours
                self._known.clear()
            self._known[header] = self._search(header)
        return self._known[header]

    def _search(self, header: str) -> tuple[ScpiCommand, tuple[int, ...]]:
        for expression, command in self._rows:
            if found := expression.fullmatch(header):
                return command, tuple(int(group or 1) for group in found.groups())
        raise ScpiError(-113)


def _parse_arguments(command: ScpiCommand, data: bytes) -> tuple[Any, ...]:
    if command.parameters and isinstance(command.parameters[-1], Rest):
        pieces = _split(data, b",")
        fixed = len(command.parameters) - 1
        pieces = [*pieces[:fixed], b",".join(pieces[fixed:])] if len(pieces) > fixed else pieces
    else:
        pieces = _split(data, b",") if data else []
    if len(pieces) > len(command.parameters):
        raise ScpiError(-108)
    if len(pieces) < len(command.parameters) - command.optional:
        raise ScpiError(-109)
    return tuple(kind.parse(piece) for kind, piece in zip(command.parameters, pieces, strict=False))


# --- the instrument --------------------------------------------------------------------------

_EVENT_BIT_OF_ERROR = {1: 32, 2: 16, 3: 8, 4: 4}  # hundreds of the code: CME, EXE, DDE, QYE
_OPERATION_COMPLETE, _POWER_ON = 1, 128
_SUMMARY_ERRORS, _SUMMARY_MESSAGE, _SUMMARY_EVENTS, _SUMMARY_MASTER = 4, 16, 32, 64


class ScpiInstrument(ABC):
    """An instrument that understands SCPI. It has one state for all connections.

    ``identity`` are the four fields of ``*IDN?``. The error queue and status registers are shared
    by all connections. After a command error the rest of a compound message is still carried out,
    so that ``SET ...;:SYST:ERR?`` always has its reply; whether a given real unit does so too is
    not confirmed, and a driver must survive its silence.
    """

    QUEUE_LENGTH = 20
    """Entries the error queue holds; the last becomes -350 when more arrive."""

    BLOCK_TERMINATOR = b"\n"
    """Bytes after a binary block that ends a response."""

    def __init__(self, identity: tuple[str, str, str, str], commands: Sequence[ScpiCommand]):
        self.identity = identity
        self._table = _CommandTable([*commands, *self._common_commands()])
        self._errors: deque[ScpiError] = deque()
        self._event_status = _POWER_ON
        self._event_enable = 0
        self._service_enable = 0

    @abstractmethod
    def reset(self, by: str) -> None:
        """Return to the state that ``*RST`` promises."""

    def trigger(self, by: str) -> None:
        """Handle a bus trigger (``*TRG``, or the transport's own)."""
        self.report(ScpiError(-211))

    def process(self, message: bytes, by: str) -> bytes | None:
        """Carry out one program message; the joined replies of its queries, or None."""
        replies: list[bytes] = []
        terminator, path = b"\n", ""
        for unit in _split(message, b";"):
            header, path, arguments = _read_header(unit, path)
            if not header:
                continue
            try:
                reply = self._execute(header, arguments, by)
            except ScpiError as error:
                self.report(error)
                continue
            if reply is not None:
                binary = isinstance(reply, ScpiBlock)
                replies.append(
                    block(reply.data) if isinstance(reply, ScpiBlock) else reply.encode()
                )
                terminator = self.BLOCK_TERMINATOR if binary else b"\n"
        return b";".join(replies) + terminator if replies else None

    def report(self, error: ScpiError) -> None:
        """Put an error into the queue and its class into the event status register."""
        self._event_status |= _EVENT_BIT_OF_ERROR.get(-error.code // 100, 0)
        if len(self._errors) < self.QUEUE_LENGTH:
            self._errors.append(error)
        else:
            self._errors[-1] = ScpiError(-350)

    def status_byte(self, message_available: bool = False) -> int:
        """Return the status byte; ``message_available`` is known to the transport alone."""
        status = _SUMMARY_ERRORS if self._errors else 0
        status |= _SUMMARY_MESSAGE if message_available else 0
        status |= _SUMMARY_EVENTS if self._event_status & self._event_enable else 0
        return status | (_SUMMARY_MASTER if status & self._service_enable else 0)

    def _execute(self, header: str, arguments: bytes, by: str) -> Reply:
        command, suffixes = self._table.find(header)
        return command.run(Call(by, suffixes, _parse_arguments(command, arguments)))

    def _common_commands(self) -> list[ScpiCommand]:
        byte = (Numeric(),)
        return [
            ScpiCommand("*IDN?", lambda _: ",".join(self.identity)),
            ScpiCommand("*RST", lambda call: self.reset(call.by)),
            ScpiCommand("*CLS", self._clear_status),
            ScpiCommand("*OPC", lambda _: self._raise_event(_OPERATION_COMPLETE)),
            ScpiCommand("*OPC?", lambda _: "1"),
            ScpiCommand("*WAI", lambda _: None),
            ScpiCommand("*TRG", lambda call: self.trigger(call.by)),
            ScpiCommand("*TST?", lambda _: "+0"),
            ScpiCommand("*OPT?", lambda _: "0"),
            ScpiCommand("*ESR?", self._read_event_status),
            ScpiCommand("*STB?", lambda _: f"{self.status_byte():+d}"),
            ScpiCommand("*ESE", self._set_event_enable, byte),
            ScpiCommand("*ESE?", lambda _: f"{self._event_enable:+d}"),
            ScpiCommand("*SRE", self._set_service_enable, byte),
            ScpiCommand("*SRE?", lambda _: f"{self._service_enable:+d}"),
            ScpiCommand("SYSTem:ERRor[:NEXT]?", self._next_error),
            ScpiCommand("SYSTem:VERSion?", lambda _: "1999.0"),
        ]

    def _raise_event(self, bit: int) -> None:
        self._event_status |= bit

    def _clear_status(self, call: Call) -> None:
        self._errors.clear()
        self._event_status = 0

    def _read_event_status(self, call: Call) -> str:
        value, self._event_status = self._event_status, 0
        return f"{value:+d}"

    def _set_event_enable(self, call: Call) -> None:
        self._event_enable = _byte(call)

    def _set_service_enable(self, call: Call) -> None:
        self._service_enable = _byte(call) & ~_SUMMARY_MASTER

    def _next_error(self, call: Call) -> str:
        if not self._errors:
            return f'+0,"{ERROR_TEXT[0]}"'
        error = self._errors.popleft()
        return f'{error.code:+d},"{error.text}"'


def _byte(call: Call) -> int:
    quantity: ScpiQuantity = call.arguments[0]
    if quantity.keyword or not 0 <= quantity.value <= 255:
        raise ScpiError(-222)
    return round(quantity.value)


def _read_header(unit: bytes, path: str) -> tuple[str, str, bytes]:
    """Return a unit's absolute header, the path it leaves for the next unit, and its parameters'
    bytes.

    A header without a leading colon continues at the level of the one before it in the same
    message; common commands leave that level alone (SCPI-1999 volume 1, 6.2.4).
    """
    words = unit.split(None, 1)  # no strip: a block may end in white space
    if not words:
        return "", path, b""
    header = words[0].decode("latin-1")
    arguments = words[1] if len(words) > 1 else b""
    if header.startswith("*"):
        return header, path, arguments
    header = header[1:] if header.startswith(":") else path + header
    return header, header[: header.rfind(":") + 1], arguments
