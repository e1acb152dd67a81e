"""Results of each detector, and the results of all detectors as rows of one table."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rig.core.errors import RigError
from rig.evaluation.scoring.contenders import FACTORS, Contender, Named
from rig.evaluation.scoring.outcomes import SLIPS, DetectorReport, TrialOutcome, Truth
from rig.evaluation.scoring.roc import AXES, ROLL_ALARMS, Roc, roc
from rig.evaluation.scoring.tables import BINS, NAMES, Score, by_trait, score

ROW = (
    "detector", "use", "trait", "bin", "quantity", "unit", "value", "low", "high", "of",
)  # fmt: skip
"""Columns of the table of results."""


@dataclass(frozen=True)
class ScoredTrial:
    """One trial with the outcome of every detector."""

    name: str
    """Name of the trial: kind and seed, or file and point."""
    truth: Truth
    """What happened in it."""
    outcomes: tuple[TrialOutcome, ...]
    """Outcome of each detector at its own threshold."""
    found: NDArray[np.bool_]
    """True where the slip was found at each of the swept thresholds, (detectors, k); k is 0 without
    a sweep."""
    alarmed: NDArray[np.bool_]
    """True where there was any alarm at each of the swept thresholds, (detectors, k)."""
    possible: DetectorReport | None = None
    """What an ideal observer finds in it (`rig.evaluation.scoring.ideal`); None where no one has
    computed it."""
    failed: Mapping[str, RigError] = field(default_factory=dict)
    """What the detectors of other packages that failed at it failed at, by their names in the
    tables; their outcomes mean nothing (`without_failed`)."""


@dataclass(frozen=True)
class GroupScore:
    """Score of the trials whose trait lies in a bin."""

    trait: str
    """Name of the trait; empty for all trials."""
    bin: str
    """The bin in words."""
    score: Score
    """Numbers of these trials."""


@dataclass(frozen=True)
class ContenderResult:
    """Results of one detector or baseline."""

    contender: Named
    """The detector, baseline or trivial answer."""
    outcomes: tuple[TrialOutcome, ...]
    """Outcomes, trial by trial."""
    score: Score
    """Numbers of all trials."""
    groups: tuple[GroupScore, ...]
    """Scores by bins of the traits."""
    rocs: dict[str, Roc] = field(default_factory=dict)
    """Slips found against false alarms, by the names of `AXES`; empty if no threshold was swept."""


def without_failed(
    contenders: Sequence[Contender], judged: Sequence[ScoredTrial]
) -> tuple[list[Contender], list[ScoredTrial], dict[str, tuple[str, RigError]]]:
    """Return the detectors that have judged every trial, the trials with their outcomes alone, and
    for each of the others the name of the first trial at which it failed, and the failure."""
    failures: dict[str, tuple[str, RigError]] = {}
    for trial in judged:
        for name, error in trial.failed.items():
            failures.setdefault(name, (trial.name, error))
    if not failures:
        return list(contenders), list(judged), {}
    left = [at for at, one in enumerate(contenders) if one.name not in failures]
    trials = [
        replace(
            one,
            outcomes=tuple(one.outcomes[at] for at in left),
            found=one.found[left],
            alarmed=one.alarmed[left],
            failed={},
        )
        for one in judged
    ]
    return [contenders[at] for at in left], trials, failures


def results(contenders: Sequence[Named], judged: Sequence[ScoredTrial]) -> list[ContenderResult]:
    """Return the results of each detector from the scored trials. Trivial answers, which come
    last, have no ROC."""
    labels = [one.truth.label for one in judged]
    swept = min((len(one.found) for one in judged if one.found.shape[1]), default=0)
    found = []
    for at, contender in enumerate(contenders):
        outcomes = tuple(one.outcomes[at] for one in judged)
        rocs = {}
        if at < swept and not set(SLIPS).isdisjoint(labels):
            hits = np.array([one.found[at] for one in judged])
            alarms = np.array([one.alarmed[at] for one in judged])
            for name, among in AXES.items():
                if any(label in among for label in labels):
                    rocs[name] = roc(FACTORS, labels, hits, alarms, name)
        groups = tuple(
            GroupScore(group.trait, group.bin, score(group.outcomes))
            for trait in (*BINS, *NAMES)
            for group in by_trait(outcomes, trait)
        )
        found.append(ContenderResult(contender, outcomes, score(outcomes), groups, rocs))
    return found


def rows(found: Sequence[ContenderResult], use: str) -> Iterator[tuple[str | float, ...]]:
    """Yield every number as a row with the columns `ROW`.

    `use` says what the trials are for (reporting or tuning) and is written to every row.
    """
    for one in found:
        everything = [GroupScore("", "", one.score), *one.groups]
        for group in everything:
            for quantity, number in group.score.items():
                yield (
                    one.contender.name, use, group.trait, group.bin, quantity, number.unit,
                    number.value, number.low, number.high, number.of,
                )  # fmt: skip
        for name, curve in one.rocs.items():
            among = "+".join(AXES[name])
            at = f"found_at_{100 * ROLL_ALARMS:g}_percent_{among}_alarms"
            best = curve.found_at(ROLL_ALARMS)
            yield one.contender.name, use, "", "", at, "1", best, math.nan, math.nan, math.nan
            for factor, hits, alarms in zip(
                curve.threshold, curve.found, curve.alarms, strict=True
            ):
                for quantity, value in (("found", hits), (f"{among}_alarms", alarms)):
                    yield (
                        one.contender.name, use, "threshold_factor", f"{factor:.4g}", quantity,
                        "1", float(value), math.nan, math.nan, math.nan,
                    )  # fmt: skip
