"""Linearity of a film: gain against load at each frequency, and distortion over the sweep.

The paper's second kind of data has several loads at each frequency. Its statement "gain has a
linear relation for the load" (3.2, data2 (i)) is read as: voltage is proportional to load, so the
gain does not depend on the load. The characteristic number is the slope of the gain in dB per
decade of load: zero for a linear film, +20 for a quadratic one.

All gains are fitted together: one mean for each frequency, which the film's response cannot
disturb, one slope over load, and one effect of the preload where it is known. A second fit has a
level for each load in place of the slope, so that a dependence which is not a straight line over
log load is found as well. The verdict tests both for equivalence (`rig.analysis.verdict`); the
chi-square only says whether the errors of single points are right, and enlarges them if not.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.analysis.chi_square import probability_above
from rig.analysis.estimate import Estimate
from rig.analysis.film.fit import MISFIT_PROBABILITY
from rig.analysis.response.complex_response import Reals
from rig.analysis.response.curve import CurveError, ResponseCurve
from rig.analysis.scatter import explaining_error
from rig.analysis.verdict import Bounds, Verdict, all_of, equivalence

LEAST_LOAD_RATIO = 1.5
"""Minimum ratio of largest to smallest load at a frequency at which the slope is computed."""
SAME_LOAD_DECADES = 0.05
"""Loads that differ by less than this, in decades (12 %), are one level: a load is held to 1 %."""
FALSE_ALARM = 0.05
"""Probability with which any of all frequencies is named although its gain does not depend on the
load."""


@dataclass(frozen=True)
class LoadDifference:
    """Difference of the mean gains under two loads."""

    gain: Estimate
    """Mean gain under the second load less that under the first, in dB."""
    loads_N: tuple[float, float]
    """The two loads, peak, in N."""


@dataclass(frozen=True, eq=False)
class LoadLinearity:
    """Gain against load, at every frequency with several loads and over all of them."""

    frequencies: Reals
    """Frequencies, in Hz, (k,)."""
    slopes: Reals
    """Slopes of the gain, in dB per decade of load, (k,), without the effect of the preload."""
    slope_errors: Reals
    """Standard errors of the slopes, (k,)."""
    worst_deviations: Reals
    """Largest distance of a gain from the weighted mean at its frequency, in dB, (k,)."""
    slope: Estimate
    """Slope common to all frequencies, in dB per decade of load."""
    differences: tuple[LoadDifference, ...]
    """Differences of the mean gains under each two loads."""
    preload_effect: Estimate | None
    """Change of the gain with the preload, in dB/N; None if the preloads are unknown."""
    chi_square: float
    """Chi-square of the fit with one slope, with the stated errors."""
    degrees: int
    """Degrees of freedom of this chi-square."""
    model_error_dB: float
    """Error of every point beyond its stated one that the scatter demands; all intervals include
    it."""

    @property
    def probability(self) -> float:
        """Probability of a chi-square at least this large if the stated errors are right and the
        gain depends on the load by one slope at most."""
        return probability_above(self.chi_square, self.degrees)

    @property
    def largest(self) -> LoadDifference:
        """Difference with the largest value. Of several that are poorly known one may be large by
        chance: its interval is that of a single difference."""
        return max(self.differences, key=lambda one: abs(one.gain.value))

    @property
    def largest_difference(self) -> Estimate:
        """Difference of the mean gains under the two loads for which its value is largest, in
        dB."""
        return self.largest.gain

    @property
    def differing_loads_N(self) -> tuple[float, float]:  # noqa: N802
        """These two loads, peak: the difference is that of the second less that of the first."""
        return self.largest.loads_N

    @property
    def worst_deviation_dB(self) -> float:  # noqa: N802
        """Largest of all deviations, in dB."""
        return float(self.worst_deviations.max())

    @property
    def worst_frequency_Hz(self) -> float:  # noqa: N802
        """Frequency of the largest deviation, in Hz."""
        return float(self.frequencies[int(np.argmax(self.worst_deviations))])

    def beyond(self, bounds: Bounds) -> NDArray[np.bool_]:
        """Return an array (k,), True for the frequencies whose own slope is significantly beyond
        the bound."""
        sigmas = NormalDist().inv_cdf(1 - FALSE_ALARM / self.frequencies.size)
        surely: NDArray[np.bool_] = (
            np.abs(self.slopes) - sigmas * self.slope_errors > bounds.slope_dB_decade
        )
        return surely

    def verdict(self, bounds: Bounds) -> Verdict:
        """Return whether the gain is independent of the load, within the bounds."""
        parts = [equivalence(self.slope, 0.0, bounds.slope_dB_decade), self._levels(bounds)]
        if (surely := self.beyond(bounds)).any():
            worst = int(np.argmax(np.where(surely, np.abs(self.slopes), 0.0)))
            where = f"{self.slopes[worst]:+.2g} dB/decade at {self.frequencies[worst]:g} Hz alone"
            parts.append(Verdict("does not hold", where))
        return all_of(parts)

    def _levels(self, bounds: Bounds) -> Verdict:
        """Return whether the mean gains under any two loads are the same, within the bounds: the
        worst answer of all pairs, with the difference among those of this answer that is beyond
        the bound most surely, or else may be largest."""
        judged = [
            (equivalence(one.gain, 0.0, bounds.gain_dB, len(self.differences)), one)
            for one in self.differences
        ]
        answer = all_of(found for found, _ in judged).answer
        size = _least if answer == "does not hold" else _largest
        found, worst = max(
            (pair for pair in judged if pair[0].answer == answer),
            key=lambda pair: size(pair[1].gain),
        )
        low_N, high_N = worst.loads_N
        return Verdict(answer, f"gain under {high_N:.3g} N less {low_N:.3g} N {found.reason}")

    def sentence(self, bounds: Bounds) -> str:
        """Return the result in words."""
        quality = f"χ² = {self.chi_square:.0f} for {self.degrees} d.o.f."
        if self.probability < MISFIT_PROBABILITY:
            quality += (
                f": the points scatter more than their errors, by {self.model_error_dB:.2g} dB "
                "each, which all intervals include"
            )
        return (
            f"{self.verdict(bounds).sentence('The gain does not depend on the load')} Measured "
            f"slope {self.slope} of load over {self.frequencies.size} frequencies; largest "
            f"deviation of a single point {self.worst_deviation_dB:.3f} dB, at "
            f"{self.worst_frequency_Hz:g} Hz ({quality})."
        )


@dataclass(frozen=True)
class DistortionSummary:
    """Harmonic distortion of load and film over a sweep, as fractions of the tone."""

    median_load: float
    """Median over the frequencies of the load's distortion."""
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
        """Return the result in words."""
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
    preloads: ArrayLike | None = None,
    preload_errors: ArrayLike | None = None,
) -> LoadLinearity | None:
    """Return gain against load: arrays as in :meth:`ResponseCurve.of`, ``loads`` (n,) peak in N.

    Return None if at no frequency the loads differ by half or more. Raises CurveError for loads
    that are not positive or not as many as frequencies.
    """
    load = np.asarray(loads, dtype=float)
    frequency = np.asarray(frequencies, dtype=float)
    if load.shape != frequency.shape:
        raise CurveError(f"loads: {load.size} values for {frequency.size} frequencies")
    if not (np.isfinite(load) & (load > 0)).all():
        raise CurveError("loads: a value is not above 0 N")
    curve = ResponseCurve.of(frequencies, responses, covariances, degrees, preloads, preload_errors)
    response = np.asarray(responses, dtype=complex)
    decades = np.log10(load)[np.lexsort((response.imag, response.real, frequency))]
    _, group = np.unique(curve.frequencies, return_inverse=True)
    spans = np.array([np.ptp(decades[group == k]) for k in range(group.max() + 1)])
    chosen = (spans >= math.log10(LEAST_LOAD_RATIO))[group]
    return _over_all(curve.at(chosen), decades[chosen]) if chosen.any() else None


