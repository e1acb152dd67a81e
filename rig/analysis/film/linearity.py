"""Linearity of a film: gain against load at each frequency, and distortion over the sweep.

The paper's second kind of data has several loads at each frequency. Its statement "gain has a
linear relation for the load" (3.2, data2 (i)) is read as: voltage is proportional to load, so the
gain does not depend on the load. The characteristic number is the slope of the gain in dB per
decade of load: zero for a linear film, +20 for a quadratic one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rig.analysis.chi_square import probability_above
from rig.analysis.estimate import Estimate
from rig.analysis.film.fit import MISFIT_PROBABILITY
from rig.analysis.response.complex_response import Reals
from rig.analysis.response.curve import CurveError, ResponseCurve

LEAST_LOAD_RATIO = 1.5
"""Least ratio of largest to smallest load at a frequency at which the slope is computed."""


@dataclass(frozen=True, eq=False)
class LoadLinearity:
    """Gain against load, at every frequency with several loads and over all of them."""

    frequencies: Reals
    """Frequencies, in Hz, (k,)."""
    slopes: Reals
    """Slopes of the gain, in dB per decade of load, (k,)."""
    slope_errors: Reals
    """Standard errors of the slopes, (k,)."""
    worst_deviations: Reals
    """Largest distance of a gain from the weighted mean at its frequency, in dB, (k,)."""
    slope: Estimate
    """Weighted mean of the slopes, in dB per decade of load."""
    worst_deviation_dB: float
    """Largest of all deviations, in dB."""
    worst_frequency_Hz: float
    """Frequency of the largest deviation."""
    chi_square: float
    """Chi-square of one gain for all loads at each frequency."""
    degrees: int
    """Degrees of freedom of this chi-square."""

    @property
    def probability(self) -> float:
        """Probability of a chi-square at least this large if the film is linear and the stated
        errors are right."""
        return probability_above(self.chi_square, self.degrees)

    def sentence(self) -> str:
        """Returns the result in words."""
        linear = self.probability >= MISFIT_PROBABILITY
        if linear:
            verdict = "The gain does not depend on the load within its errors"
        elif self.slope.covers(0.0):
            verdict = "No common dependence on load, but the loads scatter more than their errors"
        else:
            verdict = "The gain depends on the load"
        return (
            f"{verdict} (χ² = {self.chi_square:.0f} for {self.degrees} d.o.f.): {self.slope} of "
            f"load over {self.frequencies.size} frequencies; worst deviation "
            f"{self.worst_deviation_dB:.3f} dB at {self.worst_frequency_Hz:g} Hz."
        )


@dataclass(frozen=True)
class DistortionSummary:
    """Harmonic distortion of load and film over a sweep, as fractions of the tone."""

    median_load: float
    """Median distortion of the load."""
    worst_load: float
    """Largest distortion of the load."""
    worst_load_Hz: float
    """Frequency of the largest distortion of the load."""
    median_film: float
    """Median distortion of the film's voltage."""
    worst_film: float
    """Largest distortion of the film's voltage."""
    worst_film_Hz: float
    """Frequency of the largest distortion of the film's voltage."""

    def sentence(self) -> str:
        """Returns the result in words."""
        return (
            f"Harmonic distortion: load {self.median_load:.2%} (worst {self.worst_load:.2%} at "
            f"{self.worst_load_Hz:g} Hz), film {self.median_film:.2%} (worst {self.worst_film:.2%} "
            f"at {self.worst_film_Hz:g} Hz); these figures include noise."
        )


def load_linearity(
    frequencies: ArrayLike,
    responses: ArrayLike,
    covariances: ArrayLike,
    loads: ArrayLike,
    degrees: ArrayLike | None = None,
) -> LoadLinearity | None:
    """Returns gain against load: arrays as in :meth:`ResponseCurve.of`, ``loads`` (n,) peak in N.

    Returns None if at no frequency the loads differ by half or more. Raises CurveError for loads
    that are not positive or not as many as frequencies.
    """
    load = np.asarray(loads, dtype=float)
    frequency = np.asarray(frequencies, dtype=float)
    if load.shape != frequency.shape:
        raise CurveError(f"loads: {load.size} values for {frequency.size} frequencies")
    if not (np.isfinite(load) & (load > 0)).all():
        raise CurveError("loads: a value is not above 0 N")
    curve = ResponseCurve.of(frequencies, responses, covariances, degrees)
    response = np.asarray(responses, dtype=complex)
    decades = np.log10(load)[np.lexsort((response.imag, response.real, frequency))]
    rows = []
    for at in np.unique(curve.frequencies):
        chosen = curve.frequencies == at
        if np.ptp(decades[chosen]) >= math.log10(LEAST_LOAD_RATIO):
            rows.append(
                (
                    float(at),
                    *_line(decades[chosen], curve.gains_dB[chosen], curve.gain_errors_dB[chosen]),
                    int(chosen.sum()) - 1,
                )
            )
    return _over_all(np.array(rows)) if rows else None


def distortion_summary(
    frequencies: ArrayLike, load_distortion: ArrayLike, film_distortion: ArrayLike
) -> DistortionSummary | None:
    """Returns median and worst distortion of load and film, or None if either was never measured.

    Distortions (n,) are NaN where they were not measured.
    """
    frequency = np.asarray(frequencies, dtype=float)
    found: list[float] = []
    for values in (load_distortion, film_distortion):
        distortion = np.asarray(values, dtype=float)
        measured = np.isfinite(distortion)
        if not measured.any():
            return None
        worst = int(np.nanargmax(distortion))
        found += [
            float(np.median(distortion[measured])),
            float(distortion[worst]),
            float(frequency[worst]),
        ]
    return DistortionSummary(*found)


def _line(decades: Reals, gains: Reals, errors: Reals) -> tuple[float, float, float, float]:
    """Returns slope, its error, largest distance from the weighted mean, and chi-square about that
    mean."""
    weight = 1 / errors**2
    mean = float(np.average(gains, weights=weight))
    lever = decades - np.average(decades, weights=weight)
    power = float(weight @ lever**2)
    slope = float(weight @ (lever * gains)) / power
    return (
        slope,
        1 / math.sqrt(power),
        float(np.abs(gains - mean).max()),
        float(weight @ np.square(gains - mean)),
    )


def _over_all(rows: Reals) -> LoadLinearity:
    """Summarises rows of frequency, slope, error, deviation, chi-square and degrees of freedom."""
    frequency, slopes, errors, deviations, squares, degrees = rows.T
    weight = 1 / errors**2
    worst = int(np.argmax(deviations))
    mean = float(np.average(slopes, weights=weight))
    return LoadLinearity(
        frequencies=frequency,
        slopes=slopes,
        slope_errors=errors,
        worst_deviations=deviations,
        slope=Estimate.normal(mean, float(1 / np.sqrt(weight.sum())), "dB/decade"),
        worst_deviation_dB=float(deviations[worst]),
        worst_frequency_Hz=float(frequency[worst]),
        chi_square=float(squares.sum()),
        degrees=int(degrees.sum()),
    )
