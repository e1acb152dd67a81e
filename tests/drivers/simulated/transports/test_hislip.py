"""The HiSLIP server core, message by message as the specification's transactions have them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.simulated.transports.hislip import (
    HEADER,
    MAX_MESSAGE_SIZE,
    ChannelRole,
    Close,
    Connection,
    ErrorCode,
    Event,
    FatalErrorCode,
    HislipServerProtocol,
    MessageType,
    ProgramMessage,
    Send,
    Session,
    SessionState,
    StatusQuery,
    Triggered,
    encode,
)

T = MessageType
FIRST_ID = 0xFFFF_FF00


class Client:
    """Both connections of one client, and what was put on them."""

    def __init__(self, server: HislipServerProtocol, version: tuple[int, int] = (1, 0)):
        self.synchronous, self.asynchronous = server.connect(), server.connect()
        asked = version[0] << 24 | version[1] << 16 | int.from_bytes(b"xx", "big")
        (self.initialized,) = sent(
            self.synchronous.receive(encode(T.INITIALIZE, 0, asked, b"hislip0"))
        )
        number = self.initialized[2] & 0xFFFF
        (reply,) = sent(self.asynchronous.receive(encode(T.ASYNC_INITIALIZE, 0, number)))
        assert reply[0] == T.ASYNC_INITIALIZE_RESPONSE
        self.session: Session = server.sessions[number]

    def say(self, kind: MessageType, *rest: object) -> list[Event]:
        """A message on the channel it belongs to."""
        name = kind.name
        channel = self.asynchronous if name.startswith("ASYNC") else self.synchronous
        return channel.receive(encode(kind, *rest))  # type: ignore[arg-type]


def sent(events: list[Event]) -> list[tuple[int, int, int, bytes]]:
    """Each HiSLIP message among the events, as (type, control code, parameter, payload)."""
    data = b"".join(event.data for event in events if isinstance(event, Send))
    messages = []
    while data:
        prologue, kind, control, parameter, length = HEADER.unpack_from(data)
        assert prologue == b"HS"
        messages.append((kind, control, parameter, data[16 : 16 + length]))
        data = data[16 + length :]
    return messages


@pytest.fixture
def server() -> HislipServerProtocol:
    return HislipServerProtocol()


@pytest.fixture
def client(server: HislipServerProtocol) -> Client:
    return Client(server)


@pytest.mark.parametrize(
    ("asked", "granted"), [((1, 0), 0x0100), ((1, 1), 0x0101), ((2, 0), 0x0200), ((3, 1), 0x0200)]
)
def test_version_is_the_lower_of_both(
    server: HislipServerProtocol, asked: tuple[int, int], granted: int
) -> None:
    kind, control, parameter, _ = Client(server, asked).initialized
    assert (kind, control, parameter >> 16) == (T.INITIALIZE_RESPONSE, 0, granted)


def test_message_arrives_whole_and_its_reply_carries_its_number(client: Client) -> None:
    assert client.say(T.DATA, 0, FIRST_ID, b"*ID") == []
    (message,) = client.say(T.DATA_END, 0, FIRST_ID + 2, b"N?\n")
    assert message == ProgramMessage(client.session, FIRST_ID + 2, b"*IDN?\n")
    assert sent(client.session.reply(FIRST_ID + 2, b"me\n")) == [
        (T.DATA_END, 0, FIRST_ID + 2, b"me\n")
    ]


def test_large_reply_is_cut_to_the_clients_maximum(client: Client) -> None:
    (answer,) = sent(client.say(T.ASYNC_MAXIMUM_MESSAGE_SIZE, 0, 0, (1016).to_bytes(8, "big")))
    assert answer == (
        T.ASYNC_MAXIMUM_MESSAGE_SIZE_RESPONSE, 0, 0, MAX_MESSAGE_SIZE.to_bytes(8, "big"),
    )  # fmt: skip
    data = bytes(range(250)) * 10
    pieces = sent(client.session.reply(4, data))
    assert [(kind, len(piece)) for kind, _, _, piece in pieces] == [
        (T.DATA, 1000), (T.DATA, 1000), (T.DATA_END, 500),
    ]  # fmt: skip
    assert b"".join(piece for *_, piece in pieces) == data


def test_device_clear_forgets_the_message_under_way(client: Client) -> None:
    client.say(T.DATA, 0, FIRST_ID, b"half a ")
    assert sent(client.say(T.ASYNC_DEVICE_CLEAR))[0][0] == T.ASYNC_DEVICE_CLEAR_ACKNOWLEDGE
    assert client.say(T.DATA_END, 0, FIRST_ID + 2, b"message, on its way") == []
    assert client.session.reply(FIRST_ID, b"late") == []
    assert sent(client.say(T.DEVICE_CLEAR_COMPLETE))[0][0] == T.DEVICE_CLEAR_ACKNOWLEDGE
    (message,) = client.say(T.DATA_END, 0, FIRST_ID, b"*IDN?")
    assert message == ProgramMessage(client.session, FIRST_ID, b"*IDN?")


def test_status_query_and_message_available(client: Client) -> None:
    client.session.reply(2, b"x")
    assert client.say(T.ASYNC_STATUS_QUERY, 0, 2) == [StatusQuery(client.session)]
    assert client.session.unread_reply
    client.say(T.ASYNC_STATUS_QUERY, 1, 2)  # the client says it has read the reply
    assert not client.session.unread_reply
    assert sent(client.session.status(0x64)) == [(T.ASYNC_STATUS_RESPONSE, 0x64, 0, b"")]


def test_trigger_and_remote_local(client: Client) -> None:
    assert client.say(T.TRIGGER, 0, FIRST_ID) == [Triggered(client.session)]
    answer = sent(client.say(T.ASYNC_REMOTE_LOCAL_CONTROL, 1, 0))
    assert answer == [(T.ASYNC_REMOTE_LOCAL_RESPONSE, 0, 0, b"")]


def test_exclusive_lock_holds_back_the_others_until_released(
    server: HislipServerProtocol, client: Client
) -> None:
    other = Client(server)
    assert sent(client.say(T.ASYNC_LOCK, 1, 1000))[0][1] == 1
    assert sent(other.say(T.ASYNC_LOCK, 1, 1000))[0][1] == 0
    assert sent(other.say(T.ASYNC_LOCK_INFO))[0][1:3] == (1, 1)
    assert other.say(T.DATA_END, 0, FIRST_ID, b"OUTP 1") == []
    assert client.say(T.DATA_END, 0, FIRST_ID, b"OUTP 0") != []
    answer, freed = client.say(T.ASYNC_LOCK, 0, FIRST_ID)
    assert sent([answer])[0][1] == 1
    assert freed == ProgramMessage(other.session, FIRST_ID, b"OUTP 1")
    assert sent(client.say(T.ASYNC_LOCK, 0, FIRST_ID))[0][1] == 3  # it holds none any more


def test_shared_lock_is_for_those_who_know_its_name(
    server: HislipServerProtocol, client: Client
) -> None:
    friend, stranger = Client(server), Client(server)
    assert sent(client.say(T.ASYNC_LOCK, 1, 0, b"us"))[0][1] == 1
    assert sent(friend.say(T.ASYNC_LOCK, 1, 0, b"us"))[0][1] == 1
    assert sent(stranger.say(T.ASYNC_LOCK, 1, 0, b"me"))[0][1] == 0
    assert sent(stranger.say(T.ASYNC_LOCK, 1, 0))[0][1] == 0
    assert sent(stranger.say(T.ASYNC_LOCK_INFO))[0][1:3] == (0, 2)
    assert sent(friend.say(T.ASYNC_LOCK, 0, 0))[0][1] == 2


def test_a_lost_client_takes_its_lock_with_it(server: HislipServerProtocol, client: Client) -> None:
    other = Client(server)
    client.say(T.ASYNC_LOCK, 1, 0)
    other.say(T.DATA_END, 0, FIRST_ID, b"OUTP 0")
    events = client.synchronous.lost()
    assert events == [
        Close(client.asynchronous),
        ProgramMessage(other.session, FIRST_ID, b"OUTP 0"),
    ]
    assert client.session.state is SessionState.CLOSED
    assert client.asynchronous.lost() == []
    assert list(server.sessions) == [other.session.number]


def refused(events: list[Event], code: FatalErrorCode, connection: Connection) -> bool:
    """A fatal error was said on the connection and it is closed."""
    (kind, control, _, text), *rest = sent(events)
    assert not rest
    assert text
    return (kind, control) == (T.FATAL_ERROR, code) and Close(connection) in events


def test_bad_header_is_fatal_for_the_whole_session(client: Client) -> None:
    events = client.synchronous.receive(b"GET / HTTP/1.1\r\n\r\n")
    assert refused(events, FatalErrorCode.BAD_HEADER, client.synchronous)
    assert Close(client.asynchronous) in events
    assert client.synchronous.receive(encode(T.DATA_END, 0, 0, b"*IDN?")) == []


def test_data_before_both_channels_stand_is_fatal(server: HislipServerProtocol) -> None:
    half = server.connect()
    half.receive(encode(T.INITIALIZE, 0, 0x01000000, b"hislip0"))
    events = half.receive(encode(T.DATA_END, 0, 0, b"*IDN?"))
    assert refused(events, FatalErrorCode.CHANNELS_NOT_ESTABLISHED, half)
    fresh = server.connect()
    events = fresh.receive(encode(T.DATA_END, 0, 0, b"*IDN?"))
    assert refused(events, FatalErrorCode.CHANNELS_NOT_ESTABLISHED, fresh)


def test_initializing_twice_or_without_a_session_is_fatal(
    server: HislipServerProtocol, client: Client
) -> None:
    stray = server.connect()
    events = stray.receive(encode(T.ASYNC_INITIALIZE, 0, 4711))
    assert refused(events, FatalErrorCode.INVALID_INITIALIZATION, stray)
    events = client.say(T.INITIALIZE, 0, 0x01000000)
    assert refused(events, FatalErrorCode.INVALID_INITIALIZATION, client.synchronous)


def test_too_many_clients_are_refused_with_that_reason() -> None:
    server = HislipServerProtocol(max_sessions=1)
    Client(server)
    second = server.connect()
    events = second.receive(encode(T.INITIALIZE, 0, 0x01000000))
    assert refused(events, FatalErrorCode.TOO_MANY_CLIENTS, second)


@pytest.mark.parametrize(
    ("message", "code"),
    [
        (HEADER.pack(b"HS", 77, 0, 0, 3) + b"abc", ErrorCode.UNRECOGNISED_TYPE),
        (HEADER.pack(b"HS", 28, 0, 0, 0), ErrorCode.UNRECOGNISED_TYPE),
        (HEADER.pack(b"HS", 200, 0, 0, 1) + b"v", ErrorCode.UNRECOGNISED_VENDOR_MESSAGE),
        (encode(T.ASYNC_STATUS_QUERY), ErrorCode.UNRECOGNISED_TYPE),
        (encode(T.DATA, 0, 0, bytes(MAX_MESSAGE_SIZE + 1)), ErrorCode.MESSAGE_TOO_LARGE),
    ],
)
def test_a_message_that_cannot_be_used_is_skipped_and_the_session_continues(
    client: Client, message: bytes, code: ErrorCode
) -> None:
    kind, control, _, text = sent(client.synchronous.receive(message))[0]
    assert (kind, control) == (T.ERROR, code)
    assert text
    if code is ErrorCode.MESSAGE_TOO_LARGE:
        assert client.say(T.DATA_END, 0, 2, b"rest of it") == []
    assert len(client.say(T.DATA_END, 0, 4, b"*IDN?")) == 1


def test_client_that_reports_a_fatal_error_is_let_go(
    server: HislipServerProtocol, client: Client
) -> None:
    events = client.say(T.FATAL_ERROR, 0, 0, b"enough")
    assert Close(client.synchronous) in events
    assert Close(client.asynchronous) in events
    assert server.sessions == {}


@given(cuts=st.lists(st.integers(1, 40), min_size=1, max_size=30))
def test_any_fragmentation_gives_the_same_messages(cuts: list[int]) -> None:
    client = Client(HislipServerProtocol())
    stream = b"".join(
        encode(T.DATA, 0, FIRST_ID, b"abc" * n) + encode(T.DATA_END, 0, FIRST_ID + 2 * n, b"!")
        for n in range(5)
    )
    events: list[Event] = []
    at = 0
    while at < len(stream):
        step = cuts[at % len(cuts)]
        events += client.synchronous.receive(stream[at : at + step])
        at += step
    assert events == [
        ProgramMessage(client.session, FIRST_ID + 2 * n, b"abc" * n + b"!") for n in range(5)
    ]


@given(st.binary(max_size=100), st.booleans())
def test_garbage_never_brings_the_server_down(data: bytes, framed: bool) -> None:
    server = HislipServerProtocol()
    bystander = Client(server)
    hooligan = server.connect()
    hooligan.receive(b"HS" + data if framed else data)
    assert hooligan.role in (
        ChannelRole.NEW,
        ChannelRole.CLOSED,
        ChannelRole.SYNCHRONOUS,
        ChannelRole.ASYNCHRONOUS,
    )
    assert len(bystander.say(T.DATA_END, 0, FIRST_ID, b"*IDN?")) == 1
