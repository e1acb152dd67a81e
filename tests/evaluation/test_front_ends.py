"""What a front end does to the strips' signals, one fault at a time."""

import numpy as np
import pytest

from rig.evaluation.breaks import BREAKS, front_end_break
from rig.evaluation.front_ends import recorded
from rig.physics.population import Range, StripFrontEndSettings

RATE_Hz = 1000.0
NOTHING = {name: Range(low=0.0, high=0.0) for name in ("noise_mV", "mains_mV", "gain_mismatch")}
TIME_s = np.arange(4000) / RATE_Hz
PLAIN = 0.02 * np.sin(2 * np.pi * 5 * TIME_s)[:, None] * np.array([1.0, -0.5])


def heard(**ranges: tuple[float, float]) -> np.ndarray:
    drawn = {name: Range(low=low, high=high) for name, (low, high) in ranges.items()}
    front_end = StripFrontEndSettings.model_validate(
        {**StripFrontEndSettings().model_dump(), **NOTHING, **drawn}
    )
    volts, numbers = recorded(PLAIN, RATE_Hz, front_end, np.random.default_rng(3))
    assert all(ranges[name][0] <= numbers[name] <= ranges[name][1] for name in ranges)
    return volts


def test_without_a_fault_nothing_is_added():
    assert (heard() == PLAIN).all()


def test_a_gain_scales_both_channels():
    assert heard(gain=(4.0, 4.0)) == pytest.approx(4 * PLAIN)


def test_a_coupling_takes_away_what_is_slow_and_leaves_what_is_fast():
    coupled = heard(coupling_Hz=(0.3, 0.3), drift_mV=(1000.0, 1000.0), drift_s=(0.01, 0.01))
    uncoupled = heard(drift_mV=(1000.0, 1000.0), drift_s=(0.01, 0.01))
    assert np.abs(coupled[-1]).max() < 0.75 * np.abs(uncoupled[-1]).min()
    assert np.abs(heard(coupling_Hz=(0.3, 0.3)) - PLAIN).max() < 0.004


def test_a_converter_has_steps():
    steps = heard(step_mV=(1.0, 1.0)) / 1e-3
    assert steps == pytest.approx(np.round(steps), abs=1e-9)
    assert np.abs(heard(step_mV=(1.0, 1.0)) - PLAIN).max() <= 0.5e-3 + 1e-12


def test_flicker_noise_has_its_size_and_most_of_it_is_slow():
    noise = 1e3 * (heard(flicker_mV=(2.0, 2.0)) - PLAIN)
    assert noise.std(axis=0) == pytest.approx([2.0, 2.0])
    power = (np.abs(np.fft.rfft(noise, axis=0)) ** 2).sum(axis=1)
    assert power[1:40].sum() > power[1000:].sum() * 2


def test_bursts_are_short_and_the_rest_is_clean():
    bursts = np.abs(heard(bursts_Hz=(2.0, 2.0), burst_mV=(8.0, 8.0)) - PLAIN).max(axis=1)
    assert 0.005 < (bursts > 0).mean() < 0.3
    assert 3e-3 < bursts[bursts > 0].mean() < 20e-3


def test_a_drift_goes_one_way_and_stays():
    drift = heard(drift_mV=(20.0, 20.0), drift_s=(0.1, 0.1)) - PLAIN
    assert 9e-3 < np.abs(drift[-1]).min() <= np.abs(drift[-1]).max() <= 20e-3
    assert (np.sign(drift[-1]) == np.sign(drift[-1, 0])).all()


def test_each_break_differs_from_none_in_one_respect():
    none = BREAKS["none"]
    for name, one in BREAKS.items():
        motion = one.population != none.population or one.kinds != ("slide", "hold")
        heard_so = one.front_end != none.front_end
        assert (name == "none") or motion != heard_so or one.kinds == ("slide", "hold"), name
        assert one.kinds


def test_an_unknown_range_is_no_break():
    with pytest.raises(ValueError, match="loudness"):
        front_end_break(loudness=Range(low=0, high=1))
