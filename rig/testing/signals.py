"""The signals that the instruments measure during the checks of the contract."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

LEVEL_N = np.array([2.0, -3.0, 5.0])
SLOPE_N_s = np.array([10.0, -15.0, 20.0])
"""Slope of the force for a sensor with 1000 frames/s."""
USUAL_RATE_S_s = 1000.0


@dataclass(frozen=True)
class ForceLaw:
    """A force that rises steadily, so that every frame shows at which instant it was measured.

    For a slow sensor it rises more slowly, by as much from frame to frame.
    """

    rate_S_s: float = USUAL_RATE_S_s
    """The largest frame rate that is asked for."""
    scale: float = 1.0

    @property
    def level_N(self) -> npt.NDArray[np.float64]:  # noqa: N802 - the unit keeps its capital
        """The force along x, y, z at bench time 0, (3,) in N."""
        return self.scale * LEVEL_N

    @property
    def slope_N_s(self) -> npt.NDArray[np.float64]:  # noqa: N802 - the unit keeps its capital
        """Slopes of the force along x, y, z, (3,) in N/s."""
        return self.scale * SLOPE_N_s * min(1.0, self.rate_S_s / USUAL_RATE_S_s)

    def __call__(self, time_s: Any) -> npt.NDArray[np.float64]:
        """Return the force along x, y, z in N, shape (n, 3), at bench times (n,) in seconds."""
        return np.asarray(self.level_N + np.asarray(time_s)[:, None] * self.slope_N_s)


WAVE_SLOPE_V_s = 0.2
WAVE_LARGEST_V = 4.0
"""Voltage that no terminal reaches during the checks."""


def carried(terminal: int, time_s: Any) -> Any:
    """Return the volts of a terminal: each has its own level, rising with time, so that every
    record of every instant differs from every other."""
    return 0.5 * (terminal - 101) + WAVE_SLOPE_V_s * time_s
