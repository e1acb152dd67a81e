"""The server side of HiSLIP (IVI-6.1, versions 1.0 and 2.0 without encryption), without I/O.

This module may turn the bytes of TCP connections into events and events into bytes. It may not open
a socket, wait, or know SCPI. A session is two connections: the synchronous one carries messages and
replies, the asynchronous one locks, status and device clear.

    connection:  NEW --Initialize--------> SYNCHRONOUS     NEW --AsyncInitialize--> ASYNCHRONOUS
    session:     HALF_OPEN --AsyncInitialize--> READY --AsyncDeviceClear--> CLEARING
                 CLEARING --DeviceClearComplete--> READY      any --close, fatal error--> CLOSED

Simplifications, all allowed to a server or invisible to a client that reads its replies: always
synchronised mode, never overlapped; a lock that is taken is refused at once, whatever time-out the
client offers, because nothing here waits; `Interrupted` is never sent, since a reply is on the wire
before the next message is handled and clients discard an old one by its message id; no service
requests; no descriptors, TLS or SASL (they are answered with error 1).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum, IntEnum, auto

HEADER = struct.Struct("!2sBBIQ")
PROLOGUE = b"HS"
PROTOCOL_VERSION = (2, 0)
VENDOR_ID = int.from_bytes(b"ZZ", "big")
MAX_MESSAGE_SIZE = 1 << 20
"""Bytes of one HiSLIP message that the server takes and, until the client says otherwise, sends."""
MAX_PROGRAM_MESSAGE_BYTES = 64 << 20
"""Bytes of one program message, however many HiSLIP messages carry it."""
SMALLEST_PAYLOAD_BYTES = 64
"""Replies are cut no finer, whatever message size a client asks for."""


class MessageType(IntEnum):
    """Table 4 of IVI-6.1."""

    INITIALIZE = 0
    INITIALIZE_RESPONSE = 1
    FATAL_ERROR = 2
    ERROR = 3
    ASYNC_LOCK = 4
    ASYNC_LOCK_RESPONSE = 5
    DATA = 6
    DATA_END = 7
    DEVICE_CLEAR_COMPLETE = 8
    DEVICE_CLEAR_ACKNOWLEDGE = 9
    ASYNC_REMOTE_LOCAL_CONTROL = 10
    ASYNC_REMOTE_LOCAL_RESPONSE = 11
    TRIGGER = 12
    INTERRUPTED = 13
    ASYNC_INTERRUPTED = 14
    ASYNC_MAXIMUM_MESSAGE_SIZE = 15
    ASYNC_MAXIMUM_MESSAGE_SIZE_RESPONSE = 16
    ASYNC_INITIALIZE = 17
    ASYNC_INITIALIZE_RESPONSE = 18
    ASYNC_DEVICE_CLEAR = 19
    ASYNC_SERVICE_REQUEST = 20
    ASYNC_STATUS_QUERY = 21
    ASYNC_STATUS_RESPONSE = 22
    ASYNC_DEVICE_CLEAR_ACKNOWLEDGE = 23
    ASYNC_LOCK_INFO = 24
    ASYNC_LOCK_INFO_RESPONSE = 25


class FatalErrorCode(IntEnum):
    """The connection is closed after one of these."""

    UNIDENTIFIED = 0
    BAD_HEADER = 1
    CHANNELS_NOT_ESTABLISHED = 2
    INVALID_INITIALIZATION = 3
    TOO_MANY_CLIENTS = 4


class ErrorCode(IntEnum):
    """The message is skipped after one of these, and the session continues."""

    UNIDENTIFIED = 0
    UNRECOGNISED_TYPE = 1
    UNRECOGNISED_CONTROL_CODE = 2
    UNRECOGNISED_VENDOR_MESSAGE = 3
    MESSAGE_TOO_LARGE = 4


class ChannelRole(Enum):
    """The role of a connection in its session."""

    NEW = auto()
    SYNCHRONOUS = auto()
    ASYNCHRONOUS = auto()
    CLOSED = auto()


class SessionState(Enum):
    """The states of a session, as the module's docstring draws them."""

    HALF_OPEN = auto()
    READY = auto()
    CLEARING = auto()
    CLOSED = auto()


