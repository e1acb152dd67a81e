"""Keeps a sinusoidal load constant over frequency: chooses the drive voltage and the length of
records.

The gain of the vibrator is learned during the sweep. The drive for the next frequency is predicted
from those measured nearby, so that most points are right at the first attempt. The required length
of a record follows from the noise of the records before it. Pure functions and a small memory; no
instrument is used here.
"""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rig.analysis.response.complex_response import Response
from rig.analysis.response.sine_fit import SineFit, inflation, whole_cycles

NEAR = 1.35
"""Ratio to a measured frequency within which a prediction is trusted."""

CLOSEST_KNOTS = 0.01
"""Minimum distance in ln f of the frequencies used for a prediction: closer ones would amplify
noise."""

MAX_EXTRAPOLATION_RATIO = 2.0
"""Largest ratio by which a predicted power gain may lie outside those that it is computed from."""

NEGLIGIBLE_INFLATION = 1.1
"""Inflation of the variance that does not justify a longer record."""

FOLLOWING_A_LINE = 0.6
"""Share of the spare variance that is used for fitting a line; finding its frequency costs the
rest."""

SEPARABLE = 0.5
"""Beats between a line and the tone that the longest record must contain for the line to be
separated."""

GROWTH = 1.2
"""Step of the record length in the search for one that separates the mains."""


class LearnedGain:
    """Gain against frequency as measured so far; positive values, predicted on log-log axes.

    >>> gain = LearnedGain()
    >>> gain.learn(100.0, 2.0)
    >>> round(gain.at(105.0), 6), gain.near(105.0), gain.near(200.0)
    (2.0, True, False)
    """

    def __init__(self) -> None:
        self._log_f: list[float] = []
        self._log_gain: dict[float, float] = {}

    def learn(self, frequency_Hz: float, gain: float) -> None:
        """Add a measured gain; it replaces an earlier one at the same frequency."""
        x = math.log(frequency_Hz)
        if x not in self._log_gain:
            insort(self._log_f, x)
        self._log_gain[x] = math.log(gain)

    def near(self, frequency_Hz: float) -> bool:
        """Return whether a frequency near this one has been measured."""
        x = math.log(frequency_Hz)
        return any(abs(x - known) <= math.log(NEAR) for known in self._nearest(x, 1))

    def at(self, frequency_Hz: float) -> float | None:
        """Return the predicted gain in the unit of those learned, or None if nothing has been
        measured.

        1 / gain² of anything that resonates without a zero nearby is a polynomial in f². A parabola
        in f² through the three nearest points therefore predicts the gain, also one step beyond
        them. If they are too far away or too close to each other, the nearest gain itself is
        returned.
        """
        x = math.log(frequency_Hz)
        knots: list[float] = []
        for known in self._nearest(x, 6):
            if abs(known - x) <= 3 * math.log(NEAR) and all(
                abs(known - other) > CLOSEST_KNOTS for other in knots
            ):
                knots.append(known)
        if not knots:
            nearest = self._nearest(x, 1)
            return math.exp(self._log_gain[nearest[0]]) if nearest else None
        used = knots[:3]
        squares = [math.exp(2 * (known - x)) for known in used]
        inverse = [math.exp(-2 * self._log_gain[known]) for known in used]
        predicted = _lagrange(squares, inverse, 1.0)
        if (
            not min(inverse) / MAX_EXTRAPOLATION_RATIO
            < predicted
            < max(inverse) * MAX_EXTRAPOLATION_RATIO
        ):
            return math.exp(self._log_gain[used[0]])
        return 1 / math.sqrt(predicted)

    def _nearest(self, x: float, count: int) -> list[float]:
        at = bisect_left(self._log_f, x)
        around = self._log_f[max(0, at - count) : at + count]
        return sorted(around, key=lambda known: abs(known - x))[:count]


def _lagrange(knots: Sequence[float], values: Sequence[float], x: float) -> float:
    total = 0.0
    for i, own in enumerate(knots):
        others = [(x - other) / (own - other) for j, other in enumerate(knots) if j != i]
        total += values[i] * math.prod(others)
    return total


@dataclass(frozen=True)
class RecordNeeds:
    """Requirements on the length of a record, apart from frequency and rate."""

    shortest_s: float
    """Length below which no record is taken, in s."""
    longest_s: float
    """Length that no record exceeds, in s, even if `target_dB` is not reached."""
    target_dB: float
    """Standard error of the gain to be reached."""
    error_of_one_second_dB: float | None
    """Standard error of the gain from one second without any fitted line; None if not known yet."""


