"""Trivial answers, scored with the detectors: how close they come shows what a figure is worth.

They know the truth, or ignore it altogether, and see no signal. One other answer stands beside
them: what an ideal observer finds, who knows the truth and has seen the signals.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rig.core.settings import Settings
from rig.evaluation.scoring.ideal import IdealSettings
from rig.evaluation.scoring.outcomes import (
    EARLY_WITHIN_S,
    FOUND_WITHIN_S,
    SLIPS,
    DetectorReport,
    Truth,
    judge,
)
from rig.evaluation.scoring.results import ScoredTrial
from rig.evaluation.scoring.seeds import SeedRange

BLIND_S = 0.05
"""Delay of the blind alarm that knows nothing of the trials."""
POSSIBLE = "possible"
"""Name of what an ideal observer finds."""
ALWAYS_EVERY_S = 0.01
"""Interval between the alarms of the answer that always alarms: shorter than the time in which a
slip is found."""


class BlindSettings(Settings):
    """Parameters of a blind alarm."""

    delay_s: float
    """Time from the start of the motion to the alarm."""


class AlwaysSettings(Settings):
    """Parameters of the answer that always alarms."""

    every_s: float = ALWAYS_EVERY_S
    """Interval between alarms, from the first sample on."""


@dataclass(frozen=True)
class TrivialAnswer:
    """An answer that no detector could give: it does not depend on the signals, or it is that of an
    ideal observer."""

    name: str
    """Name in the tables."""
    settings: BlindSettings | AlwaysSettings | IdealSettings
    """Its parameters."""

    @property
    def tuned_on(self) -> tuple[SeedRange, ...]:
        """Return nothing: it was tuned on no trials, or on those that are scored, as its name then
        says."""
        return ()

    def report(self, trial: ScoredTrial) -> DetectorReport:
        """Return its alarms in a trial."""
        truth = trial.truth
        if isinstance(self.settings, IdealSettings):
            assert trial.possible is not None
            return trial.possible
        if isinstance(self.settings, BlindSettings):
            at_s = truth.motion_s + self.settings.delay_s
            within = not at_s > truth.record_s
            return DetectorReport(np.array([at_s] if within else []))
        end_s = truth.record_s if math.isfinite(truth.record_s) else truth.window_s()[1]
        return DetectorReport(np.arange(0.0, end_s, self.settings.every_s))


def with_trivial_answers(
    judged: Sequence[ScoredTrial],
) -> tuple[tuple[TrivialAnswer, ...], list[ScoredTrial]]:
    """Return the trivial answers, and the trials with their outcomes after those of the
    detectors."""
    best_s = best_delay_s([one.truth for one in judged if one.truth.label in SLIPS])
    answers = [TrivialAnswer(f"blind {1e3 * BLIND_S:.0f} ms", BlindSettings(delay_s=BLIND_S))]
    if math.isfinite(best_s):
        name = f"blind {1e3 * best_s:.0f} ms (best here)"
        answers.append(TrivialAnswer(name, BlindSettings(delay_s=best_s)))
    answers.append(TrivialAnswer("always", AlwaysSettings()))
    if all(one.possible is not None for one in judged):
        answers.append(TrivialAnswer(POSSIBLE, IdealSettings()))

    def scored(one: ScoredTrial) -> ScoredTrial:
        traits = one.outcomes[0].traits if one.outcomes else {}
        own = tuple(judge(one.truth, answer.report(one), traits) for answer in answers)
        return replace(one, outcomes=(*one.outcomes, *own))

    return tuple(answers), [scored(one) for one in judged]


def best_delay_s(slips: Sequence[Truth]) -> float:
    """Return the fixed delay after the start of the motion that finds most of these slips in time;
    NaN without slips. No fixed delay does better on them.

    >>> slips = [Truth("slip", 1.0, 1.0, ridge) for ridge in (1.100, 1.103, 1.400)]
    >>> found = best_delay_s(slips)
    >>> 0.093 <= found <= 0.130
    True
    """
    delays = np.array([one.ridge_slip_s - one.motion_s for one in slips])
    if not delays.size:
        return math.nan
    # The best interval can be moved until it ends where the time of one of the slips ends.
    ends = delays + FOUND_WITHIN_S
    begins = delays - EARLY_WITHIN_S
    hits = ((ends[:, None] >= begins) & (ends[:, None] <= ends)).sum(axis=1)
    last = ends[hits == hits.max()].min()
    first = begins[(begins <= last) & (ends >= last)].max()
    return float((first + last) / 2)
