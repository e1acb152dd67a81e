"""Calibration from weights: the truth comes back within the stated intervals, mistakes do not."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rig.analysis.estimate import COVERAGE_95
from rig.analysis.weighing import (
    WeighingError,
    fit_force,
    fit_line,
    fit_load_cell,
    mean_of,
    refuse_outlier,
    sequence,
)

MATRIX = np.array([[83.2, 0.35, -0.55], [0.37, 79.9, 0.83], [1.5, 0.45, 83.7]])
ZERO = np.array([0.012, -0.007, 0.021])
AXES = [(1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0)]
FORCES = np.array(sequence(AXES, (5.0, 10.0, 20.0)))
LOADS = np.array([0.0, 2.0, 5.0, 10.0, 0.0])


def bridge(forces, matrix=MATRIX, zero=ZERO):
    """Outputs in mV/V under forces (n, 3)."""
    return forces @ np.linalg.inv(matrix).T + zero


# --- readings --------------------------------------------------------------------------------


def test_the_error_of_a_mean_is_that_of_its_noise():
    random = np.random.default_rng(1)
    means = [mean_of(random.normal(3.0, 0.2, 2000)) for _ in range(400)]
    found = np.array([mean.value[0] for mean in means])
    stated = np.array([mean.standard_error[0] for mean in means])
    assert found.std() == pytest.approx(0.2 / math.sqrt(2000), rel=0.15)
    assert math.sqrt(np.square(stated).mean()) == pytest.approx(found.std(), rel=0.15)
    assert not any(mean.drifts(0.0)[0] for mean in means[:50])


def test_noise_that_wanders_gives_a_larger_error_than_its_spread_says():
    random = np.random.default_rng(2)
    steps = random.normal(0, 1, 20_000)
    slow = np.convolve(steps, np.ones(200) / 200, mode="valid")
    white = slow.std() / math.sqrt(slow.size)
    assert mean_of(slow).standard_error[0] > 5 * white


def test_mains_hum_over_whole_cycles_costs_nothing():
    time = np.arange(20_000) / 10e3
    mean = mean_of(1.0 + 0.5 * np.sin(2 * np.pi * 50 * time))
    assert mean.value[0] == pytest.approx(1.0, abs=1e-12)
    assert mean.standard_error[0] < 1e-12


def test_a_converter_that_stands_still_is_as_uncertain_as_its_step():
    still, dithered = np.full(1000, 0.25), np.round(np.random.default_rng(3).normal(0, 2, 1000))
    assert mean_of(still, 0.1).standard_error[0] == pytest.approx(0.1 / math.sqrt(12))
    assert mean_of(dithered, 1.0).standard_error[0] < 0.2


@given(drift=st.floats(min_value=-3, max_value=3), offset=st.floats(-5, 5))
def test_a_drift_is_measured_and_seen_where_it_is_larger_than_tolerated(drift, offset):
    noise = np.random.default_rng(4).normal(0, 0.01, 2000)
    mean = mean_of(offset + drift * np.linspace(-0.5, 0.5, 2000) + noise)
    assert mean.trend[0] == pytest.approx(drift, abs=0.01)
    if abs(abs(drift) - 0.5) > 0.02:
        assert mean.drifts(0.5)[0] == (abs(drift) > 0.5)


def test_a_reading_of_a_few_samples_is_refused():
    with pytest.raises(WeighingError, match="19 samples is too short"):
        mean_of(np.zeros(19))


# --- fits ------------------------------------------------------------------------------------


@settings(max_examples=20)
@given(
    st.lists(st.floats(20, 200), min_size=3, max_size=3),
    st.lists(st.floats(-0.1, 0.1), min_size=6, max_size=6),
    st.lists(st.floats(-0.5, 0.5), min_size=3, max_size=3),
)
def test_any_sound_sensor_comes_back_exactly_from_exact_readings(gains, crosstalk, zero):
    response = np.eye(3)
    response[~np.eye(3, dtype=bool)] = crosstalk
    matrix = np.linalg.inv(response / np.array(gains)[:, None])
    fit = fit_force(FORCES, bridge(FORCES, matrix, np.array(zero)), np.full((21, 3), 1e-9))
    assert fit.matrix == pytest.approx(matrix, rel=1e-6, abs=1e-6)
    assert fit.zero == pytest.approx(zero, abs=1e-9)
    assert fit.largest_residual < 1e-6
    assert fit.crosstalk_percent == pytest.approx(100 * max(map(abs, crosstalk)), abs=1e-4)


@pytest.mark.thorough
@pytest.mark.parametrize("excess", [0.0, 5.0], ids=["noise alone", "weights that do not repeat"])
def test_the_intervals_of_matrix_and_zero_cover_the_truth_in_95_percent(excess):
    noise = 2e-6
    covered, trials = [], 300
    for seed in range(trials):
        random = np.random.default_rng([5, seed])
        readings = bridge(FORCES) + noise * random.standard_normal((21, 3))
        readings += excess * noise * random.standard_normal((21, 3))
        fit = fit_force(FORCES, readings, np.full((21, 3), noise))
        inside = np.abs(fit.matrix - MATRIX) <= fit.half_widths()
        at_zero = np.abs(fit.zero - ZERO) <= fit.coverage * fit.zero_error
        covered.append([*inside.ravel(), *at_zero])
        assert (fit.coverage > COVERAGE_95) == (excess > 0) or not excess
    share = np.array(covered).mean(axis=0)
    assert share.min() > 0.90, share
    assert 0.935 < share.mean() < 0.985, share.mean()


@pytest.mark.thorough
@pytest.mark.parametrize("excess", [0.0, 5.0], ids=["noise alone", "weights that do not repeat"])
def test_the_interval_of_the_sensitivity_covers_the_truth_in_95_percent(excess):
    noise, hits, trials = 2e-5, 0, 1000
    for seed in range(trials):
        random = np.random.default_rng([6, seed])
        readings = 0.1 * LOADS + 0.003 + noise * random.standard_normal(5)
        readings += excess * noise * random.standard_normal(5)
        fit = fit_load_cell(LOADS, readings, np.full(5, noise))
        hits += fit.sensitivity.covers(0.1)
    assert 0.92 * trials < hits < 0.985 * trials


def test_readings_count_by_their_errors():
    errors = np.array([1e-6, 1e-6, 1e-6, 1e-2, 1e-6])
    readings = 0.1 * LOADS + np.array([0, 0, 0, 1e-2, 0])
    fit = fit_load_cell(LOADS, readings, errors)
    assert fit.sensitivity.value == pytest.approx(0.1, rel=1e-6)
    assert fit.coverage == COVERAGE_95


def test_the_weights_tolerance_is_a_common_scale():
    errors = np.full((21, 3), 1e-9)
    fit = fit_force(FORCES, bridge(FORCES), errors, tolerance=3e-4)
    assert fit.matrix_error == pytest.approx(3e-4 / math.sqrt(3) * np.abs(MATRIX), rel=1e-3)
    cell = fit_load_cell(LOADS, 0.1 * LOADS, np.full(5, 1e-9), tolerance=3e-4)
    assert cell.sensitivity.standard_error == pytest.approx(0.1 * 3e-4 / math.sqrt(3), rel=1e-3)


def test_a_film_pulled_the_other_way_round_has_a_negative_sensitivity():
    fit = fit_load_cell(LOADS, -0.1 * LOADS, np.full(5, 1e-6))
    assert fit.sensitivity.value == pytest.approx(-0.1)
    assert fit.largest_residual < 1e-6


# --- mistakes --------------------------------------------------------------------------------


def test_a_wrong_weight_is_named():
    readings = bridge(FORCES)
    readings[6] = bridge(np.array([-20.0, 0.0, 0.0]))  # asked for: 10 N on -x
    fit = fit_force(FORCES, readings, np.full((21, 3), 1e-6))
    with pytest.raises(WeighingError, match=r"reading 7, with -10, 0, 0 N put on"):
        refuse_outlier(FORCES, fit.residuals)


def test_sound_readings_have_no_outlier():
    noise = 1e-5 * np.random.default_rng(7).standard_normal((21, 3))
    fit = fit_force(FORCES, bridge(FORCES) + noise, np.full((21, 3), 1e-5))
    refuse_outlier(FORCES, fit.residuals)
    assert 0 < fit.largest_residual < 0.01


@pytest.mark.parametrize(
    ("readings", "reported"),
    [
        (np.tile(ZERO, (21, 1)) + 1e-6 * np.arange(63).reshape(21, 3) % 3e-6, "does not follow"),
        (bridge(FORCES)[:, [1, 0, 2]], "answers more to weights on|three directions"),
        (bridge(FORCES)[:, [0, 0, 2]], "answers more to weights on|three directions"),
        (np.full((21, 3), np.nan), "not a finite number"),
    ],
    ids=["dead", "swapped", "one channel twice", "nan"],
)
def test_a_sensor_that_does_not_follow_is_refused(readings, reported):
    with pytest.raises(WeighingError, match=reported):
        fit_force(FORCES, readings, np.full((21, 3), 1e-4))


def test_a_dead_load_cell_is_refused():
    noise = 1e-4 * np.random.default_rng(8).standard_normal(5)
    with pytest.raises(WeighingError, match="does not follow the load"):
        fit_load_cell(LOADS, noise, np.full(5, 1e-4))


@pytest.mark.parametrize(
    ("loads", "reported"), [((0.0, 5.0), "2 readings"), ((5.0, 5.0, 5.0), "3 readings")]
)
def test_too_few_different_weights_are_refused(loads, reported):
    loads = np.array(loads)
    with pytest.raises(WeighingError, match=reported):
        fit_line(loads[:, None], 0.1 * loads, np.full(len(loads), 1e-5))


def test_a_channel_without_any_noise_is_no_channel():
    with pytest.raises(WeighingError, match="no standard error"):
        fit_load_cell(LOADS, 0.1 * LOADS, np.zeros(5))


def test_the_sequence_rises_on_each_axis_and_comes_back_to_nothing():
    assert sequence([(0.0, 0.0, 1.0)], (10.0, 2.0)) == [
        (0.0, 0.0, 0.0),
        (0.0, 0.0, 2.0),
        (0.0, 0.0, 10.0),
        (0.0, 0.0, 0.0),
    ]
