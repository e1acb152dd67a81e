"""The common parts of all procedures that press the skin on an object at a controlled normal force.
What is in `approach` belongs to every procedure that presses, that of a film in the sweep as well.

`PressedProcedure` is the base class for a procedure of your own: docs/add-a-procedure.md.
"""

from __future__ import annotations

from procedures.pressed.procedure import PressedProcedure
from procedures.pressed.settings import PressedSettings

__all__ = ["PressedProcedure", "PressedSettings"]
