"""Two calculations of filter design that SciPy has, too, written out here.

A live detector is designed in every process that runs a trial. `scipy.signal` and `scipy.optimize`
need 0.5 s of processor time to import. The roots are the same to the last bit; of 4000 filters, 19
differed in the last bit of a coefficient. The tests compare them.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float64]

MOST_STEPS = 100
"""Largest number of steps towards a root; each halves the interval at least every other time."""
RELATIVE_TOLERANCE = 4 * float(np.finfo(np.float64).eps)
"""Part of the root itself to which it is found."""


def butterworth_high_pass(corner_Hz: float, rate_Hz: float) -> Reals:
    """Returns the second-order sections (2, 6) of a Butterworth high-pass filter of order 3, each
    b_0, b_1, b_2, a_0, a_1, a_2.

    The poles of the analog low-pass filter lie on the unit circle; those of the high-pass filter
    are their inverses times the corner, and the bilinear transform makes them digital. All three
    zeros lie at 0 Hz. Raises ValueError for a corner that is not between 0 and half the rate.
    """
    if not 0 < corner_Hz < rate_Hz / 2:
        raise ValueError(
            f"corner of the high-pass filter {corner_Hz:g} Hz must be between 0 and half the "
            f"sampling rate of {rate_Hz:g} Hz"
        )
    poles = -np.exp(1j * np.pi * np.array([-2.0, 0.0, 2.0]) / 6)
    # The bilinear transform warps frequencies: this corner of the analog filter becomes corner_Hz.
    corner = 4 * math.tan(math.pi * (2 * corner_Hz / rate_Hz) / 2)
    analog = corner / poles
    digital = (4 + analog) / (4 - analog)
    gain = float(np.real(1 / np.prod(-poles)) * np.real(4.0**3 / np.prod(4 - analog)))
    pole, real = complex(digital[0]), float(digital[1].real)
    single, double = np.array([1.0, -1.0, 0.0]), np.array([1.0, -2.0, 1.0])
    # Two of the zeros belong to the pair of poles while it is nearer to them than to 0.
    of_real, of_pair = (single, double) if pole.real > 0.5 else (double, single)
    size = (pole * pole.conjugate()).real
    return np.array([[*gain * of_real, 1, -real, 0], [*of_pair, 1, -2 * pole.real, size]])


def root_between(
    function: Callable[[float], float], low: float, high: float, tolerance: float
) -> float:
    """Returns a root of a continuous function between two places where its signs differ, by Brent's
    method (R. P. Brent, Algorithms for Minimization without Derivatives, 1973, chapter 4), as
    `scipy.optimize.brentq` does.

    The root is found to `tolerance`, in the unit of the places. Raises ValueError where the signs
    are the same or the root was not found in `MOST_STEPS`.
    """
    before, best = low, high
    f_before, f_best = function(before), function(best)
    if f_before == 0:
        return before
    if f_best == 0:
        return best
    if (f_before < 0) == (f_best < 0):
        raise ValueError(f"the function has the same sign at {low:g} and at {high:g}")
    across, f_across, step, last_step = 0.0, 0.0, 0.0, 0.0
    for _ in range(MOST_STEPS):
        if (f_before < 0) != (f_best < 0):  # the root is between the last two places
            across, f_across = before, f_before
            step = last_step = best - before
        if abs(f_across) < abs(f_best):
            before, best, across = best, across, best
            f_before, f_best, f_across = f_best, f_across, f_best
        delta = (tolerance + RELATIVE_TOLERANCE * abs(best)) / 2
        half = (across - best) / 2
        if f_best == 0 or abs(half) < delta:
            return best
        short = half
        if abs(last_step) > delta and abs(f_best) < abs(f_before):
            if before == across:
                tried = -f_best * (best - before) / (f_best - f_before)
            else:  # the parabola through the three places, as a function of the value
                slope = (f_before - f_best) / (before - best)
                slope_across = (f_across - f_best) / (across - best)
                tried = (
                    -f_best
                    * (f_across * slope_across - f_before * slope)
                    / (slope_across * slope * (f_across - f_before))
                )
            if 2 * abs(tried) < min(abs(last_step), 3 * abs(half) - delta):
                last_step, short = step, tried
            else:
                last_step = half
        else:
            last_step = half
        step = short
        before, f_before = best, f_best
        best += step if abs(step) > delta else math.copysign(delta, half)
        f_best = function(best)
    raise ValueError(f"no root was found between {low:g} and {high:g} in {MOST_STEPS} steps")
