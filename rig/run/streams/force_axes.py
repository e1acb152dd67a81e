"""Watches each axis of a force sensor by itself: one may stop measuring while the others go on.

A converter always sees noise of many steps (unconfirmed on the amplifier), so an axis that does not
measure any more shows itself in one of two ways: its value repeats to the last bit, or its noise is
gone while that of the others is as it was. Both are compared with what the axis itself did before.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

AXES = "xyz"
STUCK_FRAMES = 50
"""Number of successive frames with the same value on one axis that show it is stuck."""
USUAL_RUNS = 10
"""Ratio of that number to the longest row of equal values that the axis has had while it lived: a
sensor with coarse steps repeats values."""
QUIET_FRAMES = 250
"""Number of frames over which the noise of the axes is compared with what it was."""
QUIET_SHARE, LIVING_SHARE = 0.05, 0.3
"""Shares of its earlier noise: below the one an axis is quiet, above the other one it lives."""


class AxisWatch:
    """The axes of one stream."""

    def __init__(self, axes: str = ""):
        """`axes` are those that the sensor is known to have. One of the others whose value has
        always been 0 is taken for an axis that the sensor lacks."""
        self._last: npt.NDArray[np.float64] | None = None
        self._lives = np.array([axis in axes for axis in AXES])
        """Whether the sensor has the axis, as far as is known."""
        self._row = np.ones(3, int)
        """Number of successive frames up to the latest with the same value."""
        self._longest = np.ones(3, int)
        """Longest such row that has ended."""
        self._usual: npt.NDArray[np.float64] | None = None
        """Mean step from frame to frame at rest; None until it is known."""
        self._steps, self._frames = np.zeros(3), 0
        """Sum of the steps since the noise was judged, and their number."""

    def learn(self, raw: npt.NDArray[np.float32]) -> None:
        """Take the noise of these frames (n, 3), at rest, as the usual one."""
        if len(raw) > 1:
            self._usual = np.abs(np.diff(raw.astype(float), axis=0)).mean(axis=0)
        self._steps, self._frames = np.zeros(3), 0

    def fault(self, raw: npt.NDArray[np.float32]) -> str | None:
        """Take the next frames (n, 3); return which axis has stopped measuring and how that shows,
        as a sentence; None if all measure."""
        if not len(raw):
            return None
        if not self._lives.all():
            self._lives |= (raw != 0).any(axis=0)
        values = raw.astype(float)
        steps = np.empty_like(values)
        steps[0] = 0.0 if self._last is None else values[0] - self._last
        np.subtract(values[1:], values[:-1], out=steps[1:])
        np.abs(steps, out=steps)
        self._last = values[-1]
        return self._stuck(steps) or self._quiet(steps)

    def _stuck(self, steps: npt.NDArray[np.float64]) -> str | None:
        if steps.all():  # as nearly always: every value of every axis is a new one
            np.maximum(self._longest, self._row, out=self._longest)
            self._row[:] = 1
            return None
        for axis in np.flatnonzero(self._lives).tolist():
            changed = np.flatnonzero(steps[:, axis])
            if changed.size:
                rows = np.diff(changed, prepend=-int(self._row[axis]))
                self._longest[axis] = max(self._longest[axis], int(rows.max()))
                self._row[axis] = len(steps) - int(changed[-1])
            else:
                self._row[axis] += len(steps)
            if self._row[axis] >= max(STUCK_FRAMES, USUAL_RUNS * self._longest[axis]):
                return (
                    f"axis {AXES[axis]} has had the same value in {self._row[axis]} frames in a "
                    "row: its force is not measured any more"
                )
        return None

    def _quiet(self, steps: npt.NDArray[np.float64]) -> str | None:
        self._steps += steps.sum(axis=0)
        self._frames += len(steps)
        if self._usual is None or self._frames < QUIET_FRAMES:
            return None
        mean, self._steps, self._frames = self._steps / self._frames, np.zeros(3), 0
        noisy = self._usual > 0
        share = np.where(noisy, mean / np.where(noisy, self._usual, 1.0), 1.0)
        quiet = noisy & (share < QUIET_SHARE)
        if quiet.any() and (noisy & (share > LIVING_SHARE)).any():
            axis = int(quiet.argmax())
            return (
                f"axis {AXES[axis]} has {100 * share[axis]:.1g} % of its noise at rest, "
                "and another axis has as much as before: it does not measure any more"
            )
        return None
