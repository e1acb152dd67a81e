"""The slope of equally spaced samples, with its standard error."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt


def slopes(
    samples: npt.NDArray[np.float64], rate_Hz: float
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the slope of each column of `samples` (n, k) in its unit by s, and the standard error
    that its residuals give it, both (k,). With fewer than three samples both are 0 and infinite."""
    import numpy as np

    n = len(samples)
    if n < 3:
        return np.zeros(samples.shape[1]), np.full(samples.shape[1], np.inf)
    times_s = (np.arange(n) - (n - 1) / 2) / rate_Hz
    spread = float(times_s @ times_s)
    found = times_s @ samples / spread
    residuals = samples - samples.mean(axis=0) - np.outer(times_s, found)
    errors = np.sqrt((residuals**2).sum(axis=0) / (n - 2) / spread)
    return found, errors
