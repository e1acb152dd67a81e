"""Verdicts on a statement such as "the gain does not depend on the load": tests of equivalence.

A measured number never equals the expected one. A test of "equal" therefore fails in the end for
every film, the sooner the better the measurement; and a large chi-square may mean no more than that
the errors of single points are stated too small. The question here is whether the difference is
smaller than a bound that matters to a reader. There are three answers: the whole interval lies
within the bound, it lies outside, or the data cannot decide.

The interval is the 90 % one, which makes two one-sided tests of 5 % each (Schuirmann 1987, the rule
of bioequivalence): a statement that is false at the bound is called true in at most 5 % of the
cases.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from statistics import NormalDist
from typing import Literal

from rig.analysis.estimate import COVERAGE_95, Estimate, decimals

Answer = Literal["holds", "does not hold", "cannot be decided"]

ONE_SIDE = 0.05
"""Probability with which each one-sided test is wrong at the bound."""


@dataclass(frozen=True)
class Bounds:
    """Differences up to which a statement about a film is accepted as true."""

    slope_dB_decade: float = 0.05
    """Largest difference of a slope, over frequency or over load, in dB/decade."""
    gain_dB: float = 0.1
    """Largest difference of a gain, in dB."""


@dataclass(frozen=True)
class Verdict:
    """The answer to a statement about a film, with its reason."""

    answer: Answer
    reason: str
    """What the answer rests on, in words with numbers."""

    def sentence(self, statement: str) -> str:
        """Return the answer as a sentence about ``statement``."""
        data = " by these data" if self.answer == "cannot be decided" else ""
        return f"{statement}: {self.answer}{data} ({self.reason})."


def equivalence(found: Estimate, expected: float, bound: float, chosen_of: int = 1) -> Verdict:
    """Return whether ``found`` differs from ``expected`` by less than ``bound``, all in its unit.

    If ``found`` is the worst of several differences (``chosen_of``), chance alone makes it large:
    it is beyond the bound only if the worst of so many would be so in 5 % of the cases.

    >>> equivalence(Estimate.normal(19.99934, 0.00026, "dB/decade"), 20.0, 0.05).answer
    'holds'
    >>> equivalence(Estimate.normal(19.9, 0.001, "dB/decade"), 20.0, 0.05).answer
    'does not hold'
    >>> equivalence(Estimate.normal(20.0, 0.04, "dB/decade"), 20.0, 0.05).answer
    'cannot be decided'
    """
    low, high = (end - expected for end in _interval(found, ONE_SIDE))
    surely_low, surely_high = (end - expected for end in _interval(found, ONE_SIDE / chosen_of))
    answer: Answer = "cannot be decided"
    if -bound < low and high < bound:
        answer = "holds"
    elif surely_low >= bound or surely_high <= -bound:
        answer = "does not hold"
    compared = {
        "holds": "within",
        "does not hold": "beyond",
        "cannot be decided": "neither surely within nor beyond",
    }[answer]
    numbers = [found.value - expected, low, high]
    if math.isfinite(high - low) and high > low:
        digits = decimals((high - low) / 2)
        difference, low_end, high_end = (f"{number:+.{digits}f}" for number in numbers)
    else:
        difference, low_end, high_end = (f"{number:+.2g}" for number in numbers)
    differs = "differs by " if expected else ""
    return Verdict(
        answer,
        f"{differs}{difference} {found.unit}, 90 %: {low_end} to {high_end}; {compared} ±{bound:g}",
    )


def _interval(found: Estimate, one_side: float) -> tuple[float, float]:
    """Return the interval beyond each end of which the truth lies with probability
    ``one_side``."""
    scale = NormalDist().inv_cdf(1 - one_side) / COVERAGE_95
    low = found.value - scale * (found.value - found.low)
    return low, found.value + scale * (found.high - found.value)


def all_of(verdicts: Iterable[Verdict]) -> Verdict:
    """Return the verdict on a statement that is true if all of its parts are: the worst of them.

    >>> parts = (Verdict("holds", "slope"), Verdict("cannot be decided", "gain at 10 N"))
    >>> all_of(parts).sentence("The gain does not depend on the load")
    'The gain does not depend on the load: cannot be decided by these data (gain at 10 N).'
    """
    parts = list(verdicts)
    for answer in ("does not hold", "cannot be decided"):
        found = [part.reason for part in parts if part.answer == answer]
        if found:
            return Verdict(answer, "; ".join(found))
    return Verdict("holds", "; ".join(part.reason for part in parts))
