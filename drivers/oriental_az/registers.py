"""Registers of an AZ drive, and what the words in them mean.

Values only: nothing here communicates with a drive. `drivers.oriental_az.driver` names the sources
and lists what is not confirmed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntFlag

from drivers.oriental_az.link import signed

# Upper registers of 32-bit values.
DIRECT_DATA, OPERATION_TYPE = 0x58, 0x5A
INPUT_COMMAND = 0x7C
COMMAND_POSITION = 0xC6
CURRENT = 0x64
TORQUE = 0xD6
DIRECT_IO = 0xD4
"""Upper register the outputs, lower the inputs, bit 0 is DIN0."""
TEMPERATURES = 0xF8
INTERNAL_OUTPUTS = 0x178
ALARM_RESET = 0x180
OVERTRAVEL, HIGH_LIMIT, LOW_LIMIT = 0x386, 0x388, 0x38A
LINE_TIMEOUT_ms, SLAVE_ERROR_RESPONSE = 0x138A, 0x1392
ABSOLUTE, TRIGGER_ALL = 1, 1
DECELERATION_STOP, EXCEPTION_REPLY = 1, 1
STATE_REGISTERS = (6, 4)
"""Input command, outputs and alarm; in turn without the alarm, which the outputs show as well."""
POSITION_REGISTERS = (8, 10)
"""Command position up to feedback position; in turn with the feedback speed."""
INPUT_REGISTERS = (12, 14)
"""Readings that end with the direct I/O, in turn: longer than any other. What they hold before it,
among it the position, is not used."""
TORQUE_REGISTERS = (16, 18)
"""Readings that end with the torque, in turn: longer than any other."""


class AzInput(IntFlag):
    """Driver input command, lower register."""

    NONE = 0
    HOME = 0x10
    STOP = 0x20


class AzOutput(IntFlag):
    """Driver output status, lower register, as assigned at the factory."""

    READY = 1 << 5
    ALARM = 1 << 7
    MOVE = 1 << 13


class AzInternalOutput(IntFlag):
    """Internal outputs, upper register."""

    HOME_END = 1 << 0
    ABSPEN = 1 << 1


@dataclass(frozen=True)
class AzState:
    """Inputs, outputs and alarm of a drive at one instant."""

    inputs: int
    outputs: int
    alarm: int

    @classmethod
    def from_words(cls, words: Sequence[int]) -> AzState:
        """Return the state in the registers from `INPUT_COMMAND` on; without those of the alarm
        there is none."""
        return cls(words[1], words[3], words[5] if len(words) >= 6 else 0)


@dataclass(frozen=True)
class AzPosition:
    """Commanded and measured position of an axis, in steps."""

    command: int
    feedback: int

    @classmethod
    def from_words(cls, words: Sequence[int]) -> AzPosition:
        """Return the position in the registers from `COMMAND_POSITION` on."""
        return cls(*(signed(words[at] << 16 | words[at + 1]) for at in (0, 6)))
