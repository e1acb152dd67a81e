"""The static force under a vibration, from the frames of a slow force sensor."""

from __future__ import annotations

import math

import numpy as np

from rig.analysis.response.sine_fit import FULL_BEAT, Reals

TONE_PARAMETERS = 3
"""Unknowns of the fit: the static force, and cosine and sine of the vibration."""


def static_force(
    frames_N: Reals, rate_Hz: float, frequency_Hz: float, load_N: float
) -> tuple[float, float]:
    """Return the static force and its standard error in N from frames (n,) at ``rate_Hz``.

    The vibration at ``frequency_Hz`` is fitted together with it, folded to below half the rate
    where it is faster than the frames. Without this, a record that does not hold whole cycles reads
    a part of the vibration as static: 1.6 N of 10 N at 25 Hz in 50 ms.

    Where the frames hold less than one beat of the folded vibration, only the mean is returned, and
    its error includes what is left of a vibration of ``load_N`` peak in a mean over one frame.

    >>> times_s = np.arange(50) / 1000
    >>> frames_N = 25 + 10 * np.cos(2 * np.pi * 25.0 * times_s)
    >>> force, error = static_force(frames_N, 1000.0, 25.0, 10.0)
    >>> round(force, 6)
    25.0
    """
    n = len(frames_N)
    folded_Hz = abs(frequency_Hz - rate_Hz * round(frequency_Hz / rate_Hz))
    if n <= TONE_PARAMETERS or folded_Hz * (n + 0.5) / rate_Hz < FULL_BEAT:
        noise = float(frames_N.std(ddof=1)) / math.sqrt(n) if n > 1 else 0.0
        left = load_N * abs(np.sinc(frequency_Hz / rate_Hz)) / math.sqrt(2)
        return float(frames_N.mean()), math.hypot(noise, float(left))
    turns = 2 * np.pi * folded_Hz / rate_Hz * np.arange(n)
    columns = np.stack([np.ones(n), np.cos(turns), np.sin(turns)], axis=1)
    # At half the rate one column is nearly zero: the pseudo-inverse leaves it out.
    inverse = np.linalg.pinv(columns, rcond=1e-6)
    found = inverse @ frames_N
    rest = frames_N - columns @ found
    noise_N = math.sqrt(float(rest @ rest) / (n - TONE_PARAMETERS))
    return float(found[0]), noise_N * float(np.linalg.norm(inverse[0]))