_T = MessageType
_ERRORS = {_T.ERROR, _T.FATAL_ERROR}
ACCEPTED: dict[ChannelRole, frozenset[MessageType]] = {
    ChannelRole.NEW: frozenset({_T.INITIALIZE, _T.ASYNC_INITIALIZE} | _ERRORS),
    ChannelRole.SYNCHRONOUS: frozenset(
        {_T.DATA, _T.DATA_END, _T.TRIGGER, _T.DEVICE_CLEAR_COMPLETE} | _ERRORS
    ),
    ChannelRole.ASYNCHRONOUS: frozenset(
        {
            _T.ASYNC_LOCK,
            _T.ASYNC_LOCK_INFO,
            _T.ASYNC_REMOTE_LOCAL_CONTROL,
            _T.ASYNC_MAXIMUM_MESSAGE_SIZE,
            _T.ASYNC_DEVICE_CLEAR,
            _T.ASYNC_STATUS_QUERY,
        }
        | _ERRORS
    ),
    ChannelRole.CLOSED: frozenset(),
}
"""Messages that a client may send, by connection."""


# --- events ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Send:
    """Put ``data`` on ``connection``."""

    connection: Connection
    data: bytes


@dataclass(frozen=True)
class Close:
    """Close ``connection`` once what was sent is out."""

    connection: Connection


@dataclass(frozen=True)
class ProgramMessage:
    """A complete message for the instrument; answer it with `Session.reply`."""

    session: Session
    message_id: int
    data: bytes


@dataclass(frozen=True)
class Triggered:
    """A trigger for the instrument."""

    session: Session


@dataclass(frozen=True)
class StatusQuery:
    """The client wants the status byte: answer with `Session.status`."""

    session: Session


Event = Send | Close | ProgramMessage | Triggered | StatusQuery


def encode(kind: MessageType, control: int = 0, parameter: int = 0, payload: bytes = b"") -> bytes:
    """Return one HiSLIP message."""
    return HEADER.pack(PROLOGUE, kind, control, parameter, len(payload)) + payload


@dataclass(frozen=True)
class _Message:
    kind: int
    control: int
    parameter: int
    payload: bytes


@dataclass(eq=False)
class Session:
    """One client: two connections, an unfinished message, locks."""

    number: int
    server: HislipServerProtocol
    synchronous: Connection
    asynchronous: Connection | None = None
    state: SessionState = SessionState.HALF_OPEN
    max_message_size: int = MAX_MESSAGE_SIZE
    shared_lock: str | None = None
    unread_reply: bool = False
    """A reply was sent and the client has not yet said that it read it."""
    too_large: bool = False
    """The message under way is too large: its remaining parts are skipped."""
    program: bytearray = field(default_factory=bytearray)
    held: list[ProgramMessage | Triggered] = field(default_factory=list)
    """Messages that wait until another session gives up its exclusive lock."""

    def reply(self, message_id: int, data: bytes) -> list[Event]:
        """Return a response, cut to the client's maximum message size."""
        if self.state is not SessionState.READY:
            return []
        self.unread_reply = True
        step = max(self.max_message_size - HEADER.size, SMALLEST_PAYLOAD_BYTES)
        pieces = [data[at : at + step] for at in range(0, len(data), step)] or [b""]
        kinds = [MessageType.DATA] * (len(pieces) - 1) + [MessageType.DATA_END]
        return [
            Send(self.synchronous, encode(kind, 0, message_id, piece))
            for kind, piece in zip(kinds, pieces, strict=True)
        ]

    def status(self, status_byte: int) -> list[Event]:
        """Return the answer to a status query."""
        if self.asynchronous is None or self.state is SessionState.CLOSED:
            return []
        answer = encode(MessageType.ASYNC_STATUS_RESPONSE, status_byte & 0xFF)
        return [Send(self.asynchronous, answer)]


