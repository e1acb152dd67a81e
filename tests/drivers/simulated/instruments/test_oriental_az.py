"""The simulated AZ pair, spoken to in frames on its line."""

from __future__ import annotations

import struct
from typing import Any

import pytest

from drivers.simulated.instruments.oriental_az import (
    COMMAND_POSITION,
    FEEDBACK_POSITION,
    OUTPUT_STATUS,
    PRESENT_ALARM,
    AzDrive,
    SimulatedAzSettings,
)
from drivers.simulated.transports.modbus_rtu import RtuLine, crc16, frame

from ..axis_bench import AxisBench

STEPS = 1000.0
NONE = b""
ABSOLUTE, FROM_COMMAND, FROM_FEEDBACK = 1, 2, 3


class Master:
    """A person with a terminal on the line."""

    def __init__(self, **settings: Any) -> None:
        self.bench = AxisBench()
        self.drives = [
            AzDrive(SimulatedAzSettings(name, unit, STEPS, **settings), self.bench)
            for unit, name in ((1, "z"), (2, "x"))
        ]
        self.line = RtuLine(self.drives, self.bench)

    def raw(self, data: bytes) -> bytes:
        """What comes back to some bytes."""
        return NONE.join(exchange.reply or NONE for exchange in self.line.exchanges(data, "test"))

    def ask(self, pdu: bytes, unit: int = 1) -> bytes:
        """The reply PDU; nothing where nobody replies."""
        self.wait(0.003)
        return self.raw(frame(unit, pdu))[1:-2]

    def write(self, address: int, *values: int, unit: int = 1) -> bytes:
        """32-bit values, upper register first."""
        body = struct.pack(f">{len(values)}i", *values)
        head = struct.pack(">BHHB", 16, address, 2 * len(values), len(body))
        return self.ask(head + body, unit)

    def value(self, address: int, unit: int = 1) -> int:
        """A 32-bit value."""
        (value,) = struct.unpack(">i", self.ask(struct.pack(">BHH", 3, address, 2), unit)[2:])
        return int(value)

    def wait(self, seconds: float) -> None:
        """Let time pass."""
        self.bench.now_us += round(seconds * 1e6)

    def home(self) -> None:
        """Both axes."""
        for unit in (1, 2):
            self.write(0x7C, 0x10, unit=unit)
            self.wait(1.0)
            self.write(0x7C, 0, unit=unit)

    def go(self, kind: int, steps: int, trigger: int = 1) -> bytes:
        """Direct data operation at 20 mm/s."""
        return self.write(0x58, 0, kind, steps, 20_000, 10**6, 10**6, 1000, trigger)


def test_the_checksum_is_that_of_the_standard() -> None:
    """The example of Modbus over Serial Line V1.02, appendix B: 02 07 gives 41 12."""
    assert frame(2, b"\x07") == bytes.fromhex("02074112")
    assert crc16(frame(2, b"\x07")) == 0


def test_a_frame_may_come_in_pieces_but_not_with_a_pause_in_it() -> None:
    master = Master()
    echo = frame(1, bytes.fromhex("080000abcd"))
    master.wait(0.01)
    assert master.raw(echo[:3]) == NONE
    assert master.raw(echo[3:]) == echo
    master.wait(0.01)
    assert master.raw(echo[:3]) == NONE
    master.wait(0.01)
    assert master.raw(echo[3:]) == NONE
    master.wait(0.01)
    assert master.raw(echo) == echo


@pytest.mark.parametrize("at", range(8))
def test_a_changed_byte_gets_no_answer_and_feeds_nothing(at: int) -> None:
    master = Master()
    master.write(0x138A, 100)
    master.wait(0.09)
    spoilt = bytearray(frame(1, bytes.fromhex("0800001234")))
    spoilt[at] ^= 0x10
    assert master.raw(bytes(spoilt)) == NONE
    master.wait(0.05)
    assert master.value(PRESENT_ALARM) == 0x85


def test_a_broadcast_is_obeyed_by_all_and_answered_by_none() -> None:
    master = Master()
    assert master.write(0x138A, 700, unit=0) == NONE
    assert [master.value(0x138A, unit) for unit in (1, 2)] == [700, 700]


@pytest.mark.parametrize(
    ("request_", "reply"),
    [
        ("04 00cc 0002", "84 01"),
        ("03 4000 0001", "83 02"),
        ("03 00cc 007e", "83 03"),
        ("06 00cc 0001", "86 02"),
        ("10 0064 0002 04 00000fff", "90 04"),
        ("08 0001 0000", "88 01"),
        ("06 138b 01f4", "06 138b 01f4"),
        ("17 0064 0002 0064 0002 04 000001f4", "17 04 000001f4"),
    ],
)
def test_functions_and_their_exceptions(request_: str, reply: str) -> None:
    assert Master().ask(bytes.fromhex(request_)) == bytes.fromhex(reply)


def test_a_write_that_is_refused_has_changed_nothing() -> None:
    master = Master()
    assert master.write(0x60, 5000, 0, 100)[:1] == b"\x90"  # a rate of 0
    assert master.value(0x60) == 1_000_000


def test_positions_may_be_absolute_or_from_where_it_is() -> None:
    master = Master()
    master.home()
    master.go(ABSOLUTE, 5000)
    master.wait(1.0)
    assert master.value(FEEDBACK_POSITION) == 5000
    master.go(FROM_COMMAND, -1500)
    master.wait(1.0)
    master.go(FROM_FEEDBACK, 500)
    master.wait(1.0)
    assert master.value(FEEDBACK_POSITION) == master.value(COMMAND_POSITION) == 4000
    assert master.value(FEEDBACK_POSITION, unit=2) == 0


def test_a_negative_trigger_has_the_position_start_it() -> None:
    master = Master()
    master.home()
    master.go(ABSOLUTE, 0, trigger=-5)
    master.write(0x5C, 3000)
    assert master.value(OUTPUT_STATUS) >> 13 & 1, "MOVE"
    master.wait(1.0)
    assert master.value(FEEDBACK_POSITION) == 3000


def test_without_a_reference_an_absolute_position_is_an_alarm_and_resets() -> None:
    master = Master()
    master.go(ABSOLUTE, 1000)
    assert master.value(PRESENT_ALARM) == 0x4A
    assert master.go(FROM_FEEDBACK, 1000) == bytes.fromhex("9004"), "while it stands"
    master.write(0x180, 1)
    assert master.value(PRESENT_ALARM) == 0


def test_the_time_out_stops_the_axis_when_it_expires_not_when_it_is_polled() -> None:
    master = Master()
    master.home()
    master.write(0x138A, 200)
    master.go(ABSOLUTE, 20_000)
    master.wait(5.0)
    # 0.2 s, of which 20 ms speed up, and 20 ms of braking: 1 mm/ms2 at 20 mm/s
    assert master.drives[0].position_mm(master.bench.now_us) == pytest.approx(4.0, abs=0.01)
    assert master.value(PRESENT_ALARM) == 0x85
    assert master.bench.reported("fault") == [0x85]


def test_what_holds_it_back_beyond_its_current_is_an_alarm() -> None:
    master = Master(force_at_full_current_N=50.0)
    master.bench.wall_mm, master.bench.stiffness_N_mm = 3.0, 100.0
    master.home()
    master.go(ABSOLUTE, 8000)
    master.wait(2.0)
    assert master.value(PRESENT_ALARM) == 0x10
    assert master.drives[0].position_mm(master.bench.now_us) == pytest.approx(3.5, abs=0.03)
