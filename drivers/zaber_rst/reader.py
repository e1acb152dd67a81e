"""Reads a Zaber stage without changing it: for `rig monitor` on a bench without a run.

All that is sent are ``get`` and ``warnings``, which clears nothing. The stage has no communication
time-out of its own [not confirmed].
"""

from __future__ import annotations

from drivers.zaber_rst.dialogue import ZaberDialogue
from drivers.zaber_rst.settings import (
    DISABLED,
    FLAGS,
    NOT_REFERENCED,
    NOTES,
    UNKNOWN_FLAG,
    ZaberRstSettings,
)
from rig.core.clock import Clock
from rig.instruments.roles import Identity, StageStatus


class ZaberReader:
    """A connection to one axis that only reads."""

    timeout_s = 0.0

    def __init__(self, settings: ZaberRstSettings, clock: Clock):
        self._dialogue = ZaberDialogue(settings, clock)
        self.identity = Identity("Zaber", "X-RST", "unknown", "unknown")

    def open(self) -> None:
        """Identify the stage and check that its microsteps are those of the bench file."""
        self.identity = self._dialogue.identify()
        self._dialogue.check_units()

    def read(self) -> StageStatus:
        """See `StageReader`."""
        angle_deg, reply = self._dialogue.angle()
        flags = self._dialogue.flags()
        faults = [flag for flag in flags if flag not in NOTES | NOT_REFERENCED]
        return StageStatus(
            position=angle_deg,
            moving=reply.busy,
            servo="off" if DISABLED & set(flags) else "on",
            homed=not NOT_REFERENCED & set(flags),
            fault="; ".join(f"{flag} ({FLAGS.get(flag, UNKNOWN_FLAG).meaning})" for flag in faults),
        )

    def close(self) -> None:
        """See `StageReader`."""
        self._dialogue.link.close()
