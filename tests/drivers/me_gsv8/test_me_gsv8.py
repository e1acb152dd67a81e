"""The force amplifier's driver on the wire, over a pseudo-terminal: what is sent, in order, and
what each reply leads to; then against the simulator, with faults."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from patience import TIMEOUT_S
from pydantic import ValidationError
from simulated.ideal import serving

from drivers.me_gsv8.driver import ForceAmplifier, Settings, connect, make_safe
from drivers.simulated.faults.plan import FaultPlan
from drivers.simulated.faults.wire import WireFaults
from drivers.simulated.instruments.gsv8_converter import Sensor
from drivers.simulated.instruments.gsv8_memory import GsvMemory
from drivers.simulated.instruments.me_gsv8 import Gsv8
from drivers.simulated.ports import Exchange
from drivers.simulated.transports.serial_server import PtyServer
from rig.core.clock import Clock, WallClock
from rig.core.errors import InstrumentError, InstrumentTimeoutError
from rig.instruments.roles import ForceFrames

# --- a transcript ----------------------------------------------------------------------------


class Transcript:
    """An amplifier that knows one conversation by heart; anything else fails the test."""

    now_us = 0

    def __init__(self, *exchanges: tuple[str, str]):
        self._due = [(bytes.fromhex(sent), bytes.fromhex(reply)) for sent, reply in exchanges]
        self._came = b""

    def exchanges(self, data: bytes, by: str) -> Iterable[Exchange]:
        self._came += data
        while self._due and self._came.startswith(self._due[0][0]):
            sent, reply = self._due.pop(0)
            self._came = self._came[len(sent) :]
            yield Exchange(sent, reply)

    def frames_until(self, now_us: int) -> bytes:
        return b""

    def verify(self) -> None:
        expected = self._due[0][0].hex(" ") if self._due else "nothing"
        assert not self._came, f"\nexpected {expected}\n     got {self._came.hex(' ')}"
        assert not self._due, f"never sent: {expected}"


@contextmanager
def playing(*exchanges: tuple[str, str]) -> Iterator[str]:
    """The serial port at which the conversation is played; verified at the end."""
    transcript = Transcript(*exchanges)
    server = PtyServer(transcript, transcript)
    with serving(server):
        try:
            yield server.path
        finally:
            transcript.verify()


def checked(wire: str) -> str:
    """A request or response with the CRC-8 that firmware 1.56 has: its type bits and check."""
    frame = bytearray.fromhex(wire)
    frame[1] |= 0x20
    check = 0
    for byte in frame[1:-1]:
        check ^= byte
        for _ in range(8):
            check = check << 1 ^ 0x107 if check & 0x80 else check << 1
    return (bytes(frame[:-1]) + bytes((check,)) + b"\x85").hex()


OK = "AA 50 00 85"
STOP, START = "AA 90 23 85", "AA 90 24 85"
SERIAL = ("AA 90 1F 85", "AA 58 00 32 31 30 33 34 34 31 35 85")
MAPPING = ("AA 91 49 00 85", "AA 52 00 00 03 85")  # three values a frame
HELLO = ((STOP, OK), SERIAL, MAPPING, SERIAL)
VALUES = (
    ("AA 92 A2 01 FF 85", "AA 55 00 00 0000015E 85"),  # channel 1: 3.50 mV/V
    ("AA 91 14 01 85", "AA 54 00 40 60 00 00 85"),  # user scale 3.5
    ("AA 92 A2 02 FF 85", "AA 55 00 00 0000015E 85"),
    ("AA 91 14 02 85", "AA 54 00 40 60 00 00 85"),
    ("AA 92 A2 03 FF 85", "AA 55 00 00 0000015E 85"),
    ("AA 91 14 03 85", "AA 54 00 40 60 00 00 85"),
    ("AA 90 26 85", "AA 54 00 00 00 00 02 85"),  # mode: automatic filter
    ("AA 91 80 01 85", "AA 52 00 00 03 85"),  # floats
    MAPPING,
    ("AA 91 63 00 85", "AA 54 00 46 3B 80 00 85"),  # to 12000 frames/s
    ("AA 91 63 01 85", "AA 54 00 3F 80 00 00 85"),  # from 1 frame/s
)
RATE_IS_1000 = ("AA 90 8A 85", "AA 54 00 44 7A 00 00 85")
FIRMWARE_1_42 = ("AA 90 2B 85", "AA 54 00 0001 002A 85")  # no CRC
MODEL = ("AA 90 01 85", "AA 54 00 08 23 00 00 85")
OLD = (*HELLO, FIRMWARE_1_42, MODEL, RATE_IS_1000, *VALUES)


def settings(port: str, **more: object) -> Settings:
    return Settings.model_validate({"port": port, "timeout_s": TIMEOUT_S, **more})


def connected(port: str, clock: Clock | None = None, **more: object) -> ForceAmplifier:
    return connect(settings(port, **more), clock or WallClock())


def read_frames(amplifier: ForceAmplifier, count: int, within_s: float = 5.0) -> ForceFrames:
    """So many frames or more, in one piece, every one in its place."""
    pieces: list[ForceFrames] = []
    deadline = time.monotonic() + within_s
    while sum(map(len, pieces)) < count and time.monotonic() < deadline:
        if (piece := amplifier.read()) is not None:
            assert piece.first_index == (pieces[-1].first_index + len(pieces[-1]) if pieces else 0)
            pieces.append(piece)
    assert sum(map(len, pieces)) >= count, "the frames did not come"
    parts = [
        np.concatenate(part)
        for part in zip(*((p.raw, p.force_N, p.saturated) for p in pieces), strict=True)
    ]
    return ForceFrames(0, *parts)


def test_connecting_to_old_firmware_stops_identifies_and_only_reads_what_is_right() -> None:
    with playing(*OLD) as port:
        amplifier = connected(port)
        assert amplifier.identity.serial_number == "21034415"
        assert amplifier.identity.firmware == "1.42"
        assert not amplifier.identity.simulated
        assert amplifier.limits()["rate"].high == 12000
        assert amplifier.limits()["force"].low == -50
        amplifier.close()


def test_answers_to_the_connection_before_are_not_taken_for_those_of_this_one() -> None:
    late = OK + SERIAL[1]  # to the stop and the query of a connection that was lost
    opening = ((STOP, ""), (SERIAL[0], late), (MAPPING[0], OK + SERIAL[1] + MAPPING[1]))
    with playing(*opening, SERIAL, *OLD[len(HELLO) :]) as port:
        amplifier = connected(port)
        assert amplifier.identity.serial_number == "21034415"
        amplifier.close()


def test_frames_that_came_while_connecting_belong_to_no_stream() -> None:
    eight = "AA 17 B0" + 8 * " 3F 80 00 00" + " 85"
    (stop, stopped), *others = OLD
    with playing((stop, f"{eight} {eight} {stopped}"), *others) as port:
        amplifier = connected(port)
        assert amplifier.read() is None
        amplifier.close()


def test_firmware_1_56_gets_the_crc_switched_on_and_on_every_frame() -> None:
    exchanges = (
        *HELLO,
        ("AA 90 2B 85", "AA 54 00 0001 0038 85"),
        ("AA B1 01 08 AC 85", checked("AA 54 00 08 23 00 00 85")),
        *((checked(sent), checked(reply)) for sent, reply in (RATE_IS_1000, *VALUES)),
    )
    with playing(*exchanges) as port:
        connected(port).close()


def test_a_setting_that_differs_is_written_once_and_read_back() -> None:
    changed = [
        *HELLO,
        FIRMWARE_1_42,
        MODEL,
        ("AA 90 8A 85", "AA 54 00 41 20 00 00 85"),  # 10 frames/s
        ("AA 94 8B 44 7A 00 00 85", OK),
        RATE_IS_1000,
        *VALUES[:-3],
        ("AA 91 49 00 85", "AA 52 00 00 08 85"),  # eight values
        ("AA 93 4A 00 00 03 85", OK),
        *VALUES[-3:],
    ]
    with playing(*changed) as port:
        connected(port).close()


def test_a_setting_that_does_not_stick_is_an_error() -> None:
    exchanges = (
        *OLD[:-3],
        ("AA 91 49 00 85", "AA 52 00 00 08 85"),
        ("AA 93 4A 00 00 03 85", OK),
        ("AA 91 49 00 85", "AA 52 00 00 08 85"),
    )
    reported = "set to 00 03 but reads back 00 08"
    with playing(*exchanges) as port, pytest.raises(InstrumentError, match=reported):
        connected(port)


def test_another_model_is_refused_by_name_and_nothing_is_written_to_it() -> None:
    exchanges = (*HELLO, FIRMWARE_1_42, ("AA 90 01 85", "AA 54 00 06 23 00 00 85"))
    with playing(*exchanges) as port:
        with pytest.raises(InstrumentError, match="model number 06, serial 21034415") as caught:
            connected(port)
        assert "a GSV-8 (08) is expected" in str(caught.value.hint)


def test_a_refusal_names_command_code_and_reason() -> None:
    exchanges = (*OLD, RATE_IS_1000, ("AA 94 8B 47 3B 80 00 85", "AA 50 64 85"))
    with playing(*exchanges) as port:
        amplifier = connected(port)
        with pytest.raises(
            InstrumentError, match="WriteDataRate 47 3b 80 00: refused with error 64: data rate"
        ):
            amplifier.start(48000)
        amplifier.close()


MEASURED = "AA 12 B0 3E 00 00 00  BE 80 00 00  3F 00 00 00 85"  # 0.125, -0.25, 0.5 mV/V
SATURATED = "AA 12 B1 3E 00 00 00  BE 80 00 00  40 6B 33 33 85"


def test_measurements_between_request_and_response_are_kept_and_those_before_dropped() -> None:
    exchanges = (
        (STOP, MEASURED + MEASURED[:12] + OK),
        *OLD[1:],
        RATE_IS_1000,
        (START, OK + MEASURED + SATURATED),
        (STOP, MEASURED + OK),
        RATE_IS_1000,
        (START, OK + MEASURED),
    )
    with playing(*exchanges) as port:
        amplifier = connected(port)
        assert amplifier.start(1000) == 1000
        assert amplifier.tare((0.025, 0, -0.5)) == pytest.approx((0.025 * 50 / 0.6, 0, -25 / 0.6))
        amplifier.tare((0.025, 0, 0))
        frames = read_frames(amplifier, 2)
        assert frames.raw.tolist() == [[0.125, -0.25, 0.5], pytest.approx([0.125, -0.25, 3.675])]
        assert frames.force_N[0] == pytest.approx(
            [0.1 * 50 / 0.6, -0.25 * 50 / 0.6, 0.5 * 50 / 0.6]
        )
        assert frames.saturated.tolist() == [False, True]
        amplifier.stop()
        amplifier.start(1000)
        again = read_frames(amplifier, 1)
        assert len(again) == 1
        assert again.first_index == 0
        amplifier.close()


@pytest.mark.parametrize(
    ("wire", "reported"),
    [
        ("00 FF", "2 bytes came that are not a frame: 00 ff"),
        ("AA 11 B0 00000000 00000000 85", "12 bytes came that are not a frame: aa 11 b0"),
        (MEASURED[3:].replace(" ", ""), "15 bytes came that are not a frame: 12 b0 3e"),
    ],
)
def test_bytes_that_are_no_frame_end_the_stream_until_it_is_started_again(
    wire: str, reported: str
) -> None:
    exchanges = (
        *OLD,
        RATE_IS_1000,
        (START, OK + MEASURED + wire + MEASURED),
        (STOP, OK),
        RATE_IS_1000,
        (START, OK + MEASURED),
    )
    with playing(*exchanges) as port:
        amplifier = connected(port)
        amplifier.start(1000)
        for _ in range(2):
            with pytest.raises(InstrumentError, match=reported):
                read_frames(amplifier, 3)
        amplifier.stop()
        amplifier.start(1000)
        assert len(read_frames(amplifier, 1)) == 1
        amplifier.close()


def test_a_late_answer_is_never_taken_for_the_next_one() -> None:
    """The first rate never comes, then comes in front of the token's answer."""
    late = "AA 54 00 41 20 00 00 85"
    lost, token = (RATE_IS_1000[0], ""), (SERIAL[0], late + SERIAL[1])
    with playing(*OLD, lost, token, RATE_IS_1000, (START, OK)) as port:
        amplifier = connected(port)
        reported = f"ReadDataRate: no answer within {TIMEOUT_S:g} s"
        with pytest.raises(InstrumentTimeoutError, match=reported):
            amplifier.start(1000)
        assert amplifier.start(1000) == 1000
        amplifier.close()


