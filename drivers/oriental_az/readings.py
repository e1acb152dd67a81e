"""What is read of an AZ drive again and again, in two lengths in turn (which its motions share).

RTU has no transaction number: a doubled answer has the wrong length for the next question.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from drivers.oriental_az.link import AzLink, AzRefusalError, signed
from drivers.oriental_az.registers import (
    COMMAND_POSITION,
    DIRECT_IO,
    INPUT_COMMAND,
    INPUT_REGISTERS,
    INTERNAL_OUTPUTS,
    POSITION_REGISTERS,
    STATE_REGISTERS,
    TORQUE,
    TORQUE_REGISTERS,
    AzOutput,
    AzPosition,
    AzState,
)
from rig.core.clock import Clock

NOT_THERE = (1, 2, 3)
"""Exceptions of a drive that does not have the register. One that cannot answer now sends a 4."""


class AzReadings:
    """The readings of one drive."""

    def __init__(self, link: AzLink, clock: Clock):
        self._link, self._clock = link, clock
        self.state_at_s = -1.0
        """Bench time at which the drive answered with its state for the last time."""
        self._turn = 0
        """Index of the one of two lengths that is next."""
        self._inputs_read = self._torques_read = 0
        self._has_torque = True
        """False once the drive has refused the register of its torque."""

    def next_turn(self) -> int:
        """Return 0 and 1 in turn."""
        self._turn ^= 1
        return self._turn

    def state(self) -> AzState:
        """Return inputs, outputs and alarm."""
        count = STATE_REGISTERS[self.next_turn()]
        words = self._link.read(INPUT_COMMAND, count)
        if count == 4 and words[3] & AzOutput.ALARM:
            words = self._link.read(INPUT_COMMAND, 6)
        self.state_at_s = self._clock.now()
        return AzState.from_words(words)

    def position(self) -> AzPosition:
        """Return where the axis is and where it is to be now."""
        words = self._link.read(COMMAND_POSITION, POSITION_REGISTERS[self.next_turn()])
        return AzPosition.from_words(words)

    def internal_outputs(self) -> int:
        """Return the bits of `AzInternalOutput`."""
        return self._link.read(INTERNAL_OUTPUTS, 2)[0]

    def torque_percent(self) -> float | None:
        """Return the torque in percent of the largest one; None where the drive has no register
        of it."""
        if not self._has_torque:
            return None
        self._torques_read += 1
        count = TORQUE_REGISTERS[self._torques_read % 2]
        try:
            words = self._link.read(TORQUE + 2 - count, count)
        except AzRefusalError as refused:
            if refused.exception not in NOT_THERE:
                raise
            self._has_torque = False
            return None
        return signed(words[-2] << 16 | words[-1]) / 10

    def inputs_high(self, names: Sequence[str]) -> Mapping[str, bool]:
        """Return the levels of direct inputs; the bench's clock is not waited on."""
        self._inputs_read += 1
        count = INPUT_REGISTERS[self._inputs_read % 2]
        words = self._link.read(DIRECT_IO + 2 - count, count, waits=False)
        return {name: bool(words[-1] >> int(name.removeprefix("DIN")) & 1) for name in names}
