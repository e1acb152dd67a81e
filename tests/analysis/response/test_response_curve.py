"""A measured response as arrays: sorted, checked, its errors in gain and phase."""

import math

import numpy as np
import pytest

from rig.analysis.estimate import Estimate
from rig.analysis.response.curve import CurveError, ResponseCurve

F = np.array([30.0, 10.0, 20.0])
H = np.array([3j, 1.0 + 0j, -2.0 + 0j])
C = np.array([np.diag([v, 4 * v]) for v in (1e-4, 2e-4, 3e-4)])


def test_points_are_sorted_by_frequency():
    curve = ResponseCurve.of(F, H, C)
    assert curve.frequencies.tolist() == [10, 20, 30]
    assert curve.responses.tolist() == [1, -2, 3j]
    assert curve.covariances[:, 0, 0].tolist() == [2e-4, 3e-4, 1e-4]


def test_errors_of_gain_and_phase_follow_the_direction_of_the_response():
    relative = ResponseCurve.of(F, H, C).relative_covariances
    assert relative[0] == pytest.approx(np.diag([2e-4, 8e-4]))
    assert relative[1] == pytest.approx(np.diag([3e-4, 12e-4]) / 4)
    assert relative[2] == pytest.approx(np.diag([4e-4, 1e-4]) / 9)


def test_whitened_differences_have_unit_variance():
    random = np.random.default_rng(4)
    mixed = np.array([[4e-6, 1.5e-6], [1.5e-6, 1e-6]])
    truth = 0.8 * np.exp(0.7j)
    noise = random.multivariate_normal([0, 0], mixed, 4000)
    curve = ResponseCurve.of(
        np.arange(1.0, 4001), truth + noise @ [1, 1j], np.tile(mixed, (4000, 1, 1))
    )
    white = curve.whitened(curve.log_ratio(np.full(4000, truth))).reshape(2, -1)
    assert np.cov(white) == pytest.approx(np.eye(2), abs=0.06)


def test_a_further_error_of_the_gain_leaves_the_phase_alone():
    wider = ResponseCurve.of(F, H, C).with_relative_error(0.1, 0.0).relative_covariances
    plain = ResponseCurve.of(F, H, C).relative_covariances
    assert wider[:, 0, 0] == pytest.approx(plain[:, 0, 0] + 0.01)
    assert wider[:, 1, 1] == pytest.approx(plain[:, 1, 1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ((F[:2], H, C), "do not belong together"),
        ((np.array([30.0, -10.0, 20.0]), H, C), "number 2 is -10 Hz"),
        ((F, np.array([3j, 0, 1]), C), "responses: the value at 10 Hz is zero or not finite"),
        ((F, np.array([3j, 1, np.nan]), C), "responses: the value at 20 Hz"),
        ((F, H, np.where(C == 3e-4, np.inf, C)), "covariances: the value"),
        ((F, H, C * np.array([1.0, -1.0, 1.0])[:, None, None]), "at 10 Hz is not positive"),
    ],
)
def test_what_cannot_be_analysed_is_named(change, message):
    with pytest.raises(CurveError, match=message):
        ResponseCurve.of(*change)


def test_an_estimate_says_value_interval_and_unit_to_two_figures_of_its_error():
    assert (
        str(Estimate.normal(-77.88774, 0.00054, "dB")) == "-77.8877 dB (95 %: -77.8888 to -77.8867)"
    )
    assert Estimate.normal(1.0, 0.1, "").covers(1.19)
    assert not Estimate.normal(1.0, 0.1, "").covers(1.2)


def test_the_interval_of_an_inverse_is_open_where_the_quantity_may_be_zero():
    assert Estimate.of_inverse(1e-3, 1e-3, "Hz").high == math.inf
    assert Estimate.of_inverse(1e-3, 1e-4, "Hz").low == pytest.approx(836.1, abs=0.1)
    assert Estimate.of_inverse(-1e-4, 1e-4, "Hz").value == math.inf
    assert Estimate.of_logarithm(math.log(5), 10.0, "").low > 0
