"""Friction coefficients of a slide at constant normal force, from F_t and F_n at 1 kHz or less.

    static   the largest F_t/F_n on the way to gross slip
    kinetic  F_t/F_n in steady sliding afterwards

*Meaning of the static coefficient.* A skin slips ridge by ridge. When F_t is largest, most of the
skin has already slipped and rubs with the kinetic coefficient. The whole contact therefore shows

    static = μ_k + W (μ_s - μ_k),     0 < W <= 1

μ_s is what a point of the surface bears before it slips. W is the share of the normal force on what
has not yet weakened, each point by its own exp(-D/D_c). Only a contact that slips everywhere at
once has W = 1. W depends on the number of ridges that carry the load, on D_c relative to the
stretch of the skin, and on the speed. F_t and F_n alone show only the product of W and μ_s - μ_k.
`static` is therefore a property of the contact and a lower bound of μ_s, and `point_static` is an
interval: the observed drop, divided by the W of a range of simulated slides (`WEAKENED`).

*Uncertainty.* Kinetic: error of the mean, from the integrated autocorrelation time of the ratio
(Sokal 1997), with Student's t for how well that time is known. Static: a parabola is fitted
to each section of the rise and evaluated at its end, so that the fall behind the peak has no
influence. The bias and scatter of the largest of noisy values come from repeats of the same search
on the smoothed curve with blocks of the noise of the steady part (moving blocks). Errors common to
all samples, from the matrix of the sensor, are not included; those of its zeros are, if they are
given.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.analysis.estimate import COVERAGE_95, Estimate
from rig.core.errors import ExitCode, RigError

Reals = NDArray[np.float64]

WEAKENED = (0.07, 0.24, 0.50)
"""W at the peak: 5, 50 and 95 % of 240 simulated slides of the reference skin (μ_s 0.3-1.2, μ_k/μ_s
0.65-0.97, D_c 1-20 µm, F_n 2-8 N, 0.3-6 mm/s, τ 0.25-1.3 ms). Other skins have other values."""

SETTLED_TRAVEL = 0.25
"""Travel from the peak to steady sliding, as a share of the travel up to the peak."""
SETTLED_mm = 0.05
"""Minimum travel from the peak to steady sliding, in mm: more than twice the weakening distance of
any friction that is modelled."""
STEADY_SAMPLES = 50
"""Minimum number of samples of steady sliding from which a mean is computed."""
STILL_RISING = 0.05
"""Slope at the end of the motion, as a share of the first slope, above which there was no gross
slip."""
NEAR_PEAK = 0.9
"""Share of the peak from which the rise is examined for its shape."""
PEAK_WITHIN = 1.8
"""The peak is searched up to this multiple of the travel at which F_t/F_n came near its largest
value. A later maximum is noise of steady sliding."""
SHAPE = 0.002
"""Relative error of the peak without noise: samples miss it, parabolas are not its shape. Rms over
the simulated slides with which this module was tuned."""
SHORTEST_STRETCH = 4
"""Minimum number of samples of a fitted parabola."""
LONGEST_STRETCH_s = 0.04
"""Longest stretch that a parabola is fitted to, where that is more samples than the fewest."""
REPEATS = 400
BLOCK_s = 0.02
"""Length of a block of noise: longer than the sensor's noise remembers."""
SHORTEST_BLOCK = 4
"""Minimum number of samples of a block of noise."""
WINDOW = 5.0
"""Window of the autocorrelation (Sokal): it is summed up to this multiple of the correlation
time."""


class FrictionError(RigError):
    """Raised when a slide does not determine friction coefficients."""

    code = ExitCode.FINISHED_WITH_FAILURES


@dataclass(frozen=True)
class Friction:
    """Friction coefficients of a slide, without unit."""

    static: Estimate
    """Static coefficient of the whole contact."""
    kinetic: Estimate
    """Kinetic coefficient."""
    point_static: Estimate
    """Static coefficient of a point of the surface: median and interval of W, not of the noise."""
    peak: int
    """Sample at which F_t/F_n is largest."""
    steady: int
    """First sample of steady sliding."""
    independent: float
    """Number of independent samples that the steady part is worth, given its correlation."""


def friction(
    normal_N: ArrayLike,
    tangential_N: ArrayLike,
    travel_mm: ArrayLike,
    zero_error_N: tuple[float, float] = (0.0, 0.0),
    rate_Hz: float = 1000.0,
) -> Friction:
    """Return the coefficients from F_n, F_t and the travel since the slide began, (n,) at
    `rate_Hz`.

    The arrays begin and end with the motion. F_t is positive along the travel: both directions give
    positive coefficients. `zero_error_N` are the standard errors of the zeros of F_n and F_t.

    Raises FrictionError if contact is lost, or if the motion ends before gross slip or soon after
    it.
    """
    travel = np.asarray(travel_mm, dtype=np.float64)
    normal, ratio = _ratio(normal_N, tangential_N, travel)
    travel = np.abs(travel - travel[0])
    rough = _rough_peak(ratio, travel)
    steady = _steady_from(ratio, travel, rough)
    rest = ratio[steady:]
    kinetic, independent = mean_of_correlated(rest)
    stretch = _stretch(ratio, rough, rate_Hz)
    block = max(SHORTEST_BLOCK, round(BLOCK_s * rate_Hz))
    static, peak = _peak(ratio, rough, stretch, rest - rest.mean(), block)
    point = _of_a_point(static, kinetic)
    level = float(normal[max(peak - 5, 0) : peak + 6].mean())
    static = _with_zeros(static, zero_error_N, level)
    kinetic = _with_zeros(kinetic, zero_error_N, float(normal[steady:].mean()))
    # A shift of F_t moves both coefficients alike and their difference not at all.
    point = _with_zeros(point, zero_error_N, level)
    return Friction(static, kinetic, point, peak, steady, independent)


