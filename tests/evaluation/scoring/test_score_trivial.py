"""Trivial answers beside the detectors."""

import numpy as np
import pytest

from rig.evaluation.scoring.outcomes import DetectorReport, Truth, judge
from rig.evaluation.scoring.results import ScoredTrial, results
from rig.evaluation.scoring.trivial import best_delay_s, with_trivial_answers

NONE = np.zeros((1, 0), bool)


def trial(truth: Truth) -> ScoredTrial:
    return ScoredTrial("one", truth, (judge(truth, DetectorReport(), {"kind": "x"}),), NONE, NONE)


def slip(delay_s: float) -> Truth:
    return Truth("slip in a slide", 1.0, 1.001, 1.0 + delay_s, record_s=3.0)


TRIALS = [*(trial(slip(delay)) for delay in (0.05, 0.300, 0.310, 0.320)),
          trial(Truth("hold", 1.0, record_s=3.0)),
          trial(Truth("hold", 1.0, record_s=1.02))]  # fmt: skip


def test_a_blind_alarm_finds_the_slips_that_come_with_its_delay_and_alarms_in_every_long_hold():
    answers, judged = with_trivial_answers(TRIALS)
    (blind, best, always) = results(answers, [_without_detector(one) for one in judged])
    assert blind.contender.name == "blind 50 ms"
    assert (blind.score["found"].value, blind.score["hold_alarms"].value) == (0.25, 0.5)
    assert best.score["found"].value == 0.75
    assert best.contender.name.endswith("(best here)")
    assert always.score["found"].value == 1.0
    assert always.score["found_first"].value == 0.0
    assert always.score["hold_alarms"].value == 1.0
    assert always.score["false_per_hour"].value == pytest.approx(360_000, rel=0.01)


def _without_detector(one: ScoredTrial) -> ScoredTrial:
    return ScoredTrial(one.name, one.truth, one.outcomes[1:], NONE, NONE)


def test_no_fixed_delay_finds_more_than_the_best_one():
    chance = np.random.default_rng(4)
    slips = [slip(delay) for delay in chance.uniform(0.02, 0.5, 30)]

    def found(delay_s: float) -> int:
        return sum(judge(one, DetectorReport(np.array([1.0 + delay_s])), {}).found for one in slips)

    best = found(best_delay_s(slips))
    assert best == max(found(delay) for delay in np.arange(0.0, 0.6, 0.0005))
