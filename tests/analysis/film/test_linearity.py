"""Gain against load: the paper's data2, and how distortion is summed up."""

import math

import numpy as np
import pytest

from rig.analysis.film.gain_curve import analyse
from rig.analysis.film.linearity import distortion_summary, load_linearity
from rig.analysis.response.curve import CurveError
from rig.analysis.verdict import Bounds

BOUNDS = Bounds()
LOADS = (0.2, 0.5, 1.0, 3.0, 10.0)
FREQUENCIES = np.geomspace(2, 20000, 40)


def data2(exponent=0.0, seed=0, loads=LOADS, scale=1.0):
    """Film of 20 dB/decade and a pole whose gain follows load^exponent; errors fall with load."""
    random = np.random.default_rng(seed)
    f, load = (a.ravel() for a in np.meshgrid(FREQUENCIES, loads))
    truth = 1.2e-4 * 1j * f / (1 + 1j * f / 2000) * load**exponent
    relative = scale * 0.004 / np.sqrt(load)
    noise = random.standard_normal((2, f.size))
    variance = np.square(relative * np.abs(truth))
    order = random.permutation(f.size)
    responses = truth * (1 + relative * (noise[0] + 1j * noise[1]))
    covariances = variance[:, None, None] * np.eye(2)
    return f[order], responses[order], covariances[order], load[order]


def test_a_linear_film_is_called_linear():
    found = load_linearity(*data2())
    assert found.slope.covers(0.0)
    assert found.slope.standard_error < 0.01
    assert found.frequencies.size == 40
    assert found.degrees == 159
    assert found.verdict(BOUNDS).answer == "holds"
    assert "The gain does not depend on the load: holds" in found.sentence(BOUNDS)


def test_a_gain_that_grows_with_load_is_found_and_measured():
    found = load_linearity(*data2(exponent=0.01))
    assert found.slope.covers(0.2)
    assert not found.slope.covers(0.0)
    assert "The gain does not depend on the load: does not hold" in found.sentence(BOUNDS)
    assert found.differing_loads_N == pytest.approx((0.2, 10.0))
    assert found.largest_difference.covers(0.2 * math.log10(50))
    assert 0.1 < found.worst_deviation_dB < 0.6


def test_a_chi_square_alone_decides_nothing():
    """Errors that are stated 1.6 times too small are no dependence on the load."""
    frequencies, responses, covariances, loads = data2()
    found = load_linearity(frequencies, responses, covariances / 2.5, loads)
    assert found.probability < 1e-9
    assert found.verdict(BOUNDS).answer == "holds"
    assert "scatter more than their errors" in found.sentence(BOUNDS)
    assert found.slope.standard_error >= load_linearity(*data2()).slope.standard_error


def test_what_is_known_too_poorly_is_not_decided():
    found = load_linearity(*data2(scale=8.0))
    assert found.verdict(BOUNDS).answer == "cannot be decided"
    assert "cannot be decided by these data" in found.sentence(BOUNDS)
    assert found.verdict(Bounds(slope_dB_decade=2.0, gain_dB=3.0)).answer == "holds"


def test_a_dependence_that_is_no_straight_line_is_found():
    frequencies, responses, covariances, loads = data2()
    bent = responses * np.where(loads == 1.0, 10 ** (0.3 / 20), 1.0)
    verdict = load_linearity(frequencies, bent, covariances, loads).verdict(BOUNDS)
    assert verdict.answer == "does not hold"
    assert "gain under 1 N less" in verdict.reason or "less 1 N" in verdict.reason


def test_a_sure_difference_is_not_hidden_by_a_larger_interval():
    """0.25 dB at 10 N, and points at 0.2 N that are known to 15 %: it could not be decided."""
    random = np.random.default_rng(0)
    frequencies, loads = np.repeat(FREQUENCIES, 5), np.tile(LOADS, FREQUENCIES.size)
    errors = np.where(loads < 0.3, 0.15, 0.001)
    noise = random.standard_normal((2, loads.size))
    responses = np.where(loads == 10, 10 ** (0.25 / 20), 1.0) * (
        1 + errors * (noise[0] + 1j * noise[1])
    )
    found = load_linearity(
        frequencies, responses, np.square(errors)[:, None, None] * np.eye(2), loads
    )
    assert found.largest_difference.value == max(
        (one.gain.value for one in found.differences), key=abs
    )
    verdict = found.verdict(Bounds(slope_dB_decade=1.0))
    assert verdict.answer == "does not hold"
    assert "gain under 10 N less" in verdict.reason
    assert "less 0.2 N" not in verdict.reason


def test_a_dependence_at_one_frequency_is_named():
    frequencies, responses, covariances, loads = data2()
    at = FREQUENCIES[30]
    changed = responses * np.where(frequencies == at, loads**0.05, 1.0)
    found = load_linearity(frequencies, changed, covariances, loads)
    assert found.frequencies[found.beyond(BOUNDS)] == pytest.approx([at])
    assert f"at {at:g} Hz alone" in found.sentence(BOUNDS)


