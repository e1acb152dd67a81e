"""The simulated GSV-8: the sheet's commands and error codes, its frames, and what they carry."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import pytest

from drivers.simulated.instruments.gsv8_converter import NOISE_MV_V, Sensor
from drivers.simulated.instruments.gsv8_frames import GSV_DIALECT
from drivers.simulated.instruments.gsv8_memory import GsvMemory
from drivers.simulated.instruments.me_gsv8 import Gsv8

OK = "AA 50 00 85"
PLAIN = Sensor(matrix=((100, 0, 0), (0, 100, 0), (0, 0, 100)), zero_mV_V=(0, 0, 0))
"""100 N per mV/V, so that 367.5 N stand at the converter's end."""


@dataclass
class Feet:
    """A World that is a clock set by hand, a force by formula, and a log in a list."""

    now_us: int = 0
    noise_key: tuple[int, ...] = (7, 0, 0)
    amplitude_N: float = 0.0
    frequency_Hz: float = 0.0
    steady_N: tuple[float, float, float] = (1.0, -2.0, 25.0)
    entries: list[tuple[str, object, str]] = field(default_factory=list)

    def force_N(self, times_s: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:  # noqa: N802
        assert (times_s <= self.now_us * 1e-6 + 1e-9).all(), "nobody asks about the future"
        swing = self.amplitude_N * np.sin(2 * np.pi * self.frequency_Hz * times_s)
        return np.array(self.steady_N) + swing[:, None] * [0, 0, 1]

    def log(self, device: str, what: str, value: object, by: str) -> None:
        self.entries.append((what, value, by))


class Line:
    """A person with a hex terminal at the amplifier."""

    def __init__(self, memory: GsvMemory | None = None, sensor: Sensor = PLAIN):
        self.world = Feet()
        self.core = Gsv8(self.world, self.world, sensor=sensor, memory=memory)

    def __call__(self, wire: str) -> str:
        return self.core.receive(bytes.fromhex(wire), "me").hex(" ").upper()

    def after(self, seconds: float) -> bytes:
        self.world.now_us += round(seconds * 1e6)
        return self.core.frames_until(self.world.now_us)

    def three_floats(self, rate_S_s: float = 1000.0) -> None:
        self("AA 90 23 85")
        self("AA 93 4A 00 00 03 85")
        self("AA 94 8B" + struct.pack(">f", rate_S_s).hex() + "85")
        self("AA 90 24 85")


def floats(stream: bytes) -> npt.NDArray[np.float64]:
    """Three floats a frame, without CRC."""
    rows = np.frombuffer(stream, np.uint8).reshape(-1, 16)
    assert set(rows[:, 1]) == {0x12}
    return rows[:, 3:15].copy().view(">f4").astype(float)


def spaced(wire: str) -> str:
    return bytes.fromhex(wire).hex(" ").upper()


# --- commands --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("request_", "reply"),
    [
        ("AA 90 23 85", OK),
        ("AA 90 24 85", OK),
        ("AA B0 23 A6 85", "AA 70 00 A2 85"),
        ("AA 94 8B 44 7A 00 00 85", OK),
        ("AA 90 1F 85", "AA 58 00 53 49 4D 30 30 30 30 31 85"),
        ("AA 90 2B 85", "AA 54 00 0001 003C 85"),
        ("AA 90 01 85", "AA 54 00 08 7B 00 00 85"),
        ("AA 90 26 85", "AA 54 00 00 00 00 02 85"),
        ("AA 91 14 01 85", "AA 54 00 40 60 00 00 85"),
        ("AA 91 49 00 85", "AA 52 00 00 08 85"),
        ("AA 91 80 01 85", "AA 52 00 00 03 85"),
        ("AA 90 8A 85", "AA 54 00 41 20 00 00 85"),
        ("AA 91 63 00 85", "AA 54 00 46 3B 80 00 85"),
        ("AA 91 63 01 85", "AA 54 00 3F 80 00 00 85"),
        ("AA 91 0D 01 85", "AA 51 00 01 85"),
        ("AA 91 0C 00 85", OK),
        ("AA 90 78 85", ""),
    ],
)
def test_a_request_and_its_reply(request_: str, reply: str) -> None:
    assert Line()(request_) == spaced(reply)


