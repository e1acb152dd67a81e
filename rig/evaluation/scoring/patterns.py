"""Classifies a roll by the two patterns of Figure 19."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

SMOOTHED_S = 0.02
"""Length of the moving average that removes noise and mains before excursions are compared: one
period of 50 Hz."""


def roll_pattern(volts: ArrayLike, rate_Hz: float, motion_s: float) -> Literal["a", "b"]:
    """Return "a" if the main excursions of v_1 and v_2 in a roll have the same sign, "b"
    otherwise.

    `volts` (n, 2) are v_1 and v_2. Excursions are measured from the mean of the 20 ms before the
    motion.

    Raises ValueError if there are not 20 ms of signal on either side of `motion_s`.
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
