"""The exception for a limit that was exceeded while a point was measured."""

from __future__ import annotations

from rig.core.errors import LimitError


class TripError(LimitError):
    """Raised for an exceeded limit: the bench is made safe and the point retaken once; a second
    trip ends the run."""