def distortion_summary(
    frequencies: ArrayLike, load_distortion: ArrayLike, film_distortion: ArrayLike
) -> DistortionSummary | None:
    """Return median and worst distortion of load and film, or None if either was never measured.

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


@dataclass(frozen=True, eq=False)
class _Gains:
    """Gains with the frequency of each, for fits with a free mean at each frequency."""

    group: NDArray[np.intp]
    """Number of the frequency of each point, (n,)."""
    gains: Reals
    """Gains in dB, (n,)."""
    variances: Reals
    """Variances of the values, (n,)."""

    def about_means(self, values: Reals) -> Reals:
        """Return values (..., n) without the weighted mean of each frequency."""
        weight = 1 / self.variances
        total = np.bincount(self.group, weight)
        rows = np.atleast_2d(values)
        means = np.array([np.bincount(self.group, weight * row) / total for row in rows])
        left: Reals = (rows - means[:, self.group]).reshape(values.shape)
        return left

    def fitted(self, columns: Reals) -> tuple[Reals, Reals, Reals]:
        """Return the coefficients (m,) of the columns (m, n), their covariance (m, m) and the
        residuals (n,)."""
        white = self.about_means(columns) / np.sqrt(self.variances)
        gains = self.about_means(self.gains)
        covariance: Reals = np.asarray(np.linalg.pinv(white @ white.T, hermitian=True), float)
        found = covariance @ (white @ (gains / np.sqrt(self.variances)))
        return found, covariance, gains - found @ self.about_means(columns)


def _over_all(curve: ResponseCurve, decades: Reals) -> LoadLinearity:
    """Fit the gains of a curve, each under the load 10^decades N (n,)."""
    frequency, group = np.unique(curve.frequencies, return_inverse=True)
    preloads = [] if curve.preload_excess is None else [curve.preload_excess.real]
    columns = np.array([decades, *preloads])
    stated = _Gains(group, curve.gains_dB, curve.gain_errors_dB**2)
    if preloads and curve.preload_errors_N is not None:
        # How much the error of a preload matters is known once its effect is.
        effect = stated.fitted(columns)[0][1]
        variances = stated.variances + (effect * curve.preload_errors_N) ** 2
        stated = _Gains(group, stated.gains, variances)
    _, _, residual = stated.fitted(columns)
    degrees = len(curve) - frequency.size - len(columns)
    extra = explaining_error(residual, stated.variances, max(degrees, 1))
    gains = _Gains(group, stated.gains, stated.variances + extra**2)
    found, covariance, _ = gains.fitted(columns)
    errors = np.sqrt(np.diag(covariance))
    bare = gains.gains - sum((c * column for c, column in zip(found[1:], preloads, strict=True)))
    slopes, slope_errors = _slopes_alone(gains, decades, bare)
    deviations = np.abs(gains.about_means(bare))
    return LoadLinearity(
        frequencies=frequency,
        slopes=slopes,
        slope_errors=slope_errors,
        worst_deviations=np.array([deviations[group == k].max() for k in range(frequency.size)]),
        slope=Estimate.normal(float(found[0]), float(errors[0]), "dB/decade"),
        differences=tuple(_differences(gains, decades, preloads)),
        preload_effect=Estimate.normal(float(found[1]), float(errors[1]), "dB/N")
        if preloads
        else None,
        chi_square=float((residual**2 / stated.variances).sum()),
        degrees=degrees,
        model_error_dB=extra,
    )


def _slopes_alone(gains: _Gains, decades: Reals, bare: Reals) -> tuple[Reals, Reals]:
    """Return the slope at each frequency of gains ``bare`` (n,), and its standard error."""
    lever, weight = gains.about_means(decades), 1 / gains.variances
    power = np.bincount(gains.group, weight * lever**2)
    slopes: Reals = np.bincount(gains.group, weight * lever * bare) / power
    errors: Reals = 1 / np.sqrt(power)
    return slopes, errors


def _differences(gains: _Gains, decades: Reals, preloads: list[Reals]) -> Iterator[LoadDifference]:
    """Yield the difference of the mean gains under each two loads, the smaller one first."""
    order = np.argsort(decades)
    steps = np.diff(decades[order]) > SAME_LOAD_DECADES
    level = np.empty(decades.size, dtype=int)
    level[order] = np.concatenate([[0], np.cumsum(steps)])
    count = int(level.max()) + 1
    members = np.array([(level == k).astype(float) for k in range(1, count)])
    found, covariance, _ = gains.fitted(np.array([*members, *preloads]))
    mean = np.concatenate([[0.0], found[: count - 1]])  # relative to the smallest load
    spread = np.zeros((count, count))
    spread[1:, 1:] = covariance[: count - 1, : count - 1]
    loads_N = [float(10 ** decades[level == k].mean()) for k in range(count)]

    for a, b in combinations(range(count), 2):
        variance = spread[a, a] + spread[b, b] - 2 * spread[a, b]
        error_dB = math.sqrt(max(variance, 0.0))
        gain = Estimate.normal(float(mean[b] - mean[a]), error_dB, "dB")
        yield LoadDifference(gain, (loads_N[a], loads_N[b]))


def _largest(difference: Estimate) -> float:
    """Return the largest size that a difference may have."""
    return max(abs(difference.low), abs(difference.high))


def _least(difference: Estimate) -> float:
    """Return the least size that a difference may have, below 0 where it may have either sign."""
    return max(difference.low, -difference.high)
