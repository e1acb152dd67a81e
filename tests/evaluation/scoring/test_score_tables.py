"""Rates and percentiles with their intervals, and the table of groups."""

import math

import numpy as np
import pytest

from rig.evaluation.scoring.outcomes import DetectorReport, TrialOutcome, Truth, judge
from rig.evaluation.scoring.tables import by_trait, per_hour, percentiles, rate, rayleigh_p, score


@pytest.mark.parametrize(
    ("hits", "of", "low", "high"),
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611),
     (1, 29, 0.0061, 0.1718), (29, 29, 0.8830, 1.0)],
)  # fmt: skip
def test_wilsons_interval_is_the_published_one(hits, of, low, high):
    """Newcombe 1998, Statistics in Medicine 17, 857, table I, method 3; the last one mirrored."""
    found = rate(hits, of)
    assert found.value == hits / of
    assert found.low == pytest.approx(low, abs=6e-5)
    assert found.high == pytest.approx(high, abs=6e-5)


def test_a_rate_of_nothing_is_no_number():
    found = rate(0, 0)
    assert found.of == 0
    assert math.isnan(found.value)


def test_percentiles_leave_out_what_did_not_happen_and_repeat_themselves():
    values = [*range(101), math.nan]
    found = percentiles(values, "ms")
    assert {k: v.value for k, v in found.items()} == {5: 5.0, 50: 50.0, 95: 95.0}
    assert found[50].of == 101
    assert found == percentiles(values, "ms")


@pytest.mark.thorough
def test_the_bootstrap_covers_the_median_as_often_as_it_says():
    chance = np.random.default_rng(3)
    covered = 0
    for _ in range(200):
        found = percentiles(list(chance.normal(7.0, 2.0, 60)), "ms")[50]
        covered += found.low <= 7.0 <= found.high
    assert 180 <= covered <= 199  # 190 expected, 3 standard deviations


def test_few_values_have_a_percentile_but_no_interval():
    found = percentiles([1.0, 2.0, 3.0], "ms")[50]
    assert found.value == 2.0
    assert math.isnan(found.low)


def outcome(
    label: str, alarms: list[float], armings: list[float], rolls: tuple[float, ...] = (), **traits
) -> TrialOutcome:
    times = {"node_slip_s": 0.8, "ridge_slip_s": 1.0, "gross_slip_s": 1.2}
    times = times if label.startswith("slip") else {}
    truth = Truth(label=label, motion_s=0.5, record_s=2.0, quiet_s=((0.2, 0.5),), **times)
    return judge(truth, DetectorReport(*map(np.array, (alarms, armings, rolls))), traits)


OUTCOMES = [
    outcome("slip", [0.995], [0.8], noise_mV=0.1),
    outcome("slip in a slide", [0.6, 1.01], [0.7], (1.1,), noise_mV=0.2),  # a roll after it
    outcome("slip", [], [], noise_mV=3.0),
    outcome("slip in a roll", [0.991], [], noise_mV=0.1, pattern="b"),
    outcome("roll", [0.9], [0.8, 0.9], (0.6,), noise_mV=0.1, pattern="a"),
    outcome("roll", [], [], noise_mV=0.1, pattern="b"),
    outcome("hold", [], [0.7], (0.8,), noise_mV=0.1),
    outcome("partial slip", [1.5], [], noise_mV=0.1),
    outcome("tap", [0.3], [], noise_mV=0.1),
]


