"""What a detector is credited with, on trials made by hand."""

import math

import numpy as np
import pytest

from rig.evaluation.scoring.outcomes import DetectorReport, TrialOutcome, Truth, judge

SLIP = Truth(
    label="slip", motion_s=0.5, node_slip_s=0.8, ridge_slip_s=1.0, gross_slip_s=1.2
)  # fmt: skip


def judged(truth: Truth, alarms: list[float], armings: list[float] | None = None) -> TrialOutcome:
    return judge(truth, DetectorReport(np.array(alarms), np.array(armings or [], dtype=float)), {})


@pytest.mark.parametrize(
    ("alarms", "found", "early", "late"),
    [
        ([], False, False, False),
        ([0.79], False, True, False),
        ([0.81], True, False, False),
        ([1.029], True, False, False),
        ([1.031], False, False, True),
        ([0.2, 0.9], True, True, False),
        ([0.9, 1.5], True, False, False),
        ([0.7, 1.5], False, True, True),
    ],
)
def test_a_slip_is_found_from_its_first_node_to_30_ms_after_its_whole_ridge(
    alarms, found, early, late
):
    told = judged(SLIP, alarms)
    assert (told.found, told.early, told.late) == (found, early, late)


def test_delays_are_those_of_the_first_alarm_that_finds():
    told = judged(SLIP, [0.6, 0.95, 1.01])
    assert told.after_node_s == pytest.approx(0.15)
    assert told.after_ridge_s == pytest.approx(-0.05)
    assert told.before_gross_s == pytest.approx(0.25)
    assert math.isnan(judged(SLIP, [0.6]).after_ridge_s)


def test_every_alarm_without_a_slip_is_false_and_those_of_pressing_on_are_distinguished():
    roll = Truth(label="roll", motion_s=0.5)
    assert not judged(roll, []).alarmed
    told = judged(roll, [0.7])
    assert told.alarmed
    assert not told.alarmed_pressing
    assert not told.found
    assert judged(roll, [0.4]).alarmed_pressing


def test_where_the_ridge_lifts_off_the_alarms_before_count_apart():
    lifted = Truth(label="lift-off", motion_s=0.5, lift_off_s=0.9)
    after, before = judged(lifted, [1.0]), judged(lifted, [0.8])
    assert (after.alarmed, after.alarmed_touching) == (True, False)
    assert (before.alarmed, before.alarmed_touching) == (True, True)


def test_a_slip_is_predicted_by_armings_between_the_motion_and_its_whole_ridge():
    told = judged(SLIP, [], [0.3, 0.6, 0.9, 1.1])
    assert told.armed
    assert told.arming_lead_s == pytest.approx(0.1)
    assert (told.followed, told.in_vain) == (2, 0)
    assert not judged(SLIP, [], [0.3, 1.1]).armed


def test_armings_that_no_slip_followed_are_counted_from_the_motion_on():
    hold = Truth(label="hold", motion_s=0.5)
    told = judged(hold, [], [0.3, 0.6, 0.9])
    assert (told.followed, told.in_vain, told.armed) == (0, 2, False)


def test_a_slip_without_its_times_is_refused():
    with pytest.raises(ValueError, match="ridge_slip_s nan s: both must be times"):
        judged(Truth(label="slip", motion_s=0.5, node_slip_s=0.8), [])
    with pytest.raises(ValueError, match="the node's not the later"):
        judged(Truth(label="slip", motion_s=0.5, node_slip_s=0.8, ridge_slip_s=0.7), [])
