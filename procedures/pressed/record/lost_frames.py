"""Frames of a force sensor that were lost on the way, by the time of those that follow."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

LOST_FRAMES = 2
"""Minimum number of frames that a record is said to have lost: one is within the rounding of two
clocks."""
COMPARED_S, COMPARED_LOOKS = 0.5, 25
"""Time before and after a moment over which the fewest overdue frames are compared, and the fewest
looks after it. Frames that are merely late come within it; those that are lost never do."""
EVERY_LOOKS = 5
"""Looks from one moment that is compared to the next."""
BY_CHANCE = 1e-7
"""Probability with which frames that come with irregular delays may look like lost ones, a look."""


def lost_frames(looks: npt.ArrayLike, rate_S_s: float) -> int:
    """Return the largest number of frames that a stream at `rate_S_s` lost at one moment. Return 0
    if none were lost, fewer than `LOST_FRAMES`, or so few that irregular delays hide them.

    `looks` are times in s and the number of frames that had come by then, (n, 2). A frame has
    neither number nor time: that some are lost shows only in that all later ones are overdue. A
    clock that is wrong by 100 parts in a million makes a tenth of a frame in the time compared.
    """
    times_s, frames = np.asarray(looks, dtype=np.float64).reshape(-1, 2).T
    overdue = times_s * rate_S_s - frames
    largest = 0.0
    for at in range(len(overdue) - COMPARED_LOOKS, 0, -EVERY_LOOKS):
        since = min(np.searchsorted(times_s, times_s[at] - COMPARED_S), max(0, at - COMPARED_LOOKS))
        until = max(np.searchsorted(times_s, times_s[at] + COMPARED_S), at + COMPARED_LOOKS)
        earlier, later = overdue[since:at], overdue[at:until]
        # Of n delays that are spread evenly, the least is above this with that probability.
        delays = 2 * max(float(np.median(part) - part.min()) for part in (earlier, later))
        chance = -math.log(BY_CHANCE) * delays / len(later)
        if (lost := float(later.min() - earlier.min())) > chance:
            largest = max(largest, lost)
    return round(largest) if round(largest) >= LOST_FRAMES else 0
