"""Reads a CMMT drive without changing it: for `rig monitor` on a bench without a run.

Two kinds of request are sent: device identification (function 43) and reading of registers
(function 3). The parameter mailbox takes writes and is left alone: so the serial number is not
known here, and the drive's units are those of the bench file, unchecked. No time-out is set.

A request may restart the drive's communication time-out (not confirmed), which then expires once
the reader has gone. It is a fault of an axis at rest, which the next run acknowledges; a drive that
has had it after its last run has it already.
"""

from __future__ import annotations

from drivers.festo_cmmt.frames import IMAGE_REGISTERS, Inputs, Zsw1
from drivers.festo_cmmt.link import COMMUNICATION_TIMEOUT, INPUT_IMAGE, CmmtLink
from drivers.festo_cmmt.preparation import read_identity
from drivers.festo_cmmt.settings import FestoCmmtSettings, fault_in_words
from rig.core.clock import Clock
from rig.instruments.roles import Identity, StageStatus


class CmmtReader:
    """A connection to one drive that only reads."""

    def __init__(self, settings: FestoCmmtSettings, clock: Clock):
        self._unit_mm = settings.position_unit_mm
        self._link = CmmtLink(
            settings.role,
            settings.host,
            settings.port,
            settings.unit_id,
            settings.timeout_s,
            clock,
        )
        self.identity = Identity("Festo", "CMMT", "unknown", "unknown")
        self.timeout_s = 0.0
        """The drive's communication time-out, as it was set when the reader was opened."""

    def open(self) -> None:
        """Identify the drive and read its communication time-out."""
        self.identity = read_identity(self._link)
        (timeout_ms,) = self._link.read(COMMUNICATION_TIMEOUT, 1)
        self.timeout_s = timeout_ms * 1e-3

    def read(self) -> StageStatus:
        """See `StageReader`."""
        seen = Inputs.from_registers(self._link.read(INPUT_IMAGE, IMAGE_REGISTERS))
        fault = ""
        if Zsw1.FAULT in seen.zsw1:
            fault = f"{seen.fault} ({fault_in_words(seen.fault)[0]})"
        return StageStatus(
            position=seen.position * self._unit_mm,
            moving=Zsw1.STOPPED not in seen.zsw1,
            servo="on" if Zsw1.OPERATION_ENABLED in seen.zsw1 else "off",
            homed=Zsw1.HOMED in seen.zsw1,
            fault=fault,
        )

    def close(self) -> None:
        """See `StageReader`."""
        self._link.close()
