"""What a sweep foretells: the drive for the next frequency, the length of the next record."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.analysis.response.complex_response import Response
from rig.analysis.response.levelling import (
    LearnedGain,
    LearnedMains,
    RecordNeeds,
    agreement,
    combined,
    range_for,
    record_samples,
)
from rig.analysis.response.sine_fit import fit_sine, inflation, mains_lines


def resonance(f, f0=95.0, Q=1.3):
    x = f / f0
    return 1 / math.hypot(1 - x**2, x / Q)


def test_a_resonance_is_predicted_from_three_points_next_to_it():
    learned = LearnedGain()
    for f in (20.0, 25.0, 31.7):
        learned.learn(f, resonance(f))
    assert learned.at(16.0) == pytest.approx(resonance(16.0), rel=1e-3)
    assert learned.at(28.0) == pytest.approx(resonance(28.0), rel=1e-3)
    assert learned.at(39.9) == pytest.approx(resonance(39.9), rel=0.02)


def test_nothing_is_predicted_without_points_and_beyond_them_the_nearest_holds():
    learned = LearnedGain()
    assert learned.at(100.0) is None
    assert not learned.near(100.0)
    learned.learn(10.0, 3.0)
    assert learned.at(1000.0) == pytest.approx(3.0)
    assert not learned.near(1000.0)
    assert learned.near(11.0)


@given(st.lists(st.tuples(st.floats(2, 20_000), st.floats(1e-3, 1e3)), min_size=1, max_size=12))
def test_a_prediction_is_positive_and_never_bolder_than_twice_the_power(points):
    learned = LearnedGain()
    for f, gain in points:
        learned.learn(f, gain)
    gains = [gain for _, gain in points]
    for f, _ in points:
        foretold = learned.at(1.02 * f)
        assert min(gains) / 2 < foretold < max(gains) * 2


def needs(error, target=0.05, shortest=0.0065, longest=20.0):
    return RecordNeeds(shortest, longest, target, error)


def test_a_record_is_as_long_as_its_noise_asks_for_in_whole_cycles():
    rate = 64e3
    n = record_samples(3.0, rate, needs(error=0.07), ())
    cycles = 3.0 * n / rate
    assert cycles == pytest.approx(round(cycles), abs=1e-3)
    assert n / rate >= (0.07 / 0.05) ** 2 > (cycles - 1) / 3.0
    assert record_samples(1000.0, rate, needs(None), ()) / rate == pytest.approx(0.007, abs=1e-3)


def test_a_line_close_by_lengthens_the_record_until_it_can_be_separated():
    rate, wanted = 64e3, needs(error=0.002)
    n = record_samples(51.0, rate, wanted, mains_lines())
    alone = record_samples(51.0, rate, wanted, ())
    assert n > 3 * alone
    assert 0.002 / math.sqrt(n / rate) * math.sqrt(inflation(51.0, rate, n, [50.0])) < 0.05
    assert record_samples(50.0, rate, wanted, mains_lines()) / rate < 1, "hopeless is hopeless"


def test_weak_mains_is_learned_to_be_weak():
    rate, n = 64e3, 32_000
    t = np.arange(n) / rate
    random = np.random.default_rng(4)
    y = 1e-4 * np.sin(2 * np.pi * 50.02 * t) + 3.5e-4 * random.standard_normal(n)
    learned = LearnedMains()
    assert learned.strong(50.0, 5, 1e-5) == list(mains_lines())
    first, *others = mains_lines()
    learned.learn(fit_sine(y, rate, first, interference=others), 50.0)
    assert learned.strong(50.0, 5, 5e-5) == [50.0]
    assert learned.strong(50.0, 5, 2e-4) == []


def response(value, error):
    return Response(100.0, value, np.eye(2) * error**2, math.nan)


def test_responses_are_combined_by_their_precision():
    mean = combined([response(1.0 + 0j, 0.01), response(2.0 + 0j, 0.1)])
    assert mean.value.real == pytest.approx((1e4 * 1 + 1e2 * 2) / (1e4 + 1e2))
    assert math.sqrt(mean.covariance[0, 0]) == pytest.approx(1 / math.sqrt(1e4 + 1e2))
    still = agreement(response(1.0, 0.0), response(1.0, 0.0), 1e-3, (100, 100))
    assert still == pytest.approx(1e-3)


def test_a_ringing_record_does_not_excuse_its_own_difference():
    """Its residual, and so its stated error, is that of the ringing and not of the noise."""
    quiet = agreement(response(1.0, 0.001), response(1.0, 0.001), 0.0, (100, 100))
    assert agreement(response(1.0, 0.1), response(1.0, 0.001), 0.0, (100, 100)) == quiet
    short = agreement(response(1.0, 0.01), response(1.0, 0.001), 0.0, (100, 10_000))
    # 100 samples have ten times the error of 10 000: the short record is as quiet as it says.
    assert short == pytest.approx(2.5 * math.sqrt(2) * math.hypot(0.01, 0.001))


def test_the_range_is_the_smallest_that_holds_the_signal():
    assert range_for(0.1, (0.05, 0.2, 1.0)) == 0.2
    assert range_for(5.0, (0.05, 0.2, 1.0)) == 1.0
