"""Rates and percentiles of outcomes with 95 % intervals, for all trials and by their conditions.

The intervals take the trials for independent. Trials of several kinds at one seed on the simulated
bench share friction, force, noise and skin, so that an interval over kinds is too narrow: by up to
the square root of their number in a seed, if all of these had the same outcome.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from rig.analysis.estimate import COVERAGE_95
from rig.evaluation.scoring.outcomes import SLIPS, TrialOutcome

PERCENTILES = (5, 50, 95)
"""Percentiles that are computed of every delay."""
RESAMPLES = 1000
"""Resamples of the bootstrap. The error of an end of its interval is then below a tenth of its
width."""
SLIP_CLASSES = {
    "slip": "at_a_stop", "slip in a slide": "in_a_slide", "slip in a roll": "in_roll",
}  # fmt: skip
"""Classes of slips, by label, with the end of the names of their numbers."""
TOUCHING = ("roll", "hold", "partial slip", "tap")
"""Labels of trials without a slip of the whole ridge in which it touches to the end."""
FEWEST_PHASES = 10
"""Minimum number of alarms whose phases within the tick are tested."""
FEWEST_OF_A_SPREAD = 5
"""Minimum number of values for which the interval of a percentile is computed."""


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
    """Unit of value and interval; "1" for a rate, "p" for a probability."""


Score = dict[str, ScoredNumber]
"""Numbers of a group of outcomes, by name. Numbers that cannot occur in the group are omitted."""


@dataclass(frozen=True)
class Group:
    """The outcomes of the trials whose trait lies in a bin."""

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
    "normal_force_N": (1.5, 4.0, 6.0),
    "tick_Hz": (100.0, 200.0),
    "held_share": (0.8, 0.9),
    "gain_mismatch": (-0.03, 0.03),
}
"""Traits by which scores are split, with the edges between their bins; the outermost bins are open.
`friction_ratio`, μ_k / μ_s, is the drop of the friction."""
NAMES = ("pattern", "kind", "stop")
"""Traits that are names. Each name is a bin."""


def rate(hits: float, of: int) -> ScoredNumber:
    """Return the share of hits with Wilson's score interval (Wilson 1927, J. Am. Stat. Assoc. 22,
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


def rate_of_groups(hits: int, of: int, groups: int) -> ScoredNumber:
    """Return the share of hits with Wilson's score interval of as many cases as there are groups,
    within each of which the cases may all have the same outcome.

    >>> every = rate_of_groups(36, 36, 12)
    >>> every.of, round(every.low, 2)
    (12, 0.76)
    """
    return rate(hits / of * groups if of else 0, groups)


def per_hour(count: int, seconds: float, of: int) -> ScoredNumber:
    """Return events per hour, from a count in a time, with the exact interval of a Poisson count
    (Garwood 1936, Biometrika 28, 437).

    >>> none = per_hour(0, 3600.0, 1)
    >>> none.low, round(none.high, 2)
    (0.0, 3.69)
    """
    # Imported here because scipy takes long to import and not every command comes here.
    from scipy.special import gammaincinv

    hours, tail = seconds / 3600, 0.025
    low = float(gammaincinv(count, tail)) if count else 0.0
    high = float(gammaincinv(count + 1, 1 - tail))
    return ScoredNumber(count / hours, low / hours, high / hours, of, "1/h")


def rayleigh_p(phases: Sequence[float]) -> float:
    """Return the probability that phases from 0 to 1 that are uniform are as much on one side as
    these, by Rayleigh's test (Mardia and Jupp 2000, Directional Statistics, 6.3.1).

    >>> round(rayleigh_p([0.0, 0.25, 0.5, 0.75]), 2)
    1.0
    >>> rayleigh_p([0.1] * 20) < 1e-6
    True
    """
    count = len(phases)
    z = count * abs(np.exp(2j * np.pi * np.asarray(phases)).mean()) ** 2
    correction = 1 + (2 * z - z**2) / (4 * count)
    return float(min(1.0, max(0.0, math.exp(-z) * correction)))


