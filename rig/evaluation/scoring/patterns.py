"""Which of the two patterns of Figure 19 a roll shows."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

SMOOTHED_S = 0.02
"""Length of the mean that takes noise and mains away before excursions are compared: one period of
50 Hz."""


def roll_pattern(volts: ArrayLike, rate_Hz: float, motion_s: float) -> Literal["a", "b"]:
    """a where the main excursions of v_1 and v_2 in a roll have one sign, b where they have two.

    `volts` (n, 2) of v_1 and v_2; the excursion is from the mean of the 20 ms before the motion.
    """
    given = np.asarray(volts, dtype=np.float64)
    length = max(1, round(SMOOTHED_S * rate_Hz))
    begin = round(motion_s * rate_Hz)
    if not length <= begin < len(given) - length:
        raise ValueError(
            f"motion_s {motion_s:g} s must leave {SMOOTHED_S:g} s on either side of it, of "
            f"{len(given) / rate_Hz:g} s recorded"
        )
    rest = given[begin - length : begin].mean(axis=0)
    mean = np.ones(length) / length
    moved = np.column_stack([np.convolve(v, mean, "valid") for v in (given[begin:] - rest).T])
    main = moved[np.abs(moved).argmax(axis=0), [0, 1]]
    return "a" if main[0] * main[1] > 0 else "b"
