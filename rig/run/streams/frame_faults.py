"""What a force sensor's frames show that must not be: too large a force, or a sensor that no longer
measures.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rig.instruments.roles import ForceFrames
from rig.run.streams.force_axes import AXES, AxisWatch

STILL_FRAMES = 20
"""Number of successive frames, equal to the last bit on all axes, that show a stopped converter:
one of 24 bits always sees noise of many steps (unconfirmed on the amplifier)."""


@dataclass(frozen=True)
class FrameFault:
    """A reason for which the bench is made safe."""

    cause: str
    hint: str
    is_over_limit: bool = False
    """True for a force over the limit; otherwise the sensor is not to be believed any more."""


def unknown_force(frames: ForceFrames) -> FrameFault | None:
    """Return the fault of frames of which a force is not a finite number, which no limit judges and
    nothing may be computed from; else None."""
    finite = np.isfinite(frames.force_N)
    if finite.all():
        return None
    wrong = int(np.count_nonzero(~finite.all(axis=1)))
    return FrameFault(
        f"the force of {wrong} of {len(frames)} frames is not a finite number",
        "check the amplifier, its cable and its calibration",
    )


class FrameFaults:
    """Looks at every frame of one stream. Used by the reader's thread, except where stated."""

    def __init__(self, axes: str):
        """`axes` are those that the sensor is known to have."""
        self.limit_N = math.inf
        """Force along any axis that is a fault; set by the procedure's thread. After such a
        fault there is none until it is set again."""
        self.largest_N = 0.0
        """Largest force along any axis since the procedure's thread has set it to 0."""
        self.at_rest: npt.NDArray[np.float32] | None = None
        """Raw frames (n, 3) at rest, set by the procedure's thread, from which to learn the noise
        of the axes; None once that is done."""
        self._axes = AxisWatch(axes)
        self._last_raw: list[float] = []
        self._still = 0
        """Number of successive frames up to the latest that repeat the one before them."""

    def in_frames(self, frames: ForceFrames) -> Iterator[FrameFault]:
        """Yield what is wrong with the next frames, the most urgent first."""
        yield from self._too_large(frames)
        yield from self._repeated(frames)
        if (rest := self.at_rest) is not None:
            self.at_rest = None
            self._axes.learn(rest)
        if (fault := self._axes.fault(frames.raw)) is not None:
            hint = "check the cable and the bridge of this axis; switch the amplifier off and on"
            yield FrameFault(fault, hint)

    def _too_large(self, frames: ForceFrames) -> Iterator[FrameFault]:
        if np.count_nonzero(frames.saturated):
            yield FrameFault(
                f"{int(frames.saturated.sum())} of {len(frames)} frames are saturated: the force "
                "is beyond what the amplifier can measure",
                "unload the sensor; check its zero, its cable and the input range",
            )
        sizes = np.abs(frames.force_N)
        largest = float(sizes.max())
        self.largest_N = max(self.largest_N, largest)
        limit_N = self.limit_N
        if largest <= limit_N:
            return
        self.limit_N = math.inf
        axis = AXES[int(sizes.max(axis=0).argmax())]
        yield FrameFault(
            f"force along {axis} of {largest:.3g} N is over the limit of {limit_N:g} N",
            "find out first what pressed on it",
            is_over_limit=True,
        )

    def _repeated(self, frames: ForceFrames) -> Iterator[FrameFault]:
        for raw in frames.raw.tolist():
            self._still = self._still + 1 if raw == self._last_raw else 0
            self._last_raw = raw
            if self._still >= STILL_FRAMES:
                yield FrameFault(
                    f"{self._still} frames in a row are the same to the last bit: the force is not "
                    "measured any more",
                    "switch the amplifier off and on; check that its converter runs",
                )
