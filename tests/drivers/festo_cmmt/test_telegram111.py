"""Telegram 111 on the wire: each bit and field at its place, both ways."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.festo_cmmt.frames import (
    FULL_SCALE,
    Inputs,
    Outputs,
    PosStw1,
    PosStw2,
    PosZsw1,
    PosZsw2,
    Stw1,
    Stw2,
    Zsw1,
)

WORD = st.integers(0, 0xFFFF)
SIGNED = st.integers(-(2**31), 2**31 - 1)


def test_an_absolute_task_as_the_vendors_client_would_write_it() -> None:
    outputs = Outputs(
        stw1=Stw1(0b0000_0100_0111_1111),
        pos_stw1=PosStw1.MDI | PosStw1.ABSOLUTE,
        pos_stw2=PosStw2.SOFTWARE_LIMITS,
        stw2=Stw2.TRAVEL_TO_FIXED_STOP,
        override=FULL_SCALE,
        target=-2,
        speed=0x0001_2345,
        acceleration=0x2000,
        deceleration=0x1000,
    )
    registers = outputs.registers()
    assert registers[:4] == (0x047F, 0x8100, 0x4000, 0x0100)
    assert registers[4:7] == (0x4000, 0xFFFE, 0xFFFF), "low word of the target first"
    assert registers[7:11] == (0x2345, 0x0001, 0x2000, 0x1000)
    assert registers[11:] == (0,) * 17


def test_what_the_drive_shows() -> None:
    image = struct.pack("<5HiiHH", 0x1234, 0x0800, 0x9010, 0, 0, -70000, -5, 126, 7)
    registers = struct.unpack("<11H", image)
    inputs = Inputs.from_registers(registers)
    assert Zsw1.OPERATION_ENABLED in inputs.zsw1
    assert Zsw1.TASK_ACKNOWLEDGED in inputs.zsw1
    assert Zsw1.FAULT not in inputs.zsw1
    assert inputs.pos_zsw1 == PosZsw1.HOMING
    assert inputs.pos_zsw2 == PosZsw2.TASK_ACTIVE | PosZsw2.FIXED_STOP_REACHED | PosZsw2.FORWARD
    assert (inputs.position, inputs.speed, inputs.fault, inputs.warning) == (-70000, -5, 126, 7)


@pytest.mark.parametrize(
    ("flag", "bit"),
    [
        (Stw1.ON, 0),
        (Stw1.DO_NOT_REJECT_TASK, 4),
        (Stw1.NO_INTERMEDIATE_STOP, 5),
        (Stw1.ACTIVATE_TASK, 6),
        (Stw1.ACKNOWLEDGE_FAULT, 7),
        (Stw1.CONTROL_BY_PLC, 10),
        (Stw1.START_HOMING, 11),
        (PosStw1.ABSOLUTE, 8),
        (PosStw1.CONTINUOUS_UPDATE, 12),
        (PosStw1.MDI, 15),
        (PosStw2.SOFTWARE_LIMITS, 14),
        (PosStw2.HARDWARE_LIMITS, 15),
        (Stw2.TRAVEL_TO_FIXED_STOP, 8),
        (Zsw1.OPERATION_ENABLED, 2),
        (Zsw1.FAULT, 3),
        (Zsw1.CONTROL_REQUESTED, 9),
        (Zsw1.TARGET_REACHED, 10),
        (Zsw1.HOMED, 11),
        (Zsw1.TASK_ACKNOWLEDGED, 12),
        (Zsw1.STOPPED, 13),
        (PosZsw1.HOMING, 11),
        (PosZsw1.MDI, 15),
        (PosZsw2.FIXED_STOP_REACHED, 12),
        (PosZsw2.CLAMPING_TORQUE_REACHED, 13),
        (PosZsw2.TRAVEL_TO_FIXED_STOP, 14),
    ],
)
def test_a_bit_is_where_the_vendors_words_have_it(flag: int, bit: int) -> None:
    assert flag == 1 << bit


@given(WORD, WORD, SIGNED, st.integers(0, 2**32 - 1), WORD, WORD)
def test_outputs_come_back(
    stw1: int, pos_stw1: int, target: int, speed: int, acceleration: int, deceleration: int
) -> None:
    outputs = Outputs(
        stw1=Stw1(stw1),
        pos_stw1=PosStw1(pos_stw1),
        target=target,
        speed=speed,
        acceleration=acceleration,
        deceleration=deceleration,
    )
    assert Outputs.from_registers(outputs.registers()) == outputs


@given(st.lists(WORD, min_size=11, max_size=28))
def test_any_image_of_the_drive_is_understood_and_comes_back(registers: list[int]) -> None:
    inputs = Inputs.from_registers(registers)
    assert list(inputs.registers()[:11]) == registers[:11]
    assert len(inputs.registers()) == 28


def test_fewer_registers_are_no_image() -> None:
    with pytest.raises(ValueError, match="10 registers"):
        Inputs.from_registers([0] * 10)


def test_a_number_that_does_not_fit_is_refused() -> None:
    with pytest.raises(struct.error):
        Outputs(target=2**31).registers()