@pytest.mark.parametrize(
    ("request_", "code"),
    [
        ("AA 90 EE 85", 0x40),
        ("AA 90 6B 85", 0x41),
        ("AA 90 23 00", 0x42),
        ("AA B0 23 A7 85", 0x43),
        ("AA 91 14 09 85", 0x51),
        ("AA 93 81 01 00 07 85", 0x52),
        ("AA 91 01 80 85", 0x53),
        ("AA 94 8B 47 FF FF 00 85", 0x54),
        ("AA 94 8B 3F 00 00 00 85", 0x55),
        ("AA 94 8B 7F C0 00 00 85", 0x55),
        ("AA 91 80 02 85", 0x59),
        ("AA 91 8B 00 85", 0x5B),
        ("AA 94 8B 46 BB 80 00 85", 0x64),
    ],
)
def test_a_refused_request_gets_its_code_and_changes_nothing(request_: str, code: int) -> None:
    line = Line()
    before = vars(line.core.amplifier.memory).copy()
    assert line(request_) == spaced(f"AA 50 {code:02X} 85")
    assert vars(line.core.amplifier.memory) == before
    assert line("AA 90 42 85") == spaced(f"AA 54 00 00 00 00 {code:02X} 85")


def test_the_write_lock_refuses_writes_and_nothing_else() -> None:
    line = Line(GsvMemory(mode=0x82))
    assert line("AA 94 8B 44 7A 00 00 85") == spaced("AA 50 71 85")
    assert line("AA 90 8A 85") == spaced("AA 54 00 41 20 00 00 85")
    assert line("AA 90 23 85") == spaced(OK)
    assert line("AA 94 27 00 00 00 02 85") == spaced(OK)
    assert line("AA 94 8B 44 7A 00 00 85") == spaced(OK)


def test_a_rate_between_two_of_the_list_is_changed_and_says_so() -> None:
    line = Line()
    assert line("AA 94 8B" + struct.pack(">f", 990).hex() + "85") == spaced("AA 50 01 85")
    assert line.core.rate == 1000.0


def test_requests_in_pieces_and_together_are_answered_one_by_one() -> None:
    line = Line()
    assert line("AA 90") == line("23") == ""
    assert line("85 AA 90 23 85 AA 90 23 85") == spaced(OK * 3)
    assert line("00 17 AA AA 90 23 85") == spaced(OK), "what is no request is passed over"


# --- streaming -------------------------------------------------------------------------------


def test_switched_on_it_streams_eight_floats_ten_times_a_second() -> None:
    line = Line()
    assert line.after(0.0999) == b""
    assert len(line.after(0.0001)) == 4 + 32
    assert len(line.after(0.5)) == 5 * 36
    line("AA 90 23 85")
    assert line.after(1.0) == b""


def test_reset_streams_again_and_keeps_what_was_written() -> None:
    line = Line()
    line.three_floats()
    line("AA 90 23 85")
    line("AA 90 78 85")
    assert len(line.after(0.01)) == 10 * 16


def test_a_single_value_comes_as_a_measurement_without_a_response() -> None:
    line = Line()
    line.three_floats()
    line("AA 90 23 85")
    assert line("AA 90 3B 85").startswith("AA 12 B0 ")
    assert line.after(1.0) == b""


