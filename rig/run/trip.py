"""A limit that was exceeded while a point was taken."""

from __future__ import annotations

from rig.core.errors import LimitError


class TripError(LimitError):
    """The bench is made safe and the point retaken once; a second trip ends the run."""
