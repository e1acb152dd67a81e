"""PROFIdrive telegram 111 as values: what the words of a positioning drive mean, bit by bit.

This module turns images into registers and back. It may not do I/O, know a sequence or know a
unit: positions and speeds are the integers that travel. Layout: 22 bytes at the beginning of a
56-byte image, little-endian throughout; register n of an image carries its bytes 2n (low) and
2n + 1 (high). Source: the vendor's client festo-edcon 0.14.12, ``profidrive/telegram111.py``,
``profidrive/words.py`` and ``edrive/com_modbus.py``.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntFlag

IMAGE_REGISTERS = 28
FULL_SCALE = 0x4000
"""100 % in OVERRIDE, MDI_ACC and MDI_DEC."""

_OUTPUTS = struct.Struct("<5HiIHH")
_INPUTS = struct.Struct("<5HiiHH")
_IMAGE = struct.Struct(f"<{IMAGE_REGISTERS}H")


class Stw1(IntFlag):
    """Control word 1 in positioning mode."""

    NONE = 0
    ON = 1 << 0
    NO_COAST_STOP = 1 << 1
    NO_QUICK_STOP = 1 << 2
    ENABLE_OPERATION = 1 << 3
    DO_NOT_REJECT_TASK = 1 << 4
    NO_INTERMEDIATE_STOP = 1 << 5
    ACTIVATE_TASK = 1 << 6
    ACKNOWLEDGE_FAULT = 1 << 7
    JOG_1 = 1 << 8
    JOG_2 = 1 << 9
    CONTROL_BY_PLC = 1 << 10
    START_HOMING = 1 << 11
    OPEN_BRAKE = 1 << 12
    CHANGE_RECORD = 1 << 13


class PosStw1(IntFlag):
    """Positioning control word 1 (bits 0 to 6 are a record number, unused here)."""

    NONE = 0
    ABSOLUTE = 1 << 8
    DIRECTION_POSITIVE = 1 << 9
    DIRECTION_NEGATIVE = 1 << 10
    CONTINUOUS_UPDATE = 1 << 12
    SETUP = 1 << 14
    MDI = 1 << 15


class PosStw2(IntFlag):
    """Positioning control word 2."""

    NONE = 0
    TRACKING = 1 << 0
    SET_REFERENCE = 1 << 1
    INCREMENTAL_JOG = 1 << 5
    SOFTWARE_LIMITS = 1 << 14
    HARDWARE_LIMITS = 1 << 15


class Stw2(IntFlag):
    """Control word 2 (bits 12 to 15 are a sign of life, unused here)."""

    NONE = 0
    PARKING = 1 << 7
    TRAVEL_TO_FIXED_STOP = 1 << 8


class Zsw1(IntFlag):
    """Status word 1 in positioning mode."""

    NONE = 0
    READY_TO_SWITCH_ON = 1 << 0
    READY_TO_OPERATE = 1 << 1
    OPERATION_ENABLED = 1 << 2
    FAULT = 1 << 3
    NO_COAST_STOP = 1 << 4
    NO_QUICK_STOP = 1 << 5
    SWITCH_ON_INHIBITED = 1 << 6
    WARNING = 1 << 7
    FOLLOWING_ERROR_OK = 1 << 8
    CONTROL_REQUESTED = 1 << 9
    TARGET_REACHED = 1 << 10
    HOMED = 1 << 11
    TASK_ACKNOWLEDGED = 1 << 12
    STOPPED = 1 << 13
    ACCELERATING = 1 << 14
    DECELERATING = 1 << 15


class PosZsw1(IntFlag):
    """Positioning status word 1."""

    NONE = 0
    HARDWARE_LIMIT_NEGATIVE = 1 << 8
    HARDWARE_LIMIT_POSITIVE = 1 << 9
    JOGGING = 1 << 10
    HOMING = 1 << 11
    RECORD_MODE = 1 << 13
    SETUP = 1 << 14
    MDI = 1 << 15


class PosZsw2(IntFlag):
    """Positioning status word 2."""

    NONE = 0
    TRACKING = 1 << 0
    SPEED_LIMITED = 1 << 1
    SETPOINT_AVAILABLE = 1 << 2
    FORWARD = 1 << 4
    BACKWARD = 1 << 5
    SOFTWARE_LIMIT_NEGATIVE = 1 << 6
    SOFTWARE_LIMIT_POSITIVE = 1 << 7
    FIXED_STOP_REACHED = 1 << 12
    CLAMPING_TORQUE_REACHED = 1 << 13
    TRAVEL_TO_FIXED_STOP = 1 << 14
    TASK_ACTIVE = 1 << 15


@dataclass(frozen=True)
class Outputs:
    """The output image, from controller to drive; the default, all zero, asks for nothing."""

    stw1: Stw1 = Stw1.NONE
    pos_stw1: PosStw1 = PosStw1.NONE
    pos_stw2: PosStw2 = PosStw2.NONE
    stw2: Stw2 = Stw2.NONE
    override: int = 0
    """Share of the set speed, 0x4000 is all of it."""
    target: int = 0
    """MDI_TARPOS in the drive's position unit."""
    speed: int = 0
    """MDI_VELOCITY in the drive's speed unit."""
    acceleration: int = 0
    """Share of the drive's full acceleration, 0x4000 is all of it."""
    deceleration: int = 0

    def registers(self) -> tuple[int, ...]:
        """Return the 28 registers to write; struct.error where a number does not fit its field."""
        packed = _OUTPUTS.pack(
            self.stw1,
            self.pos_stw1,
            self.pos_stw2,
            self.stw2,
            self.override,
            self.target,
            self.speed,
            self.acceleration,
            self.deceleration,
        )
        return _to_registers(packed)

    @classmethod
    def from_registers(cls, registers: Sequence[int]) -> Outputs:
        """Return the image in at least 11 registers; raises ValueError for fewer."""
        stw1, pos_stw1, pos_stw2, stw2, *numbers = _OUTPUTS.unpack(
            _to_bytes(registers, _OUTPUTS.size)
        )
        return cls(Stw1(stw1), PosStw1(pos_stw1), PosStw2(pos_stw2), Stw2(stw2), *numbers)