class HislipServerProtocol:
    """All sessions of one server: their numbers and their locks."""

    def __init__(self, max_sessions: int = 100):
        self.sessions: dict[int, Session] = {}
        self.exclusive: Session | None = None
        self._max_sessions = max_sessions
        self._last_number = 0

    def connect(self) -> Connection:
        """Return the state of a TCP connection that a client has opened."""
        return Connection(self)

    def open_session(self, connection: Connection) -> Session | None:
        """Return a new session on its synchronous connection, or None when there are too many."""
        if len(self.sessions) >= self._max_sessions:
            return None
        self._last_number = self._last_number % 0xFFFF + 1
        while self._last_number in self.sessions:
            self._last_number = self._last_number % 0xFFFF + 1
        session = Session(self._last_number, self, connection)
        self.sessions[session.number] = session
        return session

    def close_session(self, session: Session) -> list[Event]:
        """End a session: both connections close, its locks are free."""
        if session.state is SessionState.CLOSED:
            return []
        session.state = SessionState.CLOSED
        session.held.clear()
        del self.sessions[session.number]
        events: list[Event] = []
        for connection in (session.synchronous, session.asynchronous):
            if connection is not None and connection.role is not ChannelRole.CLOSED:
                connection.role = ChannelRole.CLOSED
                events.append(Close(connection))
        return events + self.release(session)

    # --- locks (IVI-6.1, 6.5) ----------------------------------------------------------------

    def locked_out(self, session: Session) -> bool:
        """Return whether another session holds the exclusive lock."""
        return self.exclusive is not None and self.exclusive is not session

    def acquire(self, session: Session, name: str) -> int:
        """Take the exclusive lock (no name) or a shared one: 1 granted, 0 taken, 3 an error."""
        others = [s for s in self.sessions.values() if s is not session and s.shared_lock]
        if self.exclusive is session or (name and session.shared_lock is not None):
            return 3
        if self.exclusive is not None:
            return 0
        if name:
            if any(other.shared_lock != name for other in others):
                return 0
            session.shared_lock = name
            return 1
        if others and session.shared_lock is None:
            return 0
        self.exclusive = session
        return 1

    def release(self, session: Session) -> list[Event]:
        """Give up every lock of a session; what waited for the exclusive one comes free."""
        session.shared_lock = None
        if self.exclusive is not session:
            return []
        self.exclusive = None
        return [event for other in self.sessions.values() for event in _take_held(other)]

    def lock_holders(self) -> int:
        """Return how many sessions hold a lock of any kind."""
        return sum(s.shared_lock is not None or s is self.exclusive for s in self.sessions.values())


def _take_held(session: Session) -> list[ProgramMessage | Triggered]:
    held, session.held = session.held, []
    return held


