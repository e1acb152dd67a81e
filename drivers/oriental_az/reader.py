"""Reads an AZ drive without changing it: for `rig monitor` on a bench without a run.

Two kinds of request are sent: reading of registers (function 3), and before the first an echo
(function 8), which does nothing. Steps per mm are those of the bench file, unchecked.

Any frame on the line restarts the communication time-outs of all its drives, which expire once the
reader has gone where they are set. That is an alarm of an axis at rest, which the next run resets;
a drive that has had it after its last run has it already.
"""

from __future__ import annotations

from drivers.oriental_az.link import AzLine, AzLink
from drivers.oriental_az.preparation import IDENTITY, identify
from drivers.oriental_az.registers import (
    COMMAND_POSITION,
    INPUT_COMMAND,
    INTERNAL_OUTPUTS,
    POSITION_REGISTERS,
    STATE_REGISTERS,
    AzInput,
    AzInternalOutput,
    AzOutput,
    AzPosition,
    AzState,
    LINE_TIMEOUT_ms,
)
from drivers.oriental_az.settings import OrientalAzSettings, alarm_in_words
from rig.core.clock import Clock
from rig.instruments.roles import StageStatus


class AzReader:
    """A connection to one drive that only reads."""

    identity = IDENTITY

    def __init__(self, settings: OrientalAzSettings, clock: Clock):
        line = AzLine.shared(
            settings.port, settings.baudrate, settings.parity, clock, settings.role
        )
        self._link = AzLink(settings.role, line, settings.unit_id, settings.timeout_s, clock)
        self._steps_per_mm = settings.steps_per_mm
        self.timeout_s = 0.0
        """The drive's communication time-out, as it was set when the reader was opened."""

    def open(self) -> None:
        """Identify the drive and read its communication time-out."""
        identify(self._link)
        self.timeout_s = self._link.read_value(LINE_TIMEOUT_ms) * 1e-3

    def read(self) -> StageStatus:
        """See `StageReader`.

        Three readings of different lengths, so that a doubled answer fits no other one."""
        state = AzState.from_words(self._link.read(INPUT_COMMAND, max(STATE_REGISTERS)))
        words = self._link.read(COMMAND_POSITION, min(POSITION_REGISTERS))
        position = AzPosition.from_words(words)
        known = self._link.read(INTERNAL_OUTPUTS, 2)[0] & AzInternalOutput.ABSPEN
        return StageStatus(
            position=position.feedback / self._steps_per_mm,
            moving=bool(state.outputs & AzOutput.MOVE),
            servo=_servo(state),
            homed=bool(known),
            fault=f"{state.alarm:02X}h ({alarm_in_words(state.alarm)[0]})" if state.alarm else "",
        )

    def close(self) -> None:
        """See `StageReader`."""
        self._link.close()


def _servo(state: AzState) -> str:
    """Return what the drive calls its state: its outputs do not say whether the motor has
    current."""
    if state.inputs & AzInput.STOP:
        return "STOP is set"
    return "ready" if state.outputs & AzOutput.READY else "not ready"