def test_a_port_that_is_not_there_is_one_error_with_its_name() -> None:
    with pytest.raises(InstrumentError, match="the connection failed") as caught:
        connected("/dev/no-such-port")
    assert "/dev/no-such-port" in caught.value.one_line()


def test_a_port_that_another_program_has_is_refused() -> None:
    with playing(*OLD) as port:
        amplifier = connected(port)
        with pytest.raises(InstrumentError, match="exclusive"):
            connected(port)
        make_safe(settings(port))  # it has nothing to do, and so needs no port
        amplifier.close()


@pytest.mark.parametrize(
    ("wrong", "reported"),
    [
        ({"port": ""}, "port"),
        ({"rate_S_s": 13_000}, "rate_S_s"),
        ({"nominal_force_N": -5}, "nominal_force_N"),
        ({"max_force_N": 80}, "beyond 1.5 times"),
        ({"matrix_N_mV_V": ((1, 2, 3), (2, 4, 6), (0, 0, 1))}, "cannot be inverted"),
        ({"baud": 9600}, "baud"),
    ],
)
def test_settings_that_cannot_be(wrong: dict[str, object], reported: str) -> None:
    with pytest.raises(ValidationError, match=reported):
        Settings.model_validate({"port": "/dev/ttyACM0", **wrong})


