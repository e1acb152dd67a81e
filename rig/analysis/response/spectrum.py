"""Distribution of the energy of a signal over frequency."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def share_above(signal: NDArray[np.float64], rate_Hz: float, corner_Hz: float) -> float:
    """Returns the share of a signal's energy above a frequency, 0 to 1; 0 for a signal of zeros.

    The mean of the signal (n,) counts as energy at 0 Hz.
    """
    power = np.abs(np.fft.rfft(signal)) ** 2
    power[1 : (signal.size + 1) // 2] *= 2
    above = np.fft.rfftfreq(signal.size, 1 / rate_Hz) > corner_Hz
    total = float(power.sum())
    return float(power[above].sum()) / total if total > 0 else 0.0