def percentiles(values: Sequence[float], unit: str) -> dict[int, ScoredNumber]:
    """Return `PERCENTILES` of the finite values, with their bootstrap intervals.

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
    """Return all numbers of a group of outcomes of one detector."""
    return dict(_quantities(outcomes))


def by_trait(outcomes: Sequence[TrialOutcome], trait: str) -> list[Group]:
    """Return the outcomes that have a trait, one group for each bin that is not empty, in
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

    slips = [one for label in SLIPS for one in labelled(label)]
    if slips:
        yield "found", share(slips, lambda one: one.found)
        yield (
            "found_of_judged",
            share([one for one in slips if not one.slip_unjudged], lambda one: one.found),
        )
        yield "slips_unjudged", share(slips, lambda one: one.slip_unjudged)
        yield "found_first", share(slips, lambda one: one.found_first)
        yield "early", share(slips, lambda one: one.early)
        yield "late", share(slips, lambda one: one.late)
        yield "alarms_after", share(slips, lambda one: one.alarmed_after)
        for name in ("early_by", "after_node", "after_ridge", "before_gross"):
            times = [1e3 * float(getattr(one, f"{name}_s")) for one in slips]
            for percent, time in percentiles(times, "ms").items():
                yield f"{name}_{percent}", time
    for label, where in SLIP_CLASSES.items():
        if of_class := labelled(label):
            yield f"found_{where}", share(of_class, lambda one: one.found)
            yield f"early_{where}", share(of_class, lambda one: one.early)
    if without := [one for label in TOUCHING for one in labelled(label)]:
        yield "no_slip_alarms", share(without, lambda one: one.alarmed)
        yield "no_slip_alarms_moving", share(without, lambda one: one.alarmed_moving)
    for label in TOUCHING:
        if still := labelled(label):
            yield f"{_key(label)}_alarms", share(still, lambda one: one.alarmed)
            yield f"{_key(label)}_alarms_moving", share(still, lambda one: one.alarmed_moving)
    if lifting := labelled("lift-off"):
        yield "lift_off_alarms_before", share(lifting, lambda one: one.alarmed_touching)
        yield "lift_off_alarms", share(lifting, lambda one: one.alarmed)
    if rolls := labelled("roll"):
        yield "rolls_recognised", share(rolls, lambda one: one.classified_as_roll)
    if others := [*slips, *(o for name in ("hold", "partial slip", "tap") for o in labelled(name))]:
        yield "taken_for_rolls", share(others, lambda one: one.classified_as_roll)
    if outcomes:
        yield "pressing_alarms", share(outcomes, lambda one: one.alarmed_pressing)
        yield "cannot_judge", share(outcomes, lambda one: one.cannot_judge)
        yield "says_inverted", share(outcomes, lambda one: one.says_inverted)
    if timed := [one for one in outcomes if math.isfinite(one.record_s)]:
        unjudged = 100 * sum(o.unjudged_s for o in timed) / sum(o.record_s for o in timed)
        yield "unjudged_time", ScoredNumber(unjudged, math.nan, math.nan, len(timed), "%")
    yield from _alarms_per_hour(outcomes)
    phases = [phase for one in outcomes for phase in one.tick_phases]
    if len(phases) >= FEWEST_PHASES:
        yield "tick_phase_p", ScoredNumber(rayleigh_p(phases), math.nan, math.nan, len(phases), "p")
    if slips:
        yield "armed", share(slips, lambda one: one.armed)
        leads = [1e3 * one.arming_lead_s for one in slips]
        for percent, lead in percentiles(leads, "ms").items():
            yield f"arming_lead_{percent}", lead
    vain = sum(one.in_vain for one in outcomes)
    if armings := vain + sum(one.followed for one in outcomes):
        yield "armings_in_vain", rate(vain, armings)
    for label in ("roll", "lift-off", "hold", "partial slip", "tap"):
        if still := labelled(label):
            yield f"{_key(label)}_armed", share(still, lambda one: one.in_vain > 0)


def _alarms_per_hour(outcomes: Sequence[TrialOutcome]) -> Iterator[tuple[str, ScoredNumber]]:
    """Yield false alarms per hour, of all time without a slip and of the quiet part of it."""
    timed = [one for one in outcomes if math.isfinite(one.without_slip_s)]
    for name, alarms, seconds in (
        ("false_per_hour", [o.false_alarms for o in timed], [o.without_slip_s for o in timed]),
        ("quiet_per_hour", [o.quiet_alarms for o in outcomes], [o.quiet_s for o in outcomes]),
    ):
        if total_s := sum(seconds):
            of = sum(second > 0 for second in seconds)
            yield name, per_hour(sum(alarms), total_s, of)
            hours = total_s / 3600
            yield f"{name}_of", ScoredNumber(hours, math.nan, math.nan, of, "h")


def _key(label: str) -> str:
    return label.replace(" ", "_").replace("-", "_")
