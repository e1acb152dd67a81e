"""ROC, the threshold that keeps to a rate of false alarms, and the patterns of rolls."""

import math

import numpy as np
import pytest

from rig.evaluation.scoring.patterns import roll_pattern
from rig.evaluation.scoring.roc import Roc, roc, threshold_for, tune


def test_a_curve_counts_slips_and_the_trials_without_one_by_their_labels():
    labels = ["slip", "slip", "roll", "roll", "hold", "lift-off"]
    found = np.array([[0, 1], [1, 1], [0, 0], [0, 0], [0, 0], [0, 0]], bool)
    alarmed = np.array([[0, 1], [1, 1], [0, 1], [0, 0], [1, 1], [1, 1]], bool)
    rolls = roc([2.0, 1.0], labels, found, alarmed, "roll")
    np.testing.assert_array_equal(rolls.found, [0.5, 1.0])
    np.testing.assert_array_equal(rolls.alarms, [0.0, 0.5])
    held = roc([2.0, 1.0], labels, found, alarmed, "hold, tap")
    np.testing.assert_array_equal(held.alarms, [1.0, 1.0])
    with pytest.raises(ValueError, match="0 slips and 2 of roll"):
        roc([2.0, 1.0], labels[2:], found[2:], alarmed[2:], "roll")


def test_what_is_found_at_a_rate_lies_between_the_neighbouring_thresholds():
    curve = Roc(np.array([4.0, 2.0, 1.0]), np.array([0.2, 0.6, 0.9]), np.array([0.0, 0.01, 0.05]))
    assert curve.found_at(0.0) == pytest.approx(0.2)
    assert curve.found_at(0.02) == pytest.approx(0.6 + 0.3 / 4)
    assert curve.found_at(0.2) == pytest.approx(0.9)
    noisy = Roc(curve.threshold, curve.found, curve.alarms + 0.5)
    assert math.isnan(noisy.found_at(0.02))


def test_no_more_trials_than_allowed_exceed_the_threshold():
    peaks = np.arange(100.0)
    threshold = threshold_for(peaks, 0.02)
    assert (peaks > threshold).sum() == 2
    assert threshold_for(peaks[:10], 0.02) == 9.0


def test_the_floor_that_finds_most_is_chosen_with_its_threshold():
    rolls = np.array([[1.0, 3.0], [2.0, 1.0]])
    slips = np.array([[1.5, 5.0], [2.5, 4.0], [0.0, 2.0]])
    assert tune((0.1, 0.5), rolls, slips) == (0.5, 3.0, pytest.approx(2 / 3))
    with pytest.raises(ValueError, match="0 rolls and 3 slips: both must be there"):
        tune((0.1, 0.5), rolls[:0], slips)


def rolled(first: float, second: float) -> np.ndarray:
    """1 s at 1 kHz: offsets, mains, and from 0.5 s on an excursion of each channel."""
    time = np.arange(1000) / 1000
    bump = np.sin(np.pi * np.clip((time - 0.5) / 0.3, 0, 1))
    mains = 0.5 * np.sin(2 * np.pi * 50 * time)
    return np.column_stack([3.0 + first * bump + mains, -4.0 + second * bump + mains])


@pytest.mark.parametrize(
    ("first", "second", "pattern"), [(1, 1, "a"), (-1, -2, "a"), (1, -1, "b"), (-2, 1, "b")]
)
def test_pattern_a_has_excursions_of_one_sign_and_b_of_two(first, second, pattern):
    assert roll_pattern(rolled(first, second), 1000.0, 0.5) == pattern


def test_a_roll_that_begins_outside_its_record_has_no_pattern():
    with pytest.raises(ValueError, match=r"motion_s 2 s must leave 0\.02 s"):
        roll_pattern(rolled(1, 1), 1000.0, 2.0)
