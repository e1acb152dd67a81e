"""The Modbus TCP server: the specification's bytes, and pymodbus's own client on the wire."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import pytest
from hypothesis import given
from hypothesis import strategies as st
from patience import TIMEOUT_S
from pymodbus.client import ModbusTcpClient
from pymodbus.exceptions import ModbusException

from drivers.simulated.faults.plan import FaultPlan
from drivers.simulated.faults.wire import WireFaults
from drivers.simulated.transports.modbus_tcp import (
    MODBUS_DIALECT,
    FrameSplitter,
    ModbusError,
    ModbusFrameError,
    ModbusTcpServer,
    describe,
    frame,
    reply_to,
)

from ..ideal import serving


class Registers:
    """Two hundred registers that remember who wrote."""

    def __init__(self, name: str = "first") -> None:
        self.words = list(range(200))
        self.writers: list[str] = []
        self.objects = {0: "ACME", 1: name, 2: "1.0", 3: "url", 4: "product", 5: "model"}

    def read(self, address: int, count: int, by: str) -> Sequence[int]:
        if address + count > 200:
            raise ModbusError(2)
        return self.words[address : address + count]

    def write(self, address: int, values: Sequence[int], by: str) -> None:
        if address + len(values) > 200:
            raise ModbusError(2)
        self.words[address : address + len(values)] = values
        self.writers.append(by)

    def identification(self) -> Mapping[int, str]:
        return self.objects


def answer(request: str, device: Registers | None = None) -> str:
    """The reply PDU to a request PDU, both in hex."""
    return reply_to(bytes.fromhex(request), device or Registers(), "test").hex(" ")


# --- the specification's bytes ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("request_pdu", "reply_pdu"),
    [
        ("03 0064 0002", "03 04 00 64 00 65"),
        ("04 0001 0001", "04 02 00 01"),
        ("06 0005 abcd", "06 00 05 ab cd"),
        ("10 0001 0002 04 000a 0102", "10 00 01 00 02"),
        ("17 0005 0001 0005 0001 02 00ff", "17 02 00 ff"),
        ("2b 0e 04 00", "2b 0e 04 82 00 00 01 00 04 41 43 4d 45"),
        ("03 0000 0000", "83 03"),
        ("03 0000 007e", "83 03"),
        ("03 00c8 0001", "83 02"),
        ("03 ffff 0002", "83 02"),
        ("03 0000", "83 03"),
        ("10 0001 0002 03 000a 01", "90 03"),
        ("10 0001 0002 04 000a", "90 03"),
        ("10 00c7 0002 04 000a 0102", "90 02"),
        ("17 0005 0000 0005 0001 02 00ff", "97 03"),
        ("01 0000 0001", "81 01"),
        ("2b 0d 00 00", "ab 01"),
        ("2b 0e 05 00", "ab 03"),
        ("2b 0e 04 09", "ab 02"),
    ],
)
def test_a_request_and_its_reply(request_pdu: str, reply_pdu: str) -> None:
    assert answer(request_pdu) == reply_pdu


def test_read_write_writes_first_and_a_refused_one_changes_nothing() -> None:
    device = Registers()
    answer("17 0005 0000 0005 0001 02 00ff", device)
    assert device.words[5] == 5
    answer("17 0005 0001 0005 0001 02 00ff", device)
    assert device.words[5] == 0xFF


def test_long_identification_continues_in_a_second_reply() -> None:
    device = Registers()
    device.objects = dict.fromkeys(range(6), "x" * 100)
    first = reply_to(bytes.fromhex("2b0e0200"), device, "test")
    assert (first[4], first[5], first[6]) == (0xFF, 2, 2)
    second = reply_to(bytes([0x2B, 0x0E, 2, first[5]]), device, "test")
    assert second[7] == 2


def test_a_fault_plan_can_name_a_request() -> None:
    assert describe(bytes.fromhex("0300640002")) == b"FC3 100"
    assert describe(bytes.fromhex("2b0e0100")) == b"FC43"
    assert describe(b"\x03") == b"FC3"


@given(st.binary(min_size=1, max_size=60))
def test_no_request_is_too_strange_for_a_reply(pdu: bytes) -> None:
    reply = reply_to(pdu, Registers(), "test")
    assert reply[0] in (pdu[0], pdu[0] | 0x80)
    assert len(reply) <= 253


@given(st.lists(st.binary(min_size=1, max_size=30), max_size=5), st.data())
def test_frames_arrive_whole_however_the_stream_is_cut(
    pdus: list[bytes], data: st.DataObject
) -> None:
    stream = b"".join(frame(number, 1, pdu) for number, pdu in enumerate(pdus))
    splitter, got = FrameSplitter(), []
    while stream:
        cut = data.draw(st.integers(1, len(stream)))
        got += splitter.feed(stream[:cut])
        stream = stream[cut:]
    assert got == [(number, 1, pdu) for number, pdu in enumerate(pdus)]


@pytest.mark.parametrize("bad", ["0001 0001 0003 01 03", "0001 0000 0001 01", "0001 0000 0fff 01"])
def test_what_is_no_frame_ends_the_connection(bad: str) -> None:
    with pytest.raises(ModbusFrameError):
        FrameSplitter().feed(bytes.fromhex(bad))


# --- pymodbus on the wire --------------------------------------------------------------------


@contextmanager
def client_of(server: ModbusTcpServer) -> Iterator[ModbusTcpClient]:
    client = ModbusTcpClient("127.0.0.1", port=server.port, timeout=TIMEOUT_S, retries=0)
    assert client.connect()
    try:
        yield client
    finally:
        client.close()


@pytest.fixture
def device() -> Registers:
    return Registers()


def faulty(device: Registers, **fault: object) -> ModbusTcpServer:
    plan = FaultPlan.model_validate({"fault": [{"device": "it", **fault}]})
    return ModbusTcpServer(device, faults=WireFaults(plan, "it", MODBUS_DIALECT))


def test_every_function_under_pymodbus(device: Registers) -> None:
    server = ModbusTcpServer(device)
    with serving(server), client_of(server) as client:
        assert client.read_holding_registers(100, count=28).registers == list(range(100, 128))
        assert not client.write_register(3, 77).isError()
        assert not client.write_registers(4, [1, 2, 3]).isError()
        both = client.readwrite_registers(read_address=3, read_count=4, write_address=6, values=[9])
        assert both.registers == [77, 1, 2, 9]
        assert client.read_device_information(read_code=1).information == {
            0: b"ACME",
            1: b"first",
            2: b"1.0",
        }
        assert client.read_device_information(read_code=2).information[5] == b"model"
        refused = client.read_holding_registers(199, count=2)
        assert (refused.isError(), refused.exception_code) == (True, 2)


def test_two_devices_of_one_process_are_two() -> None:
    servers = [ModbusTcpServer(Registers("z")), ModbusTcpServer(Registers("x"))]
    with serving(*servers), client_of(servers[0]) as one, client_of(servers[1]) as other:
        assert one.read_device_information(read_code=1).information[1] == b"z"
        assert other.read_device_information(read_code=1).information[1] == b"x"


def test_several_clients_at_once_have_their_own_names(device: Registers) -> None:
    server = ModbusTcpServer(device)
    with serving(server), client_of(server) as run, client_of(server) as guard:
        run.write_register(1, 1)
        guard.write_register(1, 2)
        run.write_register(1, 3)
        assert device.writers == ["modbus#1", "modbus#2", "modbus#1"]
        assert len(server.transports) == 2


def test_a_unit_that_is_not_there_is_silent(device: Registers) -> None:
    server = ModbusTcpServer(device)
    with serving(server), client_of(server) as client:
        with pytest.raises(ModbusException, match="No response"):
            client.read_holding_registers(0, count=1, device_id=7)
        assert client.read_holding_registers(0, count=1, device_id=1).registers == [0]


@pytest.mark.parametrize("kind", ["silence", "garbage", "close", "truncate", "stale"])
def test_faults_reach_the_client_and_the_device_acts_all_the_same(
    device: Registers, kind: str
) -> None:
    server = faulty(device, kind=kind, command="FC6 1")
    with serving(server), client_of(server) as client:
        client.read_holding_registers(0, count=1)
        with pytest.raises(ModbusException):
            client.write_register(1, 99)
        assert device.words[1] == 99
        client.close()
        assert client.read_holding_registers(1, count=1).registers == [99]


def test_a_stale_reply_comes_late_on_its_own_connection(device: Registers) -> None:
    server = faulty(device, kind="stale")
    with serving(server), client_of(server) as client:
        with pytest.raises(ModbusException):
            client.read_holding_registers(5, count=1)
        assert client.read_holding_registers(6, count=1).registers == [6], "the late one is known"


def test_rubbish_is_disconnected_and_others_are_spared(device: Registers) -> None:
    server = ModbusTcpServer(device)
    with serving(server), client_of(server) as client:
        with socket.create_connection(("127.0.0.1", server.port), timeout=5) as stranger:
            stranger.sendall(b"GET / HTTP/1.1\r\n\r\n")
            try:
                got = stranger.recv(100)
            except ConnectionError:
                got = b""
            assert got == b""
        assert client.read_holding_registers(1, count=1).registers == [1]


def test_requests_in_one_packet_are_answered_in_order(device: Registers) -> None:
    server = ModbusTcpServer(device)
    reads = [bytes.fromhex(f"03 {register:04x} 0001") for register in (7, 8)]
    with serving(server), socket.create_connection(("127.0.0.1", server.port), timeout=5) as raw:
        raw.sendall(b"".join(frame(number, 1, pdu) for number, pdu in enumerate(reads)))
        got, deadline = b"", time.monotonic() + 5
        while len(got) < 22 and time.monotonic() < deadline:
            got += raw.recv(100)
    assert got == frame(0, 1, b"\x03\x02\x00\x07") + frame(1, 1, b"\x03\x02\x00\x08")


def test_an_exception_that_the_device_did_not_mean(device: Registers) -> None:
    server = faulty(device, kind="error", code=4, command="FC16", at=2)
    with serving(server), client_of(server) as client:
        assert not client.write_registers(4, [1]).isError()
        refused = client.write_registers(5, [2])
        assert (refused.isError(), refused.exception_code) == (True, 4)
        assert client.read_holding_registers(4, count=2).registers == [1, 2], "it was done"


def test_a_doubled_reply_is_no_answer_to_the_next_request(device: Registers) -> None:
    server = faulty(device, kind="double", command="FC3 100")
    with serving(server), client_of(server) as client:
        assert client.read_holding_registers(100, count=1).registers == [100]
        try:
            got = client.read_holding_registers(7, count=1).registers
        except ModbusException:
            got = None
        assert got in (None, [7])
