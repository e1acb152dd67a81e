"""The chi-square distribution, for tests of how well a model fits.

It is computed here, because `scipy.special`, which has it too, would take up to a quarter of the
time that a sweep needs for its imports.
"""

from __future__ import annotations

import math


def probability_above(chi_square: float, degrees: int) -> float:
    """Return the probability that a chi-square with `degrees` degrees of freedom is at least
    `chi_square`.

    Abramowitz and Stegun, Handbook of Mathematical Functions, 26.4.4 (odd) and 26.4.5 (even
    degrees): a finite sum. It is NaN for a `chi_square` that is negative or NaN, or without degrees
    of freedom.
    """
    if not chi_square >= 0 or degrees < 1:
        return math.nan
    if chi_square in (0.0, math.inf):
        return 1.0 if chi_square == 0 else 0.0
    half = chi_square / 2
    odd = degrees % 2
    found = math.erfc(math.sqrt(half)) if odd else 0.0
    # The terms are computed as logarithms: with many degrees of freedom the powers overflow.
    for k in range(degrees // 2):
        exponent = k + odd / 2
        found += math.exp(exponent * math.log(half) - half - math.lgamma(exponent + 1))
    return min(found, 1.0)
