"""What a detector is credited with, on trials made by hand."""

import math

import numpy as np
import pytest

from rig.evaluation.scoring.outcomes import DetectorReport, TrialOutcome, Truth, judge
from rig.evaluation.scoring.tables import score

SLIP = Truth(
    label="slip", motion_s=0.5, node_slip_s=0.8, ridge_slip_s=1.0, gross_slip_s=1.2, record_s=2.0
)  # fmt: skip


def judged(truth: Truth, alarms: list[float], armings: list[float] | None = None) -> TrialOutcome:
    return judge(truth, DetectorReport(np.array(alarms), np.array(armings or [], dtype=float)), {})


@pytest.mark.parametrize(
    ("alarms", "found", "early", "late"),
    [
        ([], False, False, False),
        ([0.81], False, True, False),
        ([0.989], False, True, False),
        ([0.991], True, False, False),
        ([1.029], True, False, False),
        ([1.031], False, False, True),
        ([0.6, 0.995], True, True, False),
        ([0.995, 1.5], True, False, False),
        ([0.7, 1.5], False, True, True),
        ([0.49], False, False, False),
    ],
)
def test_a_slip_is_found_from_10_ms_before_to_30_ms_after_its_whole_ridge(
    alarms, found, early, late
):
    reported = judged(SLIP, alarms)
    assert (reported.found, reported.early, reported.late) == (found, early, late)
    assert reported.found_first == (found and not early)


def test_a_slip_is_not_found_by_an_alarm_when_its_first_node_slips():
    assert not judged(SLIP, [SLIP.node_slip_s + 0.01]).found


def test_delays_are_those_of_the_first_alarm_that_finds_and_of_the_first_early_one():
    reported = judged(SLIP, [0.6, 0.7, 0.995, 1.01])
    assert reported.after_node_s == pytest.approx(0.195)
    assert reported.after_ridge_s == pytest.approx(-0.005)
    assert reported.before_gross_s == pytest.approx(0.205)
    assert reported.early_by_s == pytest.approx(0.4)
    assert math.isnan(judged(SLIP, [0.6]).after_ridge_s)


def test_every_alarm_without_a_slip_is_false_and_those_of_pressing_on_are_distinguished():
    roll = Truth(label="roll", motion_s=0.5, record_s=1.0)
    assert not judged(roll, []).alarmed
    reported = judged(roll, [0.7])
    assert reported.alarmed
    assert reported.alarmed_moving
    assert not reported.alarmed_pressing
    assert not reported.found
    pressing = judged(roll, [0.4])
    assert pressing.alarmed_pressing
    assert not pressing.alarmed_moving


def test_false_alarms_and_the_time_in_which_they_can_occur_end_where_a_slip_is_found():
    reported = judged(SLIP, [0.2, 0.7, 0.995, 1.5])
    assert reported.false_alarms == 2
    assert reported.without_slip_s == pytest.approx(0.99)
    hold = judged(Truth(label="hold", motion_s=0.5, record_s=2.0), [0.2, 0.7, 1.5])
    assert (hold.false_alarms, hold.without_slip_s) == (3, 2.0)


def test_alarms_of_quiet_are_those_in_its_intervals():
    truth = Truth("hold", 0.5, record_s=2.0, quiet_s=((0.2, 0.5), (1.0, 2.0)))
    reported = judged(truth, [0.1, 0.3, 0.7, 1.5, 1.9])
    assert reported.quiet_alarms == 3
    assert reported.quiet_s == pytest.approx(1.3)


def test_phases_within_the_tick_are_those_of_early_and_false_alarms_in_the_motion():
    ticked = {"record_s": 2.0, "tick_s": 0.01, "tick_from_s": 0.5}
    slip = Truth("slip", 0.5, 0.8, 1.0, **ticked)
    reported = judged(slip, [0.403, 0.605, 0.707, 1.0])
    assert reported.tick_phases == pytest.approx((0.5, 0.7))
    assert judged(Truth("hold", 0.5, **ticked), [0.608]).tick_phases == pytest.approx((0.8,))
    assert judged(Truth("hold", 0.5, **ticked | {"tick_s": 0.002}), [0.608]).tick_phases == ()


