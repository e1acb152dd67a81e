"""World time, advanced by the run that owns it, or by the host's clock.

A slaved timeline stands until its owner advances it. A free one follows the host's monotonic clock.
A slaved one can be set free, which happens when its owner has ended: drives then meet their
communication time-outs as they would on hardware.
"""

from __future__ import annotations

import time


class WorldTimeline:
    """Integer microseconds since the World began."""

    def __init__(self, slaved: bool):
        self._base_us = 0
        self._free_since_ns: int | None = None if slaved else time.monotonic_ns()

    @property
    def slaved(self) -> bool:
        """True if time moves only by `advance`."""
        return self._free_since_ns is None

    @property
    def now_us(self) -> int:
        """World time in microseconds."""
        if self._free_since_ns is None:
            return self._base_us
        return self._base_us + (time.monotonic_ns() - self._free_since_ns) // 1000

    def advance(self, step_us: int) -> None:
        """Move a slaved timeline on by `step_us` >= 0; ValueError on any other."""
        if self._free_since_ns is not None:
            raise ValueError("this bench runs in real time and cannot be advanced")
        if step_us < 0:
            raise ValueError(f"time cannot go back by {-step_us} us")
        self._base_us += step_us

    def jump(self, step_us: int) -> None:
        """Advance the time by `step_us` >= 0 without its owner, for a fault plan."""
        self._base_us += step_us

    def set_free(self) -> None:
        """Continue in real time from here; does nothing on a free timeline."""
        if self._free_since_ns is None:
            self._free_since_ns = time.monotonic_ns()
