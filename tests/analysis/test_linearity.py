"""Gain against load: the paper's data2, and how distortion is summed up."""

import math

import numpy as np
import pytest

from rig.analysis.film.gain_curve import analyse
from rig.analysis.film.linearity import distortion_summary, load_linearity
from rig.analysis.response.curve import CurveError

LOADS = (0.2, 0.5, 1.0, 3.0, 10.0)
FREQUENCIES = np.geomspace(2, 20000, 40)


def data2(exponent=0.0, seed=0, loads=LOADS):
    """Film of 20 dB/decade and a pole whose gain follows load^exponent; errors fall with load."""
    random = np.random.default_rng(seed)
    f, load = (a.ravel() for a in np.meshgrid(FREQUENCIES, loads))
    truth = 1.2e-4 * 1j * f / (1 + 1j * f / 2000) * load**exponent
    relative = 0.004 / np.sqrt(load)
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
    assert found.degrees == 160
    assert "does not depend on the load" in found.sentence()


def test_a_gain_that_grows_with_load_is_found_and_measured():
    found = load_linearity(*data2(exponent=0.01))
    assert found.slope.covers(0.2)
    assert not found.slope.covers(0.0)
    assert "depends on the load" in found.sentence()
    assert 0.1 < found.worst_deviation_dB < 0.6


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
    assert analysis.as_dict()["linearity"]["degrees"] == 160


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
