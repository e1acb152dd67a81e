"""How many frames of a force sensor are overdue beyond what is usual, and for how long."""

from __future__ import annotations

MISSING_FRAMES = 25
"""Frames overdue by bench time, beyond the usual number, from which they are late or the stream has
a gap."""
DRIFT = 1e-3
"""Rate at which the usual number of overdue frames follows: well above the drift between two
clocks."""


class FrameDelay:
    """Follows the number of overdue frames of one stream. Used by the reader's thread."""

    def __init__(self) -> None:
        self._usual = 0.0
        self._looked_s = 0.0
        self._missing_since_s: float | None = None

    def begin(self, now_s: float) -> None:
        """Begin with the stream."""
        self._looked_s = now_s

    def take_as_usual(self, behind: float) -> None:
        """Take the present number of overdue frames as the usual one: after a silence, which was
        judged by itself."""
        self._usual = behind

    def beyond_usual(self, behind: float) -> float:
        """Return by how many frames more than usual the sensor is behind, where `behind` are
        overdue."""
        return behind - self._usual

    def missing_for_s(self, now_s: float, behind: float, rate_S_s: float) -> float | None:
        """Return for how many s frames have been missing, of which `behind` are overdue now; None
        if none are."""
        missing = self.beyond_usual(behind)
        drift = DRIFT * rate_S_s * (now_s - self._looked_s)
        self._looked_s = now_s
        if missing < MISSING_FRAMES:
            # It falls no faster than it rises, because one batch may be ahead of a slaved clock.
            self._usual += max(-drift, min(missing, drift))
            self._missing_since_s = None
            return None
        if self._missing_since_s is None:
            self._missing_since_s = now_s
        return now_s - self._missing_since_s