def test_where_the_ridge_lifts_off_the_alarms_before_count_apart():
    lifted = Truth(label="lift-off", motion_s=0.5, lift_off_s=0.9)
    after, before = judged(lifted, [1.0]), judged(lifted, [0.8])
    assert (after.alarmed, after.alarmed_touching) == (True, False)
    assert (before.alarmed, before.alarmed_touching) == (True, True)


def test_an_alarm_at_the_slip_of_a_ridge_that_lifts_off_is_not_false():
    ticked = {"record_s": 2.5, "tick_s": 0.01, "tick_from_s": 1.0}
    lifted = Truth("lift-off", 1.0, 1.9, 1.95, lift_off_s=2.0, **ticked)
    for right in (1.945, 1.955, 2.01):
        outcome = judged(lifted, [right])
        assert (outcome.false_alarms, outcome.tick_phases) == (0, ())
    outcome = judged(lifted, [0.5, 1.935])
    assert (outcome.false_alarms, len(outcome.tick_phases)) == (2, 1)
    assert outcome.without_slip_s == pytest.approx(1.94)
    at_once = judged(Truth("lift-off", 1.0, lift_off_s=2.0, record_s=2.5), [1.99, 2.01])
    assert (at_once.false_alarms, at_once.without_slip_s) == (1, 2.0)
    unknown = judged(Truth("lift-off", 1.0, record_s=2.5), [1.99, 2.01])
    assert (unknown.false_alarms, unknown.without_slip_s) == (2, 2.5)


def test_a_slip_is_predicted_by_armings_between_the_motion_and_its_whole_ridge():
    reported = judged(SLIP, [], [0.3, 0.6, 0.9, 1.1])
    assert reported.armed
    assert reported.arming_lead_s == pytest.approx(0.1)
    assert (reported.followed, reported.in_vain) == (2, 0)
    assert not judged(SLIP, [], [0.3, 1.1]).armed


def test_armings_that_no_slip_followed_are_counted_from_the_motion_on():
    hold = Truth(label="hold", motion_s=0.5)
    reported = judged(hold, [], [0.3, 0.6, 0.9])
    assert (reported.followed, reported.in_vain, reported.armed) == (0, 2, False)


def test_a_slip_in_time_that_is_not_judged_is_missed_and_said_to_be_unjudged():
    reported = judge(SLIP, DetectorReport(unjudged_s=((0.0, 0.1), (0.9, 1.2))), {})
    assert (reported.found, reported.slip_unjudged, reported.cannot_judge) == (False, True, True)
    assert (reported.unjudged_s, reported.record_s) == (pytest.approx(0.4), 2.0)
    partly = judge(SLIP, DetectorReport(unjudged_s=((1.0, 1.2),)), {})
    assert (partly.slip_unjudged, partly.cannot_judge) == (False, True)
    hold = judge(Truth("hold", 0.5, record_s=2.0), DetectorReport(unjudged_s=((0.0, 2.0),)), {})
    assert (hold.slip_unjudged, hold.unjudged_s) == (False, 2.0)


def test_a_trial_whose_strip_may_be_inverted_was_judged_and_is_counted_by_itself():
    reported = judge(SLIP, DetectorReport(np.array([1.001]), inverted=True), {})
    assert (reported.found, reported.cannot_judge, reported.says_inverted) == (True, False, True)
    shares = score([reported, judged(SLIP, [1.001])])
    assert (shares["cannot_judge"].value, shares["says_inverted"].value) == (0.0, 0.5)


def test_a_detector_that_never_judges_finds_nothing_and_is_not_credited_for_it():
    silent = judge(SLIP, DetectorReport(unjudged_s=((0.0, 2.0),)), {})
    reported = score([silent, judged(SLIP, [1.001])])
    assert (reported["found"].value, reported["found"].of) == (0.5, 2)
    assert (reported["found_of_judged"].value, reported["found_of_judged"].of) == (1.0, 1)
    assert reported["slips_unjudged"].value == 0.5
    assert reported["unjudged_time"].value == pytest.approx(50.0)
    assert math.isnan(score([silent])["found_of_judged"].value)


def test_a_slip_without_its_times_is_refused():
    with pytest.raises(ValueError, match="'slip' needs ridge_slip_s, the time"):
        judged(Truth(label="slip", motion_s=0.5, node_slip_s=0.8), [])
    with pytest.raises(ValueError, match="the node's not the later"):
        judged(Truth(label="slip", motion_s=0.5, node_slip_s=0.8, ridge_slip_s=0.7), [])
