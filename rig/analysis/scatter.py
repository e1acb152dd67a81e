"""Scatter beyond the stated errors of single values (Mandel and Paule 1970)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float64]

LARGEST_SCATTER = 100.0
"""Largest scatter that is searched, in the unit of the values."""
NO_SCATTER = 1e-7
"""Scatter below this is taken as zero."""


def explaining_error(residuals: Reals, variances: Reals, degrees: float) -> float:
    """Return the additional error of every point, in the unit of the residuals (n,), that reduces
    chi-square to ``degrees``, by bisection; 0 if none is needed (Mandel and Paule 1970)."""
    squares = np.square(residuals)
    if (squares / variances).sum() <= degrees:
        return 0.0
    low, high = 0.0, LARGEST_SCATTER
    for _ in range(60):
        middle = (low + high) / 2
        if (squares / (variances + middle**2)).sum() > degrees:
            low = middle
        else:
            high = middle
    return high if high > NO_SCATTER else 0.0
