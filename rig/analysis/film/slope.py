"""Slopes of a gain curve: what "20 dB/decade from 2 to 2000 Hz" can mean, with errors.

- The *asymptotic slope* is the exponent of the rise, free up to 2 kHz in the joint model of circuit
  and notches: pole and notches are removed. A first-order film has 20 dB/decade, whatever its
  corner and grid. It tests statement (i) of the paper.
- The *slope* over 2 to 2000 Hz is that of the least-squares line through the trend, over log f,
  with equal weight for every frequency of the band. The notches are removed, the pole is not: it is
  what a ruler finds on the paper's figure 5, without the influence of notches and grid. With the
  corner at 2 kHz it is 19.57 dB/decade. The circuit's table of readings uses this slope.
- The *plain fit* is the paper's equation (2), gain = 20 log10 f + b, by unweighted least squares
  over the measured points of the band outside the notches, with the line of free slope through the
  same points. Pole and the flanks of notches bias it, the more so the more points there are near 2
  kHz.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rig.analysis.estimate import Estimate
from rig.analysis.film.fit import FilmFit, fit_film
from rig.analysis.film.model import FIRST_ORDER_SLOPE, SLOPE_BAND_HZ, FilmModel
from rig.analysis.response.complex_response import DB_PER_RELATIVE, Reals
from rig.analysis.response.curve import ResponseCurve
from rig.analysis.verdict import Bounds, Verdict, equivalence

MISFIT = "but the model does not fit, so its intervals mean nothing"
OUTSIDE_DROPS_DB = 0.5
"""A point is outside the notches if they together attenuate it by less than this, in dB."""
NARROWEST_BAND = 2.0
"""Minimum ratio of highest to lowest frequency of a band whose slope is computed."""

_LINE_POINTS = 2000


@dataclass(frozen=True)
class Slopes:
    """Both slopes over the measured part of 2 to 2000 Hz."""

    band_Hz: tuple[float, float]
    """Lowest and highest frequency used."""
    slope: Estimate
    """Slope of the straight line through the trend, in dB/decade."""
    asymptotic: Estimate
    """Exponent of the rise with the pole removed, in dB/decade."""

    fits: bool
    """False if the model with a free exponent leaves residuals that are not random."""

    def verdict(self, bounds: Bounds) -> Verdict:
        """Return whether the film is first order: an asymptotic slope of 20 dB/decade.

        A model that omits something has no interval that could be trusted: it decides nothing.
        """
        if not self.fits:
            return Verdict("cannot be decided", f"{self.asymptotic.value:.3f} dB/decade, {MISFIT}")
        return equivalence(self.asymptotic, FIRST_ORDER_SLOPE, bounds.slope_dB_decade)


@dataclass(frozen=True)
class PlainFit:
    """Equation (2) as the paper fits it. The result depends on the grid."""

    level_dB: float
    """b of gain = 20 log10 f + b, in dB re 1 V/N."""
    rms_dB: float
    """Root mean square of the gains about that line."""
    slope_dB_decade: float
    """Slope of the straight line of free slope through the same points."""
    points: int
    """Number of points used."""


def slopes(curve: ResponseCurve, fit: FilmFit) -> Slopes | None:
    """Return both slopes with their errors, or None if less than an octave of the band was
    measured."""
    low = max(SLOPE_BAND_HZ[0], float(curve.frequencies[0]))
    high = min(SLOPE_BAND_HZ[1], float(curve.frequencies[-1]))
    if high < NARROWEST_BAND * low:
        return None
    free = fit_film(curve, replace(fit.model, slope_dB_decade=FIRST_ORDER_SLOPE))
    bare = replace(free.model, notches=())
    frequencies, weights = _line_weights(low, high)
    value = float(weights @ (20 * np.log10(np.abs(bare.trend(frequencies)))))
    gradient = DB_PER_RELATIVE * bare.log_jacobian(frequencies).real @ weights
    m = bare.first_notch
    error = math.sqrt(max(float(gradient @ free.covariance[:m, :m] @ gradient), 0.0))
    straight = Estimate.normal(value, error, "dB/decade")
    return Slopes((low, high), straight, free.slope, free.residuals_are_random)


def _line_weights(low: float, high: float) -> tuple[Reals, Reals]:
    """Return frequencies (n,) even over log f, and w (n,) such that w @ gains is the slope of the
    line."""
    decades = np.log10(high / low)
    position = (np.arange(_LINE_POINTS) + 0.5) / _LINE_POINTS - 0.5
    weights = position / (decades * float(position @ position))
    return low * 10 ** (decades * (position + 0.5)), weights


def outside_drops(frequencies: Reals, model: FilmModel) -> NDArray[np.bool_]:
    """Return True for the frequencies (n,) at which the notches attenuate by less than 0.5 dB."""
    outside: NDArray[np.bool_] = np.abs(model.loss_dB(frequencies)) < OUTSIDE_DROPS_DB
    return outside


def plain_fit(curve: ResponseCurve, model: FilmModel) -> PlainFit | None:
    """Fit equation (2) over 2 to 2000 Hz without the notches, all points with equal weight.

    Return None with fewer than two frequencies there.
    """
    f = curve.frequencies
    chosen = (f >= SLOPE_BAND_HZ[0]) & (f <= SLOPE_BAND_HZ[1]) & outside_drops(f, model)
    decades, gains = np.log10(f[chosen]), curve.gains_dB[chosen]
    if np.unique(decades).size < 2:
        return None
    offsets = gains - FIRST_ORDER_SLOPE * decades
    return PlainFit(
        level_dB=float(offsets.mean()),
        rms_dB=float(offsets.std()),
        slope_dB_decade=float(np.polyfit(decades, gains, 1)[0]),
        points=int(chosen.sum()),
    )
