"""The bound by an ideal observer, against closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from rig.evaluation.scored_trials import judge_one
from rig.evaluation.scoring.ideal import (
    LEAST_ROWS,
    IdealSettings,
    Process,
    detectability,
    ideal_report,
    probability_unchanged,
    process_of,
    slip_detectability,
    slip_rows,
    whitened,
)
from rig.evaluation.scoring.outcomes import Truth, judge
from rig.evaluation.scoring.tables import score
from rig.evaluation.scoring.trivial import POSSIBLE, with_trivial_answers

RATE_Hz, NOISE_V = 1000.0, 0.2e-3
TRUTH = Truth("slip in a slide", 1.0, 1.19, 1.2, record_s=1.5, quiet_s=((0.3, 1.0),))


def first_order(rows: int, memory: float, sigma: float, seed: int) -> np.ndarray:
    """Two independent channels, (rows, 2), each with a first-order memory."""
    white = sigma * np.random.default_rng(seed).standard_normal((rows, 2))
    return lfilter([1.0], [1.0, -memory], white, axis=0)


def recorded(size_V: float, seed: int = 0) -> np.ndarray:
    """Volts (1500, 2) of white noise and, from the first node at 1.19 s, an impulse of v_d."""
    noise = NOISE_V * np.random.default_rng(seed).standard_normal((1500, 2))
    noise[1195:1205] += size_V * np.array([0.5, -0.5])
    return noise


def test_a_process_is_learnt_from_its_rows():
    found = process_of(first_order(40_000, 0.8, 2.0, 1), order=3)
    expected = np.zeros((3, 2, 2))
    expected[0] = 0.8 * np.eye(2)
    np.testing.assert_allclose(found.weights, expected, atol=0.02)
    np.testing.assert_allclose(found.covariance, 4.0 * np.eye(2), atol=0.15)
    with pytest.raises(ValueError, match="99 rows"):
        process_of(np.zeros((LEAST_ROWS - 1, 2)))


def test_a_step_in_noise_with_a_memory_has_the_detectability_of_the_closed_form():
    memory, sigma, rows = 0.9, 2.0, 30
    process = Process(memory * np.eye(2)[None], sigma**2 * np.eye(2))
    step = np.column_stack([np.full(rows, 3.0), np.zeros(rows)])
    expected = 3.0 / sigma * math.sqrt(1 + (rows - 1) * (1 - memory) ** 2)
    assert detectability(step, process) == pytest.approx(expected)


def test_detectability_is_the_distance_of_the_matched_filter_in_standard_deviations():
    process = process_of(first_order(20_000, 0.7, 1.0, 2))
    change = np.column_stack([np.hanning(30), -0.5 * np.hanning(30)])
    template = whitened(change, process)
    # Noise that began long before, of which the filter has seen enough.
    noise = (first_order(100, 0.7, 1.0, seed)[-60:] for seed in range(2000))
    heard = np.array([(whitened(one, process)[-30:] * template).sum() for one in noise])
    distance = (template**2).sum() / heard.std()
    assert distance == pytest.approx(detectability(change, process), rel=0.06)


def test_of_a_record_the_noise_is_taken_off():
    size_V = 1e-3
    expected = math.sqrt(10 * 2 * (0.5 * size_V / NOISE_V) ** 2)
    found = [slip_detectability(recorded(size_V, seed), RATE_Hz, TRUTH) for seed in range(40)]
    assert np.sqrt(np.mean(np.square(found))) == pytest.approx(expected, rel=0.1)


def test_what_stands_out_is_found_at_the_last_moment_and_what_does_not_is_not():
    (found_s,) = ideal_report(recorded(2e-3), RATE_Hz, TRUTH).alarms_s
    assert found_s == TRUTH.window_s()[1]
    outcome = judge(TRUTH, ideal_report(recorded(2e-3), RATE_Hz, TRUTH), {})
    assert outcome.found_first
    assert ideal_report(recorded(0.0), RATE_Hz, TRUTH).alarms_s.size == 0
    never = IdealSettings(false_per_hour=1e-99)
    assert ideal_report(recorded(2e-3), RATE_Hz, TRUTH, never).alarms_s.size == 0
    hold = Truth("hold", 1.0, record_s=1.5)
    assert ideal_report(recorded(2e-3), RATE_Hz, hold).alarms_s.size == 0


@pytest.mark.parametrize(("rate_Hz", "draws"), [(1000.0, 400), (10_000.0, 40)])
def test_in_noise_alone_nothing_is_found_at_any_rate(rate_Hz, draws):
    """With a threshold on d' of 6 there were alarms in 2 % at 1 kHz and in 22 % at 10 kHz."""
    short = replace(TRUTH, quiet_s=((0.88, 1.0),))
    noise = (
        NOISE_V * np.random.default_rng(seed).standard_normal((round(1.5 * rate_Hz), 2))
        for seed in range(draws)
    )
    assert not sum(ideal_report(volts, rate_Hz, short).alarms_s.size for volts in noise)


@pytest.mark.parametrize("rows", [LEAST_ROWS, 400])
def test_the_probability_of_what_comes_by_chance_is_true(rows):
    """Also where the process was learnt from few rows."""
    draws = 1000
    noise = (first_order(rows + 240, 0.9, 1.0, seed)[200:] for seed in range(draws))
    found = np.array([probability_unchanged(one[:rows], one[rows:]) for one in noise])
    for probability in (0.5, 0.1, 0.01):
        scatter = math.sqrt(draws * probability * (1 - probability))
        assert abs((found < probability).sum() - draws * probability) < 3 * scatter


def test_a_fast_recording_is_judged_at_the_rate_of_detectors_and_no_earlier_than_by_them():
    volts = np.zeros((15_000, 2))
    volts[11_900:] = 1.0  # the slip of the first node, at 1.19 s
    before, during, rate_Hz = slip_rows(volts, 10_000.0, TRUTH)
    assert rate_Hz == 1000.0
    assert during.shape == (40, 2)
    assert not before.any()
    assert during[-1] == pytest.approx(1.0, abs=0.02)


def test_without_time_to_learn_the_noise_nothing_is_judged():
    short = Truth("slip", 1.18, 1.19, 1.2, record_s=1.5)
    traits: dict[str, float | str] = {}
    judged = [judge_one("one", short, recorded(2e-3), RATE_Hz, traits, (), sweep=False)]
    answers, (scored,) = with_trivial_answers(judged)
    at = [one.name for one in answers].index(POSSIBLE)
    assert scored.outcomes[at].slip_unjudged
    assert scored.outcomes[at].unjudged_s == 1.5
    assert score([scored.outcomes[at]])["unjudged_time"].value == pytest.approx(100.0)
    near_its_end = replace(short, record_s=1.22)
    outcome = judge(near_its_end, ideal_report(recorded(2e-3)[:1220], RATE_Hz, near_its_end), {})
    assert (outcome.slip_unjudged, outcome.unjudged_s) == (True, 1.22)


def test_a_dead_channel_is_judged_by_the_other():
    volts = recorded(2e-3)
    volts[:, 1] = 0.0
    assert slip_detectability(volts, RATE_Hz, TRUTH) > 6
