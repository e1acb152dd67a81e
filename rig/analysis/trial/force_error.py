"""The error of the normal force in a motion: over what it is averaged, and when it is judged."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

AVERAGED_S = 0.005
"""Stretch over which the force is averaged, in an odd number of frames."""
SQUEEZED_S = 0.1
"""Time after a squeeze in which the force is on its way to the new set point and is not judged."""


def averaged(force_N: NDArray[np.float64], rate_S_s: float) -> NDArray[np.float64]:
    """Return the mean over `AVERAGED_S` around each frame: the error of a servo is not the sensor's
    noise."""
    frames = 2 * round((AVERAGED_S * rate_S_s - 1) / 2) + 1
    kernel = np.full(frames, 1 / frames)
    return np.convolve(np.pad(force_N, frames // 2, mode="edge"), kernel, "valid")


def judged(
    t: NDArray[np.float64], motion_s: tuple[float, float], squeezes_s: Iterable[float]
) -> NDArray[np.bool_]:
    """Return which of the times `t` (n,) in s are judged: those of the motion, without what follows
    a squeeze unless that is all of it."""
    moving = (t >= motion_s[0]) & (t <= motion_s[1])
    followed = moving.copy()
    for at_s in squeezes_s:
        followed &= (t < at_s) | (t > at_s + SQUEEZED_S)
    return followed if followed.any() else moving
