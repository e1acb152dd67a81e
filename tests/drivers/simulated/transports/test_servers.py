"""The servers under the real client library: pyvisa with pyvisa-py, over loopback."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Iterator
from typing import Any, cast

import numpy as np
import pytest
import pyvisa
from pyvisa.constants import StatusCode
from pyvisa.resources import MessageBasedResource
from pyvisa_py.protocols.hislip import Instrument as PyvisaHislip

from drivers.simulated.faults.plan import FaultPlan
from drivers.simulated.faults.wire import WireFaults
from drivers.simulated.instruments.keysight_33500b import Keysight33500B
from drivers.simulated.instruments.keysight_u2300a import KeysightU2300A
from drivers.simulated.transports.scpi_servers import SCPI_DIALECT, HislipServer, ScpiSocketServer

from ..ideal import IdealBench, serving

BLOCK_POINTS = 500_000  # two channels of int16: a block of 2 MB


class Bench:
    """Both instruments, both transports, and clients as they are asked for."""

    def __init__(self, manager: pyvisa.ResourceManager):
        self.manager = manager
        self.world = IdealBench(wave=lambda terminal, time_s: (terminal - 101) + time_s)
        self.generator = Keysight33500B(self.world, self.world)
        self.daq = KeysightU2300A("U2331A", self.world, self.world)
        self.faults = WireFaults(FaultPlan(), "none")
        self.clients: list[MessageBasedResource] = []

    def plan(self, **fault: object) -> None:
        faults = FaultPlan.model_validate({"fault": [{"device": "it", **fault}]})
        self.faults = WireFaults(faults, "it", SCPI_DIALECT)

    def server(self, transport: str, instrument: Any) -> Any:
        kind = ScpiSocketServer if transport == "socket" else HislipServer
        return kind(instrument, faults=self.faults)

    def client(self, server: Any, timeout_ms: int = 2000) -> MessageBasedResource:
        if isinstance(server, HislipServer):
            name = f"TCPIP0::127.0.0.1::hislip0,{server.port}::INSTR"
        else:
            name = f"TCPIP0::127.0.0.1::{server.port}::SOCKET"
        client = cast(MessageBasedResource, self.manager.open_resource(name))
        client.read_termination = client.write_termination = "\n"
        client.timeout = timeout_ms
        self.clients.append(client)
        return client


@pytest.fixture
def bench() -> Iterator[Bench]:
    manager = pyvisa.ResourceManager("@py")
    bench = Bench(manager)
    yield bench
    for client in bench.clients:
        client.close()
    manager.close()


BOTH = pytest.mark.parametrize("transport", ["socket", "hislip"])


@BOTH
def test_query_set_and_error_in_one_message(bench: Bench, transport: str) -> None:
    server = bench.server(transport, bench.generator)
    with serving(server):
        client = bench.client(server)
        assert client.query("*IDN?").startswith("Agilent Technologies,33512B,SIM")
        assert client.query("SOUR1:FREQ 2;:SYST:ERR?") == '+0,"No error"'
        assert client.query("SOUR1:FREQ?;:SOUR1:FUNC?") == "+2.000000000000000E+00;SIN"
        assert client.query("SOUR1:FREQ 1 GHZ;:SYST:ERR?").startswith("-222,")
        assert bench.world.entries[0] == ("generator", "ch1.frequency_Hz", 2.0, f"{transport}#1")


@BOTH
def test_binary_block_of_two_megabytes(bench: Bench, transport: str) -> None:
    server = bench.server(transport, bench.daq)
    with serving(server):
        client = bench.client(server, timeout_ms=10_000)
        client.query(f"ROUT:SCAN (@101,102);:ACQ:SRAT 500000;:ACQ:POIN {BLOCK_POINTS};:DIG;*OPC?")
        bench.world.now_us = 1_000_000
        client.write("WAV:DATA?")
        header = client.read_bytes(10)
        assert header == b"#8%08d" % (4 * BLOCK_POINTS)
        words = np.frombuffer(client.read_bytes(4 * BLOCK_POINTS), "<i2").reshape(-1, 2) >> 4
        time_s = np.arange(BLOCK_POINTS) / 500e3
        assert np.abs(words[:, 0] * 20 / 4095 - time_s).max() < 0.51 * 20 / 4095
        assert np.abs(words[:, 1] * 20 / 4095 - time_s - 1).max() < 0.51 * 20 / 4095
        assert client.query("SYST:ERR?") == '+0,"No error"'


def test_binary_block_by_the_librarys_own_reader(bench: Bench) -> None:
    server = bench.server("hislip", bench.daq)
    with serving(server):
        client = bench.client(server)
        client.query("ACQ:POIN 1000;:DIG;*OPC?")
        bench.world.now_us = 1_000_000
        words = client.query_binary_values("WAV:DATA?", datatype="h", expect_termination=False)
        assert len(words) == 1000


@BOTH
def test_second_client_gets_in_beside_a_hung_one(bench: Bench, transport: str) -> None:
    server = bench.server(transport, bench.generator)
    with serving(server):
        hung, guard = bench.client(server), bench.client(server)
        hung.write("OUTP1 ON")
        assert hung.query("OUTP1?") == "1"
        if transport == "socket":
            hung.write_raw(b"SOUR1:FR")  # stops in the middle of a message
        assert guard.query("OUTP1 OFF;:OUTP1?") == "0"
        assert [entry[2:] for entry in bench.world.entries] == [
            (True, f"{transport}#1"),
            (False, f"{transport}#2"),
        ]


def test_device_clear_and_status_byte(bench: Bench) -> None:
    server = bench.server("hislip", bench.generator)
    with serving(server):
        client = bench.client(server)
        assert client.query("FREQ fast;*OPC?") == "1"
        client.clear()
        assert client.query("*IDN?").startswith("Agilent")
        assert client.read_stb() & 4  # an error waits in the queue
        assert client.query("SYST:ERR?").startswith("-104,")
        assert client.read_stb() & 4 == 0


def test_the_clients_own_protocol_layer_agrees_on_locks_sizes_and_triggers(bench: Bench) -> None:
    server = bench.server("hislip", bench.generator)
    with serving(server):
        first = PyvisaHislip("127.0.0.1", port=server.port, timeout=5.0)
        second = PyvisaHislip("127.0.0.1", port=server.port, timeout=5.0)
        first.max_msg_size = 128
        first.send(b";".join([b"*IDN?"] * 20))
        assert first.receive(10_000).count(b"33512B") == 20
        assert first.async_lock_request(0.0) == "success"
        assert second.async_lock_request(0.0) == "failure"
        assert second.async_lock_info() == 1
        assert first.async_lock_release() == "success"
        first.async_remote_local_control("enableRemote")
        second.trigger()
        second.send(b"SYST:ERR?")
        assert second.receive(100).startswith(b"-211,")
        first.close()
        second.close()


@BOTH
def test_recovery_after_a_lost_reply(bench: Bench, transport: str) -> None:
    bench.plan(kind="silence", command="FREQ?")
    server = bench.server(transport, bench.generator)
    with serving(server):
        client = bench.client(server, timeout_ms=100)
        with pytest.raises(pyvisa.VisaIOError) as error:
            client.query("FREQ?")
        assert error.value.error_code == StatusCode.error_timeout
        client.timeout = 2000
        assert client.query("*IDN?").startswith("Agilent")
        assert float(client.query("FREQ?")) == 1000.0


@pytest.mark.parametrize(("transport", "deceived"), [("socket", True), ("hislip", False)])
def test_stale_reply_deceives_a_line_client_but_not_message_numbers(
    bench: Bench, transport: str, deceived: bool
) -> None:
    bench.plan(kind="stale", command="VOLT?")
    server = bench.server(transport, bench.generator)
    with serving(server):
        client = bench.client(server, timeout_ms=100)
        with pytest.raises(pyvisa.VisaIOError):
            client.query("VOLT?")
        client.timeout = 2000
        answer = float(client.query("FREQ?"))
        assert answer == (0.1 if deceived else 1000.0)


@BOTH
def test_closed_connection_is_closed_for_that_client_only(bench: Bench, transport: str) -> None:
    bench.plan(kind="close", at=2, command="FREQ?")
    server = bench.server(transport, bench.generator)
    with serving(server):
        other = bench.client(server)
        assert other.query("FREQ?").startswith("+1.0")
        if transport == "hislip":
            client = bench.client(server, timeout_ms=500)
            with pytest.raises(RuntimeError, match="dropped"):
                client.query("FREQ?")
        else:
            with socket.create_connection(("127.0.0.1", server.port), timeout=5) as raw:
                raw.sendall(b"FREQ?\n")
                assert raw.recv(100) == b""
        assert other.query("FREQ?").startswith("+1.0")


def test_truncated_block_on_the_socket_leaves_the_client_waiting(bench: Bench) -> None:
    bench.plan(kind="truncate", command="WAV:DATA?")
    server = bench.server("socket", bench.daq)
    with serving(server):
        client = bench.client(server)
        client.query("ACQ:POIN 100;:DIG;*OPC?")
        bench.world.now_us = 1_000_000
        client.write("WAV:DATA?")
        assert client.read_bytes(10) == b"#800000200"
        client.timeout = 100
        with pytest.raises(pyvisa.VisaIOError):
            client.read_bytes(200)


def test_raw_socket_answers_pipelined_messages_in_order(bench: Bench) -> None:
    server = bench.server("socket", bench.generator)
    with serving(server), socket.create_connection(("127.0.0.1", server.port), timeout=5) as raw:
        raw.sendall(b"*OPC?\nFREQ 5\nFREQ?\r\nOUT")
        raw.sendall(b"P1?\n")
        with raw.makefile("rb") as lines:
            assert [next(lines) for _ in range(3)] == [b"1\n", b"+5.000000000000000E+00\n", b"0\n"]


@BOTH
def test_garbage_of_one_client_does_not_disturb_another(bench: Bench, transport: str) -> None:
    server = bench.server(transport, bench.generator)
    with serving(server), socket.create_connection(("127.0.0.1", server.port), timeout=5) as raw:
        raw.sendall(bytes(range(256)) * 10)
        assert bench.client(server).query("*OPC?") == "1"


def test_taken_port_is_reported_and_a_closed_server_frees_it(bench: Bench) -> None:
    async def scenario() -> None:
        first = ScpiSocketServer(bench.generator)
        await first.start()
        second = ScpiSocketServer(bench.generator, port=first.port)
        with pytest.raises(OSError, match="in use"):
            await second.start()
        await first.close()
        await second.start()
        await second.close()

    asyncio.run(scenario())


@BOTH
def test_an_error_that_was_not_there_stands_in_the_queue(bench: Bench, transport: str) -> None:
    bench.plan(kind="error", code=-310, at=2)
    server = bench.server(transport, bench.generator)
    with serving(server):
        client = bench.client(server)
        assert client.query("SOUR1:FREQ 2;:SYST:ERR?") == '+0,"No error"'
        assert client.query("SOUR1:FREQ?") == "+2.000000000000000E+00", "it carries none"
        assert client.query("SOUR1:FREQ 3;:SYST:ERR?").startswith("-310,")
        assert client.query("SOUR1:FREQ?;:SYST:ERR?").endswith('+0,"No error"')


@BOTH
def test_a_reset_reaches_the_client(bench: Bench, transport: str) -> None:
    bench.plan(kind="reset", command="FREQ?")
    server = bench.server(transport, bench.generator)
    with serving(server):
        client = bench.client(server)
        with pytest.raises(Exception, match=r"reset|CONN_LOST|connection"):
            client.query("FREQ?")
        assert bench.client(server).query("FREQ?").startswith("+1.0")


@BOTH
def test_behind_a_half_open_connection_nothing_is_obeyed(bench: Bench, transport: str) -> None:
    bench.plan(kind="half-open", command="FREQ?")
    server = bench.server(transport, bench.generator)
    with serving(server):
        client = bench.client(server, timeout_ms=200)
        for _ in range(2):
            with pytest.raises(pyvisa.errors.VisaIOError):
                client.query("FREQ?")
        client.write("SOUR1:FREQ 77")
        assert bench.client(server).query("FREQ?").startswith("+1.0"), "the 77 went nowhere"


@pytest.mark.parametrize(("transport", "at"), [("socket", 2), ("hislip", 3)])
def test_refused_connections_have_no_listener(bench: Bench, transport: str, at: int) -> None:
    bench.plan(kind="refused", at=at)
    server = bench.server(transport, bench.generator)
    with serving(server):
        client = bench.client(server)
        assert client.query("FREQ?").startswith("+1.0")
        with (
            pytest.raises(ConnectionRefusedError),
            socket.create_connection(("127.0.0.1", server.port)),
        ):
            pass
        assert client.query("FREQ?").startswith("+1.0"), "what stands is not disturbed"


def test_who_is_refused_from_the_first_connection_on_meets_a_port_that_is_taken(
    bench: Bench,
) -> None:
    bench.plan(kind="refused")
    server = bench.server("socket", bench.generator)
    with (
        serving(server),
        pytest.raises(ConnectionRefusedError),
        socket.create_connection(("127.0.0.1", server.port)),
    ):
        pass
