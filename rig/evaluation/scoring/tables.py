"""Rates and percentiles of outcomes with 95 % intervals, for all trials and by their conditions."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from rig.analysis.estimate import COVERAGE_95
from rig.evaluation.scoring.outcomes import TrialOutcome

PERCENTILES = (5, 50, 95)
"""Percentiles that are computed of every delay."""
RESAMPLES = 1000
"""Resamples of the bootstrap. The error of an end of its interval is then below a tenth of its
width."""
FEWEST_OF_A_SPREAD = 5
"""Fewest values for which the interval of a percentile is computed."""


@dataclass(frozen=True)
class ScoredNumber:
    """A number computed from `of` cases, with its 95 % interval. Values are NaN where there is
    none."""

    value: float
    """Best estimate."""
    low: float
    """Lower end of the 95 % interval."""
    high: float
    """Upper end of the 95 % interval."""
    of: int
    """Number of cases."""
    unit: str
    """Unit of value and interval; "1" for a rate."""


Score = dict[str, ScoredNumber]
"""Numbers of a group of outcomes, by name. Numbers that cannot occur in the group are omitted."""


@dataclass(frozen=True)
class Group:
    """Outcomes whose trait lies in a bin."""

    trait: str
    """Name of the trait."""
    bin: str
    """The bin in words, for example "0.2 to 0.5"."""
    outcomes: tuple[TrialOutcome, ...]
    """Outcomes in the bin."""


BINS: dict[str, tuple[float, ...]] = {
    "noise_mV": (0.2, 0.5, 1.0),
    "speed_mm_s": (0.7, 1.3, 2.5),
    "static_coefficient": (0.6, 0.9),
    "friction_ratio": (0.75, 0.85, 0.92),
    "normal_force_N": (4.0, 6.0),
    "gain_mismatch": (-0.03, 0.03),
}
"""Traits by which scores are split, with the edges between their bins; the outermost bins are open.
`friction_ratio`, μ_k / μ_s, is the drop of the friction."""
NAMES = ("pattern", "kind")
"""Traits that are names. Each name is a bin."""


def rate(hits: int, of: int) -> ScoredNumber:
    """Returns the share of hits with Wilson's score interval (Wilson 1927, J. Am. Stat. Assoc. 22,
    209).

    >>> half = rate(5, 10)
    >>> half.value, round(half.low, 3), round(half.high, 3)
    (0.5, 0.237, 0.763)
    """
    if of == 0:
        return ScoredNumber(math.nan, math.nan, math.nan, 0, "1")
    share, z2 = hits / of, COVERAGE_95**2
    middle = (share + z2 / (2 * of)) / (1 + z2 / of)
    half = COVERAGE_95 / (1 + z2 / of) * math.sqrt(share * (1 - share) / of + z2 / (4 * of**2))
    low = 0.0 if hits == 0 else middle - half
    high = 1.0 if hits == of else middle + half
    return ScoredNumber(share, low, high, of, "1")


def percentiles(values: Sequence[float], unit: str) -> dict[int, ScoredNumber]:
    """Returns `PERCENTILES` of the finite values, with their bootstrap intervals.

    It is the percentile bootstrap (Efron 1979) with a fixed seed: the same values always give the
    same interval.
    """
    known = np.array([value for value in values if math.isfinite(value)])
    if not known.size:
        return dict.fromkeys(PERCENTILES, ScoredNumber(math.nan, math.nan, math.nan, 0, unit))
    found = np.percentile(known, PERCENTILES)
    if known.size < FEWEST_OF_A_SPREAD:
        low = high = np.full(found.size, math.nan)
    else:
        drawn = np.random.default_rng(0).integers(known.size, size=(RESAMPLES, known.size))
        again = np.percentile(known[drawn], PERCENTILES, axis=1)
        low, high = np.percentile(again, (2.5, 97.5), axis=1)
    return {
        percent: ScoredNumber(float(found[k]), float(low[k]), float(high[k]), known.size, unit)
        for k, percent in enumerate(PERCENTILES)
    }


def score(outcomes: Sequence[TrialOutcome]) -> Score:
    """Returns all numbers of a group of outcomes of one detector."""
    return dict(_quantities(outcomes))


def by_trait(outcomes: Sequence[TrialOutcome], trait: str) -> list[Group]:
    """Returns the outcomes that have a trait, one group for each bin that is not empty, in
    order."""
    having = [one for one in outcomes if trait in one.traits]
    if trait in NAMES:
        names = sorted({str(one.traits[trait]) for one in having})
        return [
            Group(trait, name, tuple(one for one in having if one.traits[trait] == name))
            for name in names
        ]
    edges = (-math.inf, *BINS[trait], math.inf)
    groups = []
    for low, high in pairwise(edges):
        inside = tuple(one for one in having if low <= float(one.traits[trait]) < high)
        if inside:
            groups.append(Group(trait, _bin(low, high), inside))
    return groups


def _bin(low: float, high: float) -> str:
    if math.isinf(low):
        return f"below {high:g}"
    return f"{low:g} to {high:g}" if math.isfinite(high) else f"{low:g} and more"


def _quantities(outcomes: Sequence[TrialOutcome]) -> Iterator[tuple[str, ScoredNumber]]:
    def share(of: Sequence[TrialOutcome], holds: Callable[[TrialOutcome], bool]) -> ScoredNumber:
        return rate(sum(map(holds, of)), len(of))

    def labelled(label: str) -> list[TrialOutcome]:
        return [one for one in outcomes if one.label == label]

    if slips := labelled("slip"):
        yield "found", share(slips, lambda one: one.found)
        yield "early", share(slips, lambda one: one.early)
        yield "late", share(slips, lambda one: one.late)
        for name in ("after_node", "after_ridge", "before_gross"):
            times = [1e3 * float(getattr(one, f"{name}_s")) for one in slips]
            for percent, time in percentiles(times, "ms").items():
                yield f"{name}_{percent}", time
    if rolling := labelled("slip in a roll"):
        yield "found_in_roll", share(rolling, lambda one: one.found)
        yield "early_in_roll", share(rolling, lambda one: one.early)
    for label in ("roll", "hold", "tap"):
        if still := labelled(label):
            yield f"{label}_alarms", share(still, lambda one: one.alarmed)
    if lifting := labelled("lift-off"):
        yield "lift_off_alarms_before", share(lifting, lambda one: one.alarmed_touching)
        yield "lift_off_alarms", share(lifting, lambda one: one.alarmed)
    if rolls := labelled("roll"):
        yield "rolls_recognised", share(rolls, lambda one: one.classified_as_roll)
    if others := [one for label in ("slip", "hold", "tap") for one in labelled(label)]:
        yield "taken_for_rolls", share(others, lambda one: one.classified_as_roll)
    if outcomes:
        yield "pressing_alarms", share(outcomes, lambda one: one.alarmed_pressing)
    if slips:
        yield "armed", share(slips, lambda one: one.armed)
        leads = [1e3 * one.arming_lead_s for one in slips]
        for percent, lead in percentiles(leads, "ms").items():
            yield f"arming_lead_{percent}", lead
    vain = sum(one.in_vain for one in outcomes)
    if armings := vain + sum(one.followed for one in outcomes):
        yield "armings_in_vain", rate(vain, armings)
    for label in ("roll", "lift-off", "hold", "tap"):
        if still := labelled(label):
            yield f"{label.replace('-', '_')}_armed", share(still, lambda one: one.in_vain > 0)