def record_samples(
    frequency: float, rate: float, needs: RecordNeeds, lines: Sequence[float]
) -> int:
    """Return the samples of whole cycles that reach the target with the mains lines fitted.

    If the noise is not known yet it is one cycle or the shortest record.
    """
    error = needs.error_of_one_second_dB
    wanted = needs.shortest_s
    if error is not None:
        wanted = max(wanted, (error / needs.target_dB) ** 2)
    n = whole_cycles(frequency, rate, min(wanted, needs.longest_s))
    hopeless = SEPARABLE / needs.longest_s
    near = [line for line in lines if hopeless < abs(line - frequency) < 3.0 * rate / n]
    while near and n / rate < needs.longest_s:
        cost = inflation(frequency, rate, n, near)
        affordable = NEGLIGIBLE_INFLATION
        if error is not None:
            spare = needs.target_dB**2 * (n / rate) / error**2
            affordable = max(affordable, FOLLOWING_A_LINE * spare)
        if cost <= affordable:
            break
        n = whole_cycles(frequency, rate, GROWTH * n / rate)
    return n


def affordable_inflation(needs: RecordNeeds, duration_s: float) -> float:
    """Return the factor by which fitting lines may enlarge the variance of a gain from a record of
    `duration_s`, so that the target of `needs` is still met."""
    error = needs.error_of_one_second_dB
    if not error:
        return NEGLIGIBLE_INFLATION
    return max(NEGLIGIBLE_INFLATION, 1.5 * needs.target_dB**2 * duration_s / error**2)


class LearnedMains:
    """Strength of each mains line in a channel as measured so far. A weak line need not be
    fitted."""

    def __init__(self) -> None:
        self._most: dict[int, float] = {}

    def learn(self, fit: SineFit, nominal: float) -> None:
        """Add the lines of a fit, and the tone itself if it is a mains line.

        The bound of a line is its amplitude plus twice its error. The lowest bound so far is used.
        """
        seen = list(zip(fit.fitted_Hz, fit.line_amplitudes, fit.line_errors, strict=True))
        if fit.frequency_Hz == nominal:
            seen.append((nominal, fit.amplitude, fit.standard_error))
        for line, amplitude, error in seen:
            order = round(line / nominal)
            most = amplitude + 2 * error
            self._most[order] = min(self._most.get(order, math.inf), most)

    def bounds(self, nominal: float, count: int) -> dict[float, float]:
        """Return the largest amplitude of each line that has been measured, by its frequency in
        Hz."""
        orders = range(1, count + 1)
        return {k * nominal: self._most[k] for k in orders if k in self._most}

    def strong(self, nominal: float, count: int, harmless: float) -> list[float]:
        """Return the lines in Hz that are not known to be below ``harmless``."""
        orders = range(1, count + 1)
        return [k * nominal for k in orders if self._most.get(k, math.inf) > harmless]


def agreement(
    first: Response, second: Response, tolerance: float, samples: tuple[int, int]
) -> float:
    """Return the largest difference, in the unit of the responses, up to which the two agree: a
    relative tolerance plus their noise.

    ``samples`` are the lengths of their records. The noise by sample is that of the quieter record:
    ringing also enlarges a record's own error, and would otherwise hide itself.
    """
    variances = [float(np.trace(each.covariance)) for each in (first, second)]
    noise = quieter_noise(variances, samples)
    return tolerance * abs(second.value) + AGREEMENT_SIGMAS * noise


def quieter_noise(variances: Sequence[float], samples: Sequence[int]) -> float:
    """Return the standard deviation of the difference of two estimates, if both records have the
    noise by sample of the quieter one.

    >>> quieter_noise([0.5, 1.0], [100, 100])
    1.0
    """
    by_sample = min(variance * n for variance, n in zip(variances, samples, strict=True))
    return math.sqrt(by_sample * sum(1 / n for n in samples))


AGREEMENT_SIGMAS = 2.5
"""Standard errors by which responses that agree may differ."""


def combined(responses: Sequence[Response]) -> Response:
    """Return the mean of responses at one frequency, each weighted by its own precision."""
    if len(responses) == 1:
        return responses[0]
    # A noise-free response has a covariance of zero: tiny keeps its weight finite.
    tiny = np.finfo(float).tiny
    weights = np.array([1 / max(float(np.trace(r.covariance)), tiny) for r in responses])
    weights = weights / weights.sum()
    value = complex(sum(w * r.value for w, r in zip(weights, responses, strict=True)))
    covariance, leakage = (
        np.asarray(sum(w**2 * part for w, part in zip(weights, parts, strict=True)))
        for parts in ([r.covariance for r in responses], [r.leakage for r in responses])
    )
    known = [r.coherence for r in responses if math.isfinite(r.coherence)]
    coherence = float(np.mean(known)) if known else math.nan
    return Response(responses[0].frequency_Hz, value, covariance, coherence, leakage)


def range_for(amplitude_V: float, ranges_V: Sequence[float], margin: float = 1.6) -> float:
    """Return the smallest input range in V that holds an amplitude with a margin, or else the
    largest.

    >>> range_for(0.7, [0.1, 1.0, 1.25, 10.0])
    1.25
    """
    fitting = [r for r in ranges_V if r >= margin * amplitude_V]
    return min(fitting) if fitting else max(ranges_V)