@dataclass(frozen=True)
class Inputs:
    """The input image, from drive to controller."""

    zsw1: Zsw1 = Zsw1.NONE
    pos_zsw1: PosZsw1 = PosZsw1.NONE
    pos_zsw2: PosZsw2 = PosZsw2.NONE
    zsw2: int = 0
    meldw: int = 0
    position: int = 0
    """XIST_A: measured position in the drive's position unit."""
    speed: int = 0
    """NIST_B: share of the drive's base speed, 0x40000000 is all of it."""
    fault: int = 0
    warning: int = 0

    def registers(self) -> tuple[int, ...]:
        """Return the 28 registers as the drive would send them."""
        packed = _INPUTS.pack(
            self.zsw1,
            self.pos_zsw1,
            self.pos_zsw2,
            self.zsw2,
            self.meldw,
            self.position,
            self.speed,
            self.fault,
            self.warning,
        )
        return _to_registers(packed)

    @classmethod
    def from_registers(cls, registers: Sequence[int]) -> Inputs:
        """Return the image in at least 11 registers; raises ValueError for fewer."""
        zsw1, pos_zsw1, pos_zsw2, *numbers = _INPUTS.unpack(_to_bytes(registers, _INPUTS.size))
        return cls(Zsw1(zsw1), PosZsw1(pos_zsw1), PosZsw2(pos_zsw2), *numbers)


def _to_registers(packed: bytes) -> tuple[int, ...]:
    return _IMAGE.unpack(packed.ljust(_IMAGE.size, b"\0"))


def _to_bytes(registers: Sequence[int], wanted: int) -> bytes:
    if 2 * len(registers) < wanted:
        raise ValueError(f"{len(registers)} registers are not an image of telegram 111")
    return struct.pack(f"<{len(registers)}H", *registers)[:wanted]
