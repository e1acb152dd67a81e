"""What the instruments measure during the checks of the contract."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

LEVEL_N: npt.NDArray[np.float64] = np.array([2.0, -3.0, 5.0])
SLOPE_N_s: npt.NDArray[np.float64] = np.array([10.0, -15.0, 20.0])


def pressed(time_s: Any) -> npt.NDArray[np.float64]:
    """Return the force along x, y, z in N, shape (n, 3), at bench times (n,) in seconds.

    It rises steadily, so that every frame shows at which instant it was measured.
    """
    force: npt.NDArray[np.float64] = LEVEL_N + np.asarray(time_s)[:, None] * SLOPE_N_s
    return force


def carried(terminal: int, time_s: Any) -> Any:
    """Return the volts of a terminal: each has its own level, rising with time, so that every
    record of every instant differs from every other."""
    return 0.5 * (terminal - 101) + 0.2 * time_s