class Connection:
    """One TCP connection: feed it what arrives, carry out the events it returns."""

    def __init__(self, server: HislipServerProtocol):
        self.role = ChannelRole.NEW
        self.session: Session | None = None
        self._server = server
        self._buffer = bytearray()
        self._skip = 0

    def receive(self, data: bytes) -> list[Event]:
        """Return the events that ``data`` causes, in order."""
        self._buffer += data
        events: list[Event] = []
        for message in self._messages(events):
            events += self._handle(message)
        return events

    def lost(self) -> list[Event]:
        """Return the events that follow when the TCP connection is lost: its session is closed."""
        self.role = ChannelRole.CLOSED
        return self._server.close_session(self.session) if self.session is not None else []

    # --- framing -----------------------------------------------------------------------------

    def _messages(self, events: list[Event]) -> Iterator[_Message]:
        """Yield the complete messages; oversized payloads are skipped as they come, never
        stored."""
        while self.role is not ChannelRole.CLOSED:
            skipped = min(self._skip, len(self._buffer))
            del self._buffer[:skipped]
            self._skip -= skipped
            if self._skip or len(self._buffer) < HEADER.size:
                return
            prologue, kind, control, parameter, length = HEADER.unpack_from(self._buffer)
            if prologue != PROLOGUE:
                events += self._fail(FatalErrorCode.BAD_HEADER, "message does not begin with HS")
                return
            if length > MAX_MESSAGE_SIZE:
                events += self._too_large(kind)
                del self._buffer[: HEADER.size]
                self._skip = length
                continue
            if len(self._buffer) < HEADER.size + length:
                return
            payload = bytes(self._buffer[HEADER.size : HEADER.size + length])
            del self._buffer[: HEADER.size + length]
            yield _Message(kind, control, parameter, payload)

    def _too_large(self, kind: int) -> list[Event]:
        if self.session is not None and kind in (MessageType.DATA, MessageType.DATA_END):
            self.session.program.clear()
            self.session.too_large = kind == MessageType.DATA
        return self._error(ErrorCode.MESSAGE_TOO_LARGE, f"over {MAX_MESSAGE_SIZE} bytes")

    def _error(self, code: ErrorCode, text: str) -> list[Event]:
        return [Send(self, encode(MessageType.ERROR, code, 0, text.encode()))]

    def _fail(self, code: FatalErrorCode, text: str) -> list[Event]:
        """Send the reason, then close the connection and the session it belongs to."""
        said: list[Event] = [Send(self, encode(MessageType.FATAL_ERROR, code, 0, text.encode()))]
        if self.session is not None:
            return said + self._server.close_session(self.session)
        self.role = ChannelRole.CLOSED
        return [*said, Close(self)]

    # --- messages ----------------------------------------------------------------------------

    def _handle(self, message: _Message) -> list[Event]:
        if message.kind >= 128:
            return self._error(ErrorCode.UNRECOGNISED_VENDOR_MESSAGE, "vendor-defined message")
        if message.kind not in _HANDLERS:
            return self._error(ErrorCode.UNRECOGNISED_TYPE, f"type {message.kind}")
        kind = MessageType(message.kind)
        if kind not in ACCEPTED[self.role]:
            return self._misplaced(kind)
        half_open = self.session is not None and self.session.state is SessionState.HALF_OPEN
        if half_open and kind not in _ERRORS:
            text = "asynchronous channel is missing"
            return self._fail(FatalErrorCode.CHANNELS_NOT_ESTABLISHED, text)
        return _HANDLERS[kind](self, message)

    def _misplaced(self, kind: MessageType) -> list[Event]:
        if kind in (MessageType.INITIALIZE, MessageType.ASYNC_INITIALIZE):
            return self._fail(FatalErrorCode.INVALID_INITIALIZATION, "already initialized")
        if self.role is ChannelRole.NEW:
            return self._fail(FatalErrorCode.CHANNELS_NOT_ESTABLISHED, "not initialized")
        return self._error(ErrorCode.UNRECOGNISED_TYPE, f"{kind.name} on the wrong channel")

    def _ready(self) -> Session:
        assert self.session is not None  # the roles say so: see ACCEPTED
        return self.session

    def _initialize(self, message: _Message) -> list[Event]:
        session = self._server.open_session(self)
        if session is None:
            return self._fail(FatalErrorCode.TOO_MANY_CLIENTS, "too many clients")
        self.role, self.session = ChannelRole.SYNCHRONOUS, session
        asked = (message.parameter >> 24, message.parameter >> 16 & 0xFF)
        major, minor = min(asked, PROTOCOL_VERSION)
        parameter = major << 24 | minor << 16 | session.number
        return [Send(self, encode(MessageType.INITIALIZE_RESPONSE, 0, parameter))]

    def _async_initialize(self, message: _Message) -> list[Event]:
        session = self._server.sessions.get(message.parameter)
        if session is None or session.state is not SessionState.HALF_OPEN:
            return self._fail(FatalErrorCode.INVALID_INITIALIZATION, "no such session")
        self.role, self.session = ChannelRole.ASYNCHRONOUS, session
        session.asynchronous, session.state = self, SessionState.READY
        return [Send(self, encode(MessageType.ASYNC_INITIALIZE_RESPONSE, 0, VENDOR_ID))]

    def _data(self, message: _Message) -> list[Event]:
        session = self._ready()
        if session.state is SessionState.CLEARING:
            return []
        session.unread_reply = False
        last = message.kind == MessageType.DATA_END
        if session.too_large:
            session.too_large = not last
            return []
        session.program += message.payload
        if len(session.program) > MAX_PROGRAM_MESSAGE_BYTES:
            session.program.clear()
            session.too_large = not last
            return self._error(ErrorCode.MESSAGE_TOO_LARGE, "program message too large")
        if not last:
            return []
        program = bytes(session.program)
        session.program.clear()
        return self._deliver(ProgramMessage(session, message.parameter, program))

    def _trigger(self, message: _Message) -> list[Event]:
        session = self._ready()
        if session.state is SessionState.CLEARING:
            return []
        return self._deliver(Triggered(session))

    def _deliver(self, event: ProgramMessage | Triggered) -> list[Event]:
        """Deliver to the instrument now, or when the session that has locked it releases the
        lock."""
        if self._server.locked_out(event.session):
            event.session.held.append(event)
            return []
        return [event]

    def _async_device_clear(self, message: _Message) -> list[Event]:
        session = self._ready()
        session.state = SessionState.CLEARING
        session.program.clear()
        session.held.clear()
        session.too_large = session.unread_reply = False
        return [Send(self, encode(MessageType.ASYNC_DEVICE_CLEAR_ACKNOWLEDGE))]

    def _device_clear_complete(self, message: _Message) -> list[Event]:
        session = self._ready()
        session.state = SessionState.READY
        return [Send(self, encode(MessageType.DEVICE_CLEAR_ACKNOWLEDGE))]

    def _async_maximum_message_size(self, message: _Message) -> list[Event]:
        if len(message.payload) != 8:
            return self._error(ErrorCode.UNIDENTIFIED, "a size has 8 bytes")
        self._ready().max_message_size = int.from_bytes(message.payload, "big")
        size = MAX_MESSAGE_SIZE.to_bytes(8, "big")
        return [Send(self, encode(MessageType.ASYNC_MAXIMUM_MESSAGE_SIZE_RESPONSE, 0, 0, size))]

    def _async_status_query(self, message: _Message) -> list[Event]:
        session = self._ready()
        if message.control & 1:  # the client has read the last reply to its end
            session.unread_reply = False
        return [StatusQuery(session)]

    def _async_lock(self, message: _Message) -> list[Event]:
        session = self._ready()
        if message.control == 1:
            granted = self._server.acquire(session, message.payload.decode("latin-1"))
            return [Send(self, encode(MessageType.ASYNC_LOCK_RESPONSE, granted))]
        if message.control != 0:
            return self._error(ErrorCode.UNRECOGNISED_CONTROL_CODE, "lock: 0 or 1")
        held = 1 if self._server.exclusive is session else 2 if session.shared_lock else 3
        freed = self._server.release(session)
        return [Send(self, encode(MessageType.ASYNC_LOCK_RESPONSE, held)), *freed]

    def _async_lock_info(self, message: _Message) -> list[Event]:
        exclusive = int(self._server.exclusive is not None)
        holders = self._server.lock_holders()
        return [Send(self, encode(MessageType.ASYNC_LOCK_INFO_RESPONSE, exclusive, holders))]

    def _async_remote_local(self, message: _Message) -> list[Event]:
        if message.control > 6:
            return self._error(ErrorCode.UNRECOGNISED_CONTROL_CODE, "remote/local: 0 to 6")
        return [Send(self, encode(MessageType.ASYNC_REMOTE_LOCAL_RESPONSE))]

    def _client_error(self, message: _Message) -> list[Event]:
        return []

    def _client_fatal_error(self, message: _Message) -> list[Event]:
        self.role = ChannelRole.CLOSED
        closing = [Close(self)]
        return [*closing, *self.lost()]


_HANDLERS = {
    _T.INITIALIZE: Connection._initialize,
    _T.ASYNC_INITIALIZE: Connection._async_initialize,
    _T.DATA: Connection._data,
    _T.DATA_END: Connection._data,
    _T.TRIGGER: Connection._trigger,
    _T.ASYNC_DEVICE_CLEAR: Connection._async_device_clear,
    _T.DEVICE_CLEAR_COMPLETE: Connection._device_clear_complete,
    _T.ASYNC_MAXIMUM_MESSAGE_SIZE: Connection._async_maximum_message_size,
    _T.ASYNC_STATUS_QUERY: Connection._async_status_query,
    _T.ASYNC_LOCK: Connection._async_lock,
    _T.ASYNC_LOCK_INFO: Connection._async_lock_info,
    _T.ASYNC_REMOTE_LOCAL_CONTROL: Connection._async_remote_local,
    _T.ERROR: Connection._client_error,
    _T.FATAL_ERROR: Connection._client_fatal_error,
}