def mean_of_correlated(samples: ArrayLike) -> tuple[Estimate, float]:
    """Return the mean of steady, correlated samples (n,), and how many independent ones it is
    worth.

    The correlation is known from the same samples, so the error is uncertain, too: that of a sum
    over w lags has n / (2 w + 1) degrees of freedom (Madras and Sokal 1988). The interval is
    Student's t with these, and the standard error is its half-width divided by 1.96. Samples are
    never taken to be worth more than independent ones.

    The interval holds the mean of first-order noise in 96 to 99 % of the cases with a memory of 0
    (50 to 770 samples), 92 to 96 % with 0.9; with 0.98 in 82 % (50 samples), 90 % (150) and 95 %
    (770). Noise that remembers as long as the samples last cannot be seen in them.
    """
    from scipy.special import stdtrit

    values = np.asarray(samples, dtype=np.float64)
    n = values.size
    mean = float(values.mean())
    deviations = values - mean
    variance = float(deviations @ deviations) / n
    if variance <= 0:
        return Estimate(mean, 0.0, mean, mean, ""), float(n)
    size = 1 << (2 * n - 1).bit_length()
    power = np.abs(np.fft.rfft(deviations, size)) ** 2
    covariance = np.fft.irfft(power, size)[:n] / np.arange(n, 0, -1)
    times = 1 + 2 * np.cumsum(covariance[1 : n // 2]) / variance
    enough = np.nonzero(np.arange(1, times.size + 1) >= WINDOW * times)[0]
    last = int(enough[0]) if enough.size else times.size - 1
    # The factor corrects for the subtracted mean, which lowers the autocovariance.
    summed = 2 * last + 3
    time = max(float(times[last]) * (1 + summed / n), 1.0)
    independent = max(n / time, 2.0)
    freedom = max(n / summed, 1.0)
    half = float(stdtrit(freedom, 0.975)) * math.sqrt(variance / (independent - 1))
    return Estimate(mean, half / COVERAGE_95, mean - half, mean + half, ""), independent


def _ratio(normal_N: ArrayLike, tangential_N: ArrayLike, travel: Reals) -> tuple[Reals, Reals]:
    normal = np.asarray(normal_N, dtype=np.float64)
    tangential = np.asarray(tangential_N, dtype=np.float64)
    if not normal.shape == tangential.shape == travel.shape or normal.ndim != 1:
        raise ValueError("normal_N, tangential_N and travel_mm must have the same shape (n,)")
    if normal.size < 2 * STEADY_SAMPLES:
        raise FrictionError(f"{normal.size} samples are too few for a slide")
    if not float(normal.min()) > 0:
        raise FrictionError(
            f"F_n falls to {float(normal.min()):.3g} N during the slide: contact is lost",
            "check the force servo and the alignment of the object",
        )
    direction = 1.0 if travel[-1] >= travel[0] else -1.0
    return normal, direction * tangential / normal


def _least_window(ratio: Reals) -> int:
    return max(3, min(21, ratio.size // 100) | 1)


def _smooth(values: Reals, window: int) -> Reals:
    half = window // 2
    padded = np.pad(values, half, mode="edge")
    smoothed: Reals = np.convolve(padded, np.full(window, 1.0 / window), "valid")
    return smoothed


def _rough_peak(ratio: Reals, travel: Reals) -> int:
    smooth = _smooth(ratio, _least_window(ratio))
    near = int(np.argmax(smooth >= NEAR_PEAK * smooth.max()))
    end = int(np.searchsorted(travel, PEAK_WITHIN * travel[near], "right"))
    return int(smooth[: max(end, near + 1)].argmax())


def _steady_from(ratio: Reals, travel: Reals, peak: int) -> int:
    """Return the first sample of steady sliding."""
    if not travel[-1] > 0:
        raise FrictionError("the object did not move")
    _require_gross_slip(ratio, travel)
    wanted = travel[peak] * (1 + SETTLED_TRAVEL) + SETTLED_mm
    steady = int(np.searchsorted(travel, wanted))
    if ratio.size - steady < STEADY_SAMPLES:
        raise FrictionError(
            f"only {max(ratio.size - steady, 0)} samples of steady sliding, after the peak at "
            f"{travel[peak]:.3g} mm",
            f"slide further: {wanted:.3g} mm and {STEADY_SAMPLES} samples more",
        )
    return steady


def _require_gross_slip(ratio: Reals, travel: Reals) -> None:
    half = int(np.argmax(_smooth(ratio, _least_window(ratio)) > 0.5 * ratio.max()))
    first = _slope(travel[: half + 3], ratio[: half + 3])
    late = travel >= 0.8 * travel[-1]
    last = _slope(travel[late], ratio[late])
    if first > 0 and last > STILL_RISING * first:
        raise FrictionError(
            f"F_t/F_n still rises at the end of the slide, at {100 * last / first:.0f} % of its "
            "first slope: no gross slip",
            "slide further",
        )


def _slope(x: Reals, y: Reals) -> float:
    centred = x - x.mean()
    below = float(centred @ centred)
    return float(centred @ y) / below if below > 0 else 0.0


def _stretch(ratio: Reals, peak: int, rate_Hz: float) -> int:
    """Return the samples of the parabola: half of what the last tenth of the rise takes."""
    below = np.nonzero(ratio[:peak] < NEAR_PEAK * ratio[peak])[0]
    rise = peak - (int(below[-1]) if below.size else 0)
    longest = max(SHORTEST_STRETCH, round(LONGEST_STRETCH_s * rate_Hz))
    return int(np.clip(rise // 2, SHORTEST_STRETCH, longest))


def _end_of_parabola(stretch: int) -> Reals:
    """Return weights, newest last, that give the value of a fitted parabola at its newest
    sample."""
    age = np.arange(stretch, dtype=np.float64)[::-1]
    design = np.column_stack([np.ones(stretch), age, age**2])
    weights: Reals = np.linalg.pinv(design)[0]
    return weights


def _ends(values: Reals, weights: Reals) -> Reals:
    """Return the value of every section at its newest sample, (..., n) to (..., n - stretch +
    1)."""
    stretches = np.lib.stride_tricks.sliding_window_view(values, weights.size, axis=-1)
    ends: Reals = stretches @ weights
    return ends


def _peak(ratio: Reals, rough: int, stretch: int, noise: Reals, block: int) -> tuple[Estimate, int]:
    """Return the peak without what noise adds to a maximum, with its error."""
    weights = _end_of_parabola(stretch)
    first = max(0, rough - 4 * stretch)
    part = ratio[first : rough + 4 * stretch + 1]
    if part.size <= stretch:
        part, first = ratio[: rough + 6 * stretch], 0
    curve = _ends(part, weights)
    found = int(curve.argmax())
    value = float(curve[found])
    smooth = np.concatenate([part[: stretch - 1], curve])
    rng = np.random.default_rng(0)  # the same data always give the same numbers
    repeats = smooth + _blocks_of(noise, block, (REPEATS, smooth.size), rng)
    largest = _ends(repeats, weights).max(axis=-1)
    of_curve = float(_ends(smooth, weights).max())
    bias = float(largest.mean()) - of_curve
    # The bias itself is taken as known to half of its size.
    known = 0.5 * bias
    error = math.hypot(float(largest.std()), known, SHAPE * value)
    return Estimate.normal(value - bias, error, ""), first + stretch - 1 + found


def _blocks_of(noise: Reals, block: int, shape: tuple[int, int], rng: np.random.Generator) -> Reals:
    """Return simulated noise of shape `shape`: random stretches of `block` samples of the measured
    noise, put one after the other, so that its correlation is kept."""
    rows, length = shape
    blocks = -(-length // block)
    starts = rng.integers(0, noise.size - block + 1, (rows, blocks))
    taken: Reals = noise[starts[:, :, None] + np.arange(block)].reshape(rows, -1)[:, :length]
    return taken


def _with_zeros(estimate: Estimate, zero_error_N: tuple[float, float], level_N: float) -> Estimate:
    """Return the estimate with the error of uncertain zeros added."""
    of_normal, of_tangential = zero_error_N
    added = math.hypot(of_tangential, estimate.value * of_normal) / level_N
    low = estimate.value - math.hypot(estimate.value - estimate.low, COVERAGE_95 * added)
    high = estimate.value + math.hypot(estimate.high - estimate.value, COVERAGE_95 * added)
    error = math.hypot(estimate.standard_error, added)
    return Estimate(estimate.value, error, low, high, "")


def _of_a_point(static: Estimate, kinetic: Estimate) -> Estimate:
    """Return μ_s = μ_k + drop / W over the range of W; never below that of the contact."""
    least, median, most = WEAKENED
    drop = max(static.value - kinetic.value, 0.0)
    noise = math.hypot(static.standard_error, kinetic.standard_error)
    high = kinetic.value + (drop + COVERAGE_95 * noise) / least
    low = max(static.low, kinetic.value + max(drop - COVERAGE_95 * noise, 0.0) / most)
    value = kinetic.value + drop / median
    return Estimate(value, (high - low) / (2 * COVERAGE_95), low, high, "")