# --- against the simulator -------------------------------------------------------------------


class World:
    """A clock moved by hand and a steady force."""

    def __init__(self) -> None:
        self.now_us = 0
        self.noise_key = (3, 0, 0)
        self.streaming: list[object] = []

    def force_N(self, times_s: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:  # noqa: N802
        return np.tile([2.0, -3.0, 25.0], (len(times_s), 1))

    def log(self, device: str, what: str, value: object, by: str) -> None:
        if what == "streaming":
            self.streaming.append(value)


class Bench:
    """A simulated amplifier on a port, in slaved time."""

    def __init__(self, *faults: dict[str, Any], memory: GsvMemory | None = None):
        self.world = World()
        self.core = Gsv8(self.world, self.world, memory=memory)
        plan = FaultPlan.model_validate({"fault": [{"device": "it", **f} for f in faults]})
        stream, replies = (
            FaultPlan(fault=tuple(f for f in plan.fault if (f.command == "STREAM") is on))
            for on in (True, False)
        )
        self.server = PtyServer(
            self.core,
            self.world,
            slaved=True,
            faults=WireFaults(replies, "it"),
            stream_faults=WireFaults(stream, "it"),
        )
        self.clock = BenchClock(self)

    def connect(self) -> ForceAmplifier:
        return connected(self.server.path, self.clock, matrix_N_mV_V=Sensor().matrix)


class BenchClock(Clock):
    """Moves the World in the server's thread and pumps, as a control server does; a batch of
    frames is a millisecond."""

    def __init__(self, bench: Bench):
        super().__init__()
        self._bench = bench

    def now(self) -> float:
        return self._bench.world.now_us * 1e-6

    def sleep(self, seconds: float) -> None:
        for _ in range(round(seconds / 0.001)):
            self._pass(0.001)

    def _pass(self, seconds: float) -> None:
        def advance() -> None:
            self._bench.world.now_us += round(seconds * 1e6)
            self._bench.server.pump()
            done.set()

        done = threading.Event()
        loop = self._bench.server._loop
        assert loop is not None
        loop.call_soon_threadsafe(advance)
        assert done.wait(5)


def test_a_stream_from_the_simulator_is_whole_and_true() -> None:
    bench = Bench()
    with serving(bench.server):
        amplifier = bench.connect()
        assert amplifier.identity.simulated
        assert amplifier.start(1000) == 1000
        assert amplifier.read() is None, "no time has passed"
        amplifier.tare(Sensor().zero_mV_V)
        base, sent = amplifier.bytes_consumed, bench.server.bytes_sent
        forces = []
        for _ in range(20):
            bench.clock.sleep(0.01)
            while amplifier.bytes_consumed - base < bench.server.bytes_sent - sent:
                if (frames := amplifier.read()) is not None:
                    forces.append(frames.force_N)
        assert bench.server.bytes_sent - sent == 200 * 18
        assert amplifier.frames_behind == pytest.approx(0, abs=1e-6)
        force = np.concatenate(forces)
        assert force.shape == (200, 3)
        assert force.mean(axis=0) == pytest.approx([2, -3, 25], abs=2e-3)
        amplifier.stop()
        assert bench.world.streaming == [False, True, False]
        amplifier.close()


def test_what_another_program_left_behind_is_put_right_in_the_amplifier() -> None:
    left = GsvMemory(rate_S_s=48_000.0, data_type=1, mode=0x07, user_scale=[250.0] * 8)
    bench = Bench(memory=left)
    with serving(bench.server):
        bench.clock.sleep(0.01)
        amplifier = bench.connect()
        amplifier.start(1000)
        bench.clock.sleep(0.05)
        amplifier.tare(Sensor().zero_mV_V)
        assert read_frames(amplifier, 50).force_N.mean(axis=0) == pytest.approx(
            [2, -3, 25], abs=3e-3
        )
        assert left.mode == 0x02
        assert left.user_scale == [3.5] * 3 + [250.0] * 5
        amplifier.close()


def test_a_write_lock_is_an_error_that_says_what_to_do() -> None:
    bench = Bench(memory=GsvMemory(mode=0x82))
    with serving(bench.server), pytest.raises(InstrumentError, match="blocked") as caught:
        bench.connect()
    assert "write lock" in str(caught.value.hint)


def test_another_input_range_is_refused_because_every_force_would_be_wrong() -> None:
    bench = Bench(memory=GsvMemory(input_type=[0, 1] + [0] * 6))
    with serving(bench.server), pytest.raises(InstrumentError, match=r"channel 2 .* 7 mV/V"):
        bench.connect()


@pytest.mark.parametrize("kind", ["garbage", "truncate", "stale", "close"])
def test_a_disturbed_stream_is_an_error_or_shows_against_time(kind: str) -> None:
    bench = Bench({"kind": kind, "command": "STREAM", "at": 3})
    with serving(bench.server):
        amplifier = bench.connect()
        amplifier.start(1000)

        def six_batches() -> None:
            for _ in range(6):
                bench.clock.sleep(0.001)
                for _ in range(3):
                    amplifier.read()

        if kind == "stale":  # everything comes, only late
            six_batches()
            assert amplifier.frames_behind == pytest.approx(0, abs=1e-6)
        else:
            with pytest.raises(InstrumentError, match=r"not a frame|connection failed"):
                six_batches()
        amplifier.close()


def test_frames_lost_without_a_trace_are_missed_by_the_clock() -> None:
    bench = Bench({"kind": "silence", "command": "STREAM", "at": 3})
    with serving(bench.server):
        amplifier = bench.connect()
        amplifier.start(1000)
        bench.clock.sleep(0.06)
        read_frames(amplifier, 59)
        assert amplifier.frames_behind == pytest.approx(1, abs=1e-6)
        amplifier.close()


def test_a_reader_thread_and_requests_from_another_do_not_disturb_each_other() -> None:
    bench = Bench()
    with serving(bench.server):
        amplifier = bench.connect()
        amplifier.start(1000)
        count, over = 0, threading.Event()

        def read_on() -> None:
            nonlocal count
            while not over.is_set():
                frames = amplifier.read()
                count += 0 if frames is None else len(frames)

        reader = threading.Thread(target=read_on)
        reader.start()
        began = time.monotonic()
        for _ in range(100):
            bench.clock.sleep(0.01)
            assert amplifier._read_rate() == 1000
        assert time.monotonic() - began < 60, "they hold each other up"
        deadline = time.monotonic() + 60
        while count < 1000 and time.monotonic() < deadline:
            time.sleep(0.005)
        over.set()
        reader.join()
        assert count == 1000
        amplifier.close()


def test_digital_lines_are_made_inputs_by_group_and_read_one_by_one() -> None:
    asked = (
        ("AA 91 59 02 85", "AA 51 00 00 85"),  # group 2 is outputs
        ("AA 92 5A 02 01 85", OK),
        ("AA 91 59 02 85", "AA 51 00 01 85"),
        ("AA 91 5D 07 85", "AA 52 00 00 01 85"),  # line 2.3 is the seventh
        ("AA 91 5D 08 85", "AA 52 00 00 00 85"),
        ("AA 91 5D 07 85", "AA 52 00 00 00 85"),
    )
    with playing(*OLD, *asked) as port:
        amplifier = connected(port)
        assert amplifier.inputs_high(("2.3", "2.4")) == {"2.3": True, "2.4": False}
        assert amplifier.inputs_high(("2.3",)) == {"2.3": False}
        amplifier.close()
