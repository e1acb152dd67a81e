"""Distribution of the energy of a signal over frequency."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SHORTEST_WINDOW = 16
"""Minimum number of samples from which an rms above a frequency is computed."""


def share_above(signal: NDArray[np.float64], rate_Hz: float, corner_Hz: float) -> float:
    """Return the share of a signal's energy above a frequency, 0 to 1; 0 for a signal of zeros.

    The mean of the signal (n,) counts as energy at 0 Hz.
    """
    power = np.abs(np.fft.rfft(signal)) ** 2
    power[1 : (signal.size + 1) // 2] *= 2
    above = np.fft.rfftfreq(signal.size, 1 / rate_Hz) > corner_Hz
    total = float(power.sum())
    return float(power[above].sum()) / total if total > 0 else 0.0


def rms_above(signal: NDArray[np.float64], rate_Hz: float, corner_Hz: float) -> float:
    """Return the rms of a signal (n,) above a frequency, in its unit.

    A Hann window keeps a slow signal that ends elsewhere than it began from leaking into the upper
    band; its loss of power is corrected. Unlike a share of the energy, the result does not depend
    on how large the slow part is, and can be compared with the noise at rest.

    >>> t = np.arange(1000) / 1000
    >>> slow, fast = np.cos(2 * np.pi * 2.3 * t), 0.01 * np.cos(2 * np.pi * 200.0 * t)
    >>> round(rms_above(slow + fast, 1000.0, 100.0), 5)
    0.00707
    """
    n = signal.size
    if n < SHORTEST_WINDOW:
        return float("nan")
    window = np.hanning(n + 2)[1:-1]
    power = np.abs(np.fft.rfft((signal - signal.mean()) * window)) ** 2
    power[1 : (n + 1) // 2] *= 2
    above = np.fft.rfftfreq(n, 1 / rate_Hz) > corner_Hz
    return float(np.sqrt(power[above].sum() / n / (window**2).sum()))
