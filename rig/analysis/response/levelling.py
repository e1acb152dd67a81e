"""Holding a sinusoidal load constant over frequency: what to drive with, how long to measure.

What the vibrator makes of a volt is learned as the sweep goes: the drive for the next frequency is
foretold from those measured nearby, so that most points are right at the first attempt. How long a
record has to be follows from the noise of the records before it. Pure functions and a small memory;
nothing here touches an instrument.
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
"""Within this ratio of a frequency that has been measured, a prediction is trusted."""

CLOSEST_KNOTS = 0.01
"""Frequencies that differ by less (natural logarithm) are one to the prediction: their noise would
be magnified."""

MAX_EXTRAPOLATION_RATIO = 2.0
"""How far beyond the power gains that it is made from a prediction is believed."""

NEGLIGIBLE_INFLATION = 1.1
"""Inflation of the variance that is not worth a longer record."""

FOLLOWING_A_LINE = 0.6
"""Share of the spare variance that is planned with: finding a line's frequency costs the rest."""

SEPARABLE = 0.5
"""Beats between a line and the tone that the longest record has to hold to be worth while."""

GROWTH = 1.2
"""Step of a record's length in the search for one that separates the mains."""


class LearnedGain:
    """Gain against frequency as measured so far: positive values, foretold on log-log axes."""

    def __init__(self) -> None:
        self._log_f: list[float] = []
        self._log_gain: dict[float, float] = {}

    def learn(self, frequency_Hz: float, gain: float) -> None:
        """A measured gain; the latest one at a frequency counts."""
        x = math.log(frequency_Hz)
        if x not in self._log_gain:
            insort(self._log_f, x)
        self._log_gain[x] = math.log(gain)

    def near(self, frequency_Hz: float) -> bool:
        """Whether something close by has been measured."""
        x = math.log(frequency_Hz)
        return any(abs(x - known) <= math.log(NEAR) for known in self._nearest(x, 1))

    def at(self, frequency_Hz: float) -> float | None:
        """The foretold gain, None where nothing has been measured.

        1 / gain^2 of anything that resonates without a zero nearby is a polynomial in f^2, so a
        parabola in f^2 through the three nearest foretells it, also one step beyond them. Where
        they are too far away or too close to each other for that, the nearest itself.
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
        foretold = _lagrange(squares, inverse, 1.0)
        if (
            not min(inverse) / MAX_EXTRAPOLATION_RATIO
            < foretold
            < max(inverse) * MAX_EXTRAPOLATION_RATIO
        ):
            return math.exp(self._log_gain[used[0]])
        return 1 / math.sqrt(foretold)

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
    """What the length of a record depends on, apart from frequency and rate."""

    shortest_s: float
    longest_s: float
    target_dB: float
    """Standard error of the gain to be reached."""
    error_of_one_second_dB: float | None
    """Standard error of the gain from one second, no line fitted beside; None if not known yet."""


def record_samples(
    frequency: float, rate: float, needs: RecordNeeds, lines: Sequence[float]
) -> int:
    """Samples in whole cycles that reach the target with the mains lines fitted beside the tone.

    One cycle, or the shortest record, where the noise is not known yet.
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
    """What fitting lines may cost in variance for the target still to be met."""
    error = needs.error_of_one_second_dB
    if not error:
        return NEGLIGIBLE_INFLATION
    return max(NEGLIGIBLE_INFLATION, 1.5 * needs.target_dB**2 * duration_s / error**2)


class LearnedMains:
    """How strong each mains line was seen in a channel: one that is weak need not be fitted."""

    def __init__(self) -> None:
        self._most: dict[int, float] = {}

    def learn(self, fit: SineFit, nominal: float) -> None:
        """What a fit says of its lines, the tone itself if it is one of them: amplitude with twice
        its error; the least seen counts."""
        seen = list(zip(fit.fitted_Hz, fit.line_amplitudes, fit.line_errors, strict=True))
        if fit.frequency_Hz == nominal:
            seen.append((nominal, fit.amplitude, fit.standard_error))
        for line, amplitude, error in seen:
            order = round(line / nominal)
            most = amplitude + 2 * error
            self._most[order] = min(self._most.get(order, math.inf), most)

    def strong(self, nominal: float, count: int, harmless: float) -> list[float]:
        """The lines that are not known to be below ``harmless``, in Hz."""
        orders = range(1, count + 1)
        return [k * nominal for k in orders if self._most.get(k, math.inf) > harmless]


def agreement(first: Response, second: Response, tolerance: float) -> float:
    """Difference up to which two responses agree: a relative tolerance, and their noise."""
    noise = math.sqrt(float(np.trace(first.covariance + second.covariance)))
    return tolerance * abs(second.value) + AGREEMENT_SIGMAS * noise


AGREEMENT_SIGMAS = 2.5


def combined(responses: Sequence[Response]) -> Response:
    """Mean of responses at one frequency, each weighted by its own precision."""
    if len(responses) == 1:
        return responses[0]
    tiny = np.finfo(float).tiny
    weights = np.array([1 / max(float(np.trace(r.covariance)), tiny) for r in responses])
    weights = weights / weights.sum()
    value = complex(sum(w * r.value for w, r in zip(weights, responses, strict=True)))
    covariance = sum(w**2 * r.covariance for w, r in zip(weights, responses, strict=True))
    known = [r.coherence for r in responses if math.isfinite(r.coherence)]
    coherence = float(np.mean(known)) if known else math.nan
    return Response(responses[0].frequency_Hz, value, np.asarray(covariance), coherence)


def range_for(amplitude_V: float, ranges_V: Sequence[float], margin: float = 1.6) -> float:
    """The smallest input range that holds an amplitude with a margin, else the largest."""
    fitting = [r for r in ranges_V if r >= margin * amplitude_V]
    return min(fitting) if fitting else max(ranges_V)