@pytest.mark.parametrize("rate", [1, 10, 1000, 12000])
def test_every_frame_comes_once_at_its_instant(rate: int) -> None:
    line = Line()
    line.three_floats(rate)
    pieces = [line.after(0.0007) for _ in range(3000)]
    assert sum(map(len, pieces)) == 16 * (2_100_000 * rate // 1_000_000)


def test_batches_do_not_change_a_bit() -> None:
    one, many = Line(), Line()
    for line in (one, many):
        line.world.amplitude_N, line.world.frequency_Hz = 3.0, 37.0
        line.three_floats()
    assert one.after(1.0) == b"".join(many.after(0.008) for _ in range(125))


def test_noise_belongs_to_the_point_and_not_to_what_came_before() -> None:
    early, late = Line(), Line()
    for line, waited in ((early, 0.05), (late, 0.31)):
        line.three_floats()
        line.after(waited)
        line.world.noise_key = (7, 0, 1)
    first, second = floats(early.after(0.6)), floats(late.after(0.6))
    assert np.array_equal(first, second)
    assert floats(early.after(0.6)).std(axis=0) == pytest.approx([NOISE_MV_V] * 3, rel=0.15)
    early.world.noise_key = (8, 0, 1)
    assert not np.array_equal(floats(early.after(0.6)), first)


# --- what it measures ------------------------------------------------------------------------


def test_floats_are_the_output_of_the_bridges_with_the_sensors_crosstalk() -> None:
    sensor = Sensor()
    line = Line(sensor=sensor)
    line.three_floats()
    mean = floats(line.after(1.0)).mean(axis=0)
    force = np.array(sensor.matrix) @ (mean - sensor.zero_mV_V)
    assert force == pytest.approx(line.world.steady_N, abs=5e-4)


@pytest.mark.parametrize("frequency_Hz", [20.0, 443.0, 1430.0])
def test_the_low_pass_is_the_mean_over_a_frame(frequency_Hz: float) -> None:
    """-3 dB at 0.443 of the rate; the maker says about 0.4."""
    line = Line()
    line.world.amplitude_N, line.world.frequency_Hz = 10.0, frequency_Hz
    line.three_floats()
    z = floats(line.after(4.0))[:, 2] * 100
    expected = abs(np.sinc(frequency_Hz / 1000))
    assert np.sqrt(2) * z.std() / 10 == pytest.approx(expected, rel=0.02)


def test_the_converter_ends_at_1_05_ranges_and_says_so() -> None:
    line = Line()
    line.world.steady_N = (0.0, 0.0, 360.0)
    line.three_floats()
    assert {frame[2] for frame in _split(line.after(0.02))} == {0xB0}
    line.world.steady_N = (0.0, 0.0, 400.0)
    stream = line.after(0.02)
    assert {frame[2] for frame in _split(stream)} == {0xB1}
    assert floats(stream)[:, 2] == pytest.approx([3.675] * 20, abs=1e-4)


def test_a_peak_between_two_frames_saturates_too() -> None:
    line = Line()
    line.world.steady_N = (0.0, 0.0, 360.0)
    line.world.amplitude_N, line.world.frequency_Hz = 20.0, 5000.0
    line.three_floats()
    assert {frame[2] for frame in _split(line.after(0.02))} == {0xB1}


def test_zero_and_user_scale() -> None:
    line = Line()
    line.three_floats()
    line.after(0.1)
    line("AA 91 0C 00 85")
    assert floats(line.after(0.1)) == pytest.approx(0.0, abs=3e-4)
    line.world.steady_N = (36.0, -2.0, 25.0)
    line("AA 95 15 01 42 C8 00 00 85")  # 100 user units for one input range
    line.after(0.001)
    assert floats(line.after(0.1))[:, 0] == pytest.approx([10.0] * 100, abs=0.01)


def test_integers_and_the_crc() -> None:
    line = Line()
    line.three_floats()
    line.world.steady_N = (0.0, 350.0, -350.0)
    line("AA 93 81 01 00 01 85")
    line("AA 91 01 08 85")
    (frame,) = [line.after(0.001)]
    assert frame[:3].hex() == "aa3290"
    x, y, z = (int.from_bytes(frame[k : k + 2], "big") - 0x8000 for k in (3, 5, 7))
    assert (x, y, z) == (
        pytest.approx(0, abs=3),
        pytest.approx(2**15 / 1.05, abs=3),
        pytest.approx(-(2**15) / 1.05, abs=3),
    )
    assert _crc(frame[1:-3]) == frame[-3] | frame[-2] << 8


def test_the_log_tells_who_changed_what() -> None:
    line = Line()
    line.three_floats()
    assert line.world.entries == [
        ("streaming", False, "me"),
        ("values", 3, "me"),
        ("rate", 1000.0, "me"),
        ("streaming", True, "me"),
    ]


def _split(stream: bytes) -> list[bytes]:
    return [stream[k : k + 16] for k in range(0, len(stream), 16)]


def _crc(data: bytes) -> int:
    """CRC-16/Modbus by the book, bit by bit."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc


# --- fault plans -----------------------------------------------------------------------------


def test_a_frozen_converter_repeats_its_last_values_across_batches() -> None:
    line = Line()
    line.three_floats()
    line.core.disturb("frozen", 0.005, for_s=0.010)
    values = floats(line.after(0.008) + line.after(0.020))
    assert (values[4:14] == values[3]).all(), "from 5 ms until 15 ms, as at 4 ms"
    assert len(np.unique(values[14:], axis=0)) == len(values[14:]), "noise is back"
    assert len(np.unique(values[:4], axis=0)) == 4


def test_a_saturated_converter_stands_at_its_end_and_says_so() -> None:
    line = Line()
    line.three_floats()
    line.core.disturb("saturated", 0.005, for_s=0.010)
    stream = line.after(0.020)
    values, control = floats(stream), np.frombuffer(stream, np.uint8).reshape(-1, 16)[:, 2]
    assert (control & 1).tolist() == [0] * 4 + [1] * 10 + [0] * 6
    assert values[4:14, 2] == pytest.approx(1.05 * 3.5)
    assert values[:, :2] == pytest.approx(np.tile([0.01, -0.02], (20, 1)), abs=1e-3)


def test_one_axis_that_is_stuck_keeps_its_last_value_and_the_others_measure() -> None:
    line = Line()
    line.three_floats()
    line.core.disturb("one-axis-stuck", 0.005, axis="y")
    values = floats(line.after(0.008) + line.after(0.020))
    assert (values[4:, 1] == values[3, 1]).all(), "from 5 ms on"
    for living in (0, 2):
        assert np.diff(values[:, living]).astype(bool).mean() > 0.9


def test_a_wrong_value_is_in_one_frame_and_differs_by_the_force() -> None:
    line, undisturbed = Line(), Line()
    for one in (line, undisturbed):
        one.three_floats()
    line.core.disturb("wrong-value", 0.005, axis="z", force_N=20.0)
    differs = floats(line.after(0.020)) - floats(undisturbed.after(0.020))
    assert np.flatnonzero(differs.any(axis=1)).tolist() == [4]
    force_N = np.array(line.core.sensor.matrix) @ differs[4]
    assert force_N == pytest.approx([0.0, 0.0, 20.0], abs=1e-3)


def test_earlier_frames_have_the_values_of_the_frame_before_last() -> None:
    line, undisturbed = Line(), Line()
    for one in (line, undisturbed):
        one.three_floats()
    line.core.disturb("previous", 0.005, for_s=0.010)
    values = floats(line.after(0.008) + line.after(0.020))
    sent = floats(undisturbed.after(0.028))
    assert (values[4:14] == sent[2:12]).all()
    assert (values[:4] == sent[:4]).all()
    assert (values[14:] == sent[14:]).all()


def test_what_fault_plans_make_of_answers() -> None:
    plain, checked = bytes.fromhex(OK), bytes.fromhex("AA 70 00 A2 85")
    assert GSV_DIALECT.checksum(plain) is None
    assert GSV_DIALECT.checksum(checked) == bytes.fromhex("AA 70 00 5D 85")
    assert GSV_DIALECT.error(plain, 0x71) == bytes.fromhex("AA 50 71 85")
    line = Line()
    line.three_floats()
    assert GSV_DIALECT.error(line.after(0.002), 0x71) is None, "measurements carry no error"