def test_what_the_preload_does_is_no_dependence_on_the_load():
    """The preload moves with the load, by 0.3 N from the smallest to the largest."""
    frequencies, responses, covariances, loads = data2(scale=0.02)
    preloads = 25 + 0.03 * loads + 0.05 * np.sin(np.arange(loads.size))
    moved = responses * 10 ** (0.5 * (preloads - 25) / 20)
    without = load_linearity(frequencies, moved, covariances, loads)
    found = load_linearity(frequencies, moved, covariances, loads, preloads=preloads)
    assert not without.slope.covers(0.0)
    assert found.slope.covers(0.0)
    assert found.preload_effect.value == pytest.approx(0.5, abs=0.02)
    assert found.probability > 1e-3


def preloads_beside(load, random):
    """Preloads in N that a stage holds in steps, 3 mN deeper by decade of load."""
    return 25 + 0.05 * random.standard_normal(load.size) + 0.003 * np.log10(load)


def test_a_dependence_on_the_load_is_not_taken_for_one_on_the_preload():
    """It is fitted beside it, and chi-square, corner and level are those of the film."""
    frequencies, responses, covariances, loads = data2(exponent=0.005, scale=0.1)
    preloads = preloads_beside(loads, np.random.default_rng(3))
    moved = responses * 10 ** (0.02 * (preloads - 25) / 20)
    found = analyse(frequencies, moved, covariances, preloads=preloads, loads=loads)
    assert found.fit.preload_effect.covers(0.02)
    assert found.fit.preload_effect.standard_error < 0.003
    assert found.linearity.slope.covers(0.1)
    assert found.fit.chi_square / found.fit.degrees == pytest.approx(1, abs=0.2)
    assert found.corner.covers(2000.0)
    at_mean_load_dB = 0.1 * np.log10(loads).mean() + 0.02 * (preloads.mean() - 25)
    assert found.level.covers(20 * math.log10(1.2e-4) + at_mean_load_dB)
    assert "at the mean load 1.25 N" in found.sentences()[1]


def test_preloads_that_vibration_has_disturbed_do_not_dilute_their_effect():
    """A force that is sampled near its vibration's frequency is off by up to half a newton."""
    effects = []
    for seed in range(8):
        frequencies, responses, covariances, loads = data2(scale=0.05, seed=seed)
        random = np.random.default_rng([seed, 1])
        preloads = preloads_beside(loads, random)
        errors = np.where(np.abs(frequencies - 900) < 300, 0.05 * loads, 0.0006)
        moved = responses * 10 ** (0.02 * (preloads - 25) / 20)
        seen = preloads + errors * random.standard_normal(loads.size)
        found = load_linearity(frequencies, moved, covariances, loads, None, seen, errors)
        effects.append(found.preload_effect)
    assert sum(effect.covers(0.02) for effect in effects) >= 6
    error = np.mean([effect.standard_error for effect in effects]) / math.sqrt(len(effects))
    assert np.mean([effect.value for effect in effects]) == pytest.approx(0.02, abs=3 * error)


@pytest.mark.thorough
def test_intervals_of_the_slope_cover_zero_in_95_percent():
    covered = sum(load_linearity(*data2(seed=seed)).slope.covers(0.0) for seed in range(200))
    assert 183 <= covered <= 197


def test_one_load_says_nothing_about_linearity():
    assert load_linearity(*data2(loads=(1.0, 1.2))) is None


def test_the_sweep_with_several_loads_is_analysed_as_one_film():
    *arrays, loads = data2()
    distortion = np.full(loads.size, 0.002)
    distortion[7] = 0.03
    analysis = analyse(
        *arrays, loads=loads, load_distortion=distortion / 2, film_distortion=distortion
    )
    assert analysis.linearity.slope.covers(0.0)
    assert analysis.level.covers(20 * math.log10(1.2e-4))
    text = "\n".join(analysis.sentences())
    assert "film 0.20% (worst 3.00%" in text
    assert analysis.as_dict()["linearity"]["degrees"] == 159


def test_distortion_that_was_not_measured_is_left_out():
    nothing = np.full(3, np.nan)
    assert distortion_summary([1, 2, 3], nothing, nothing) is None
    found = distortion_summary([1, 2, 3], [np.nan, 0.01, 0.03], [0.1, np.nan, 0.2])
    assert (found.median_load, found.worst_load, found.worst_load_Hz) == (0.02, 0.03, 3.0)
    assert (found.worst_film, found.worst_film_Hz) == (0.2, 3.0)


@pytest.mark.parametrize(
    ("loads", "message"), [(np.ones(3), "3 values for 200"), (np.zeros(200), "not above 0 N")]
)
def test_impossible_loads_are_named(loads, message):
    with pytest.raises(CurveError, match=message):
        load_linearity(*data2()[:3], loads)
