"""The smallest procedure: press, hold the force, read how far the skin crept. Copy it.

It is not a command of this program. docs/add-a-procedure.md shows how a package makes it one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from procedures.pressed import PressedProcedure, PressedSettings
from rig.files.journal.layout import Column

if TYPE_CHECKING:
    from procedures.pressed.record.motion import MotionRecord
    from procedures.pressed.trial import PressedTrial


class Creep(PressedProcedure):
    """Hold a force and watch the skin creep."""  # the help text of its command

    name = "creep"  # equal to the name of the entry point
    fixtures = ("plate",)  # what it can work with; a simulated bench gets the first one
    columns = (Column("creep", "um", "Travel of z during the hold"),)  # its key: creep_um

    class Settings(PressedSettings):  # each field is an option, the suffix is its unit
        """The settings of a creep run."""

        hold_s: float = 10.0
        """How long the force is held."""

    def motion_s(self) -> float:
        """Return how long `under_force` will take: for progress and for batches."""
        return float(self.settings.hold_s)

    def under_force(self, trial: PressedTrial) -> None:
        """Hold the force. The skin is pressed before, and lifted after, by the base class."""
        trial.hold(self.settings.hold_s)

    def reading(self, record: MotionRecord) -> dict[str, float]:
        """Return a value for each of the columns, from what was recorded under the force."""
        return {"creep_um": 1e3 * (record.z_mm[-1] - record.z_mm[0])}