def test_a_score_tells_every_kind_of_right_and_wrong():
    reported = score(OUTCOMES)
    shares = {name: (one.value, one.of) for name, one in reported.items() if one.unit == "1"}
    assert shares == {
        "found": (pytest.approx(2 / 3), 3),
        "found_of_judged": (pytest.approx(2 / 3), 3),
        "found_first": (pytest.approx(1 / 3), 3),
        "early": (pytest.approx(1 / 3), 3),
        "late": (0.0, 3),
        "alarms_after": (0.0, 3),
        "found_at_a_stop": (0.5, 2),
        "early_at_a_stop": (0.0, 2),
        "found_in_a_slide": (1.0, 1),
        "early_in_a_slide": (1.0, 1),
        "found_in_roll": (1.0, 1),
        "early_in_roll": (0.0, 1),
        "no_slip_alarms": (pytest.approx(3 / 5), 5),
        "no_slip_alarms_moving": (pytest.approx(2 / 5), 5),
        "roll_alarms": (0.5, 2),
        "roll_alarms_moving": (0.5, 2),
        "hold_alarms": (0.0, 1),
        "hold_alarms_moving": (0.0, 1),
        "partial_slip_alarms": (1.0, 1),
        "partial_slip_alarms_moving": (1.0, 1),
        "tap_alarms": (1.0, 1),
        "tap_alarms_moving": (0.0, 1),
        "rolls_recognised": (0.5, 2),
        "taken_for_rolls": (pytest.approx(1 / 6), 6),
        "pressing_alarms": (1 / 9, 9),
        "cannot_judge": (0.0, 9),
        "says_inverted": (0.0, 9),
        "slips_unjudged": (0.0, 3),
        "armed": (pytest.approx(2 / 3), 3),
        "armings_in_vain": (pytest.approx(3 / 5), 5),
        "roll_armed": (0.5, 2),
        "hold_armed": (1.0, 1),
        "partial_slip_armed": (0.0, 1),
        "tap_armed": (0.0, 1),
    }
    assert reported["after_ridge_50"].value == pytest.approx(2.5)
    assert reported["early_by_50"].value == pytest.approx(400.0)
    assert reported["arming_lead_50"].value == pytest.approx(250.0)
    assert reported["before_gross_95"].unit == "ms"


def test_alarms_per_hour_are_those_of_the_time_without_a_slip_and_of_quiet():
    reported = score(OUTCOMES)
    # Alarms: 0.6 s of a slip, one of a roll, a partial slip and a tap; 4 slips have 0.99 s each.
    without_s = 4 * 0.99 + 5 * 2.0
    assert reported["false_per_hour"].value == pytest.approx(4 / without_s * 3600)
    assert reported["false_per_hour_of"].value == pytest.approx(without_s / 3600)
    assert reported["quiet_per_hour"].value == pytest.approx(1 / (9 * 0.3) * 3600)
    assert (reported["quiet_per_hour"].unit, reported["quiet_per_hour"].of) == ("1/h", 9)


@pytest.mark.parametrize(
    ("count", "low", "high"), [(0, 0.0, 3.689), (1, 0.0253, 5.572), (10, 4.795, 18.39)]
)
def test_the_interval_of_a_count_is_the_published_one(count, low, high):
    """Garwood 1936, as tabulated by Ulm 1990, Am. J. Epidemiol. 131, 373."""
    found = per_hour(count, 3600.0, 1)
    assert (found.low, found.high) == (pytest.approx(low, abs=2e-3), pytest.approx(high, rel=1e-3))


def test_uniform_phases_are_rejected_as_often_as_the_test_says():
    chance = np.random.default_rng(8)
    rejected = sum(rayleigh_p(list(chance.uniform(0, 1, 25))) < 0.05 for _ in range(400))
    assert 7 <= rejected <= 33  # 20 expected, 3 standard deviations
    assert rayleigh_p([0.5, 0.52, 0.47, 0.55, 0.5, 0.45, 0.51, 0.53, 0.49, 0.5]) < 1e-3


def test_groups_are_bins_of_a_number_or_names_and_hold_each_outcome_once():
    groups = {one.bin: len(one.outcomes) for one in by_trait(OUTCOMES, "noise_mV")}
    assert groups == {"below 0.2": 7, "0.2 to 0.5": 1, "1 and more": 1}
    assert [one.bin for one in by_trait(OUTCOMES, "pattern")] == ["a", "b"]
    assert by_trait(OUTCOMES, "speed_mm_s") == []
