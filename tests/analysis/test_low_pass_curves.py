"""Curves and numbers of a low-pass, against filters whose answers are known."""

import numpy as np
import pytest

from rig.analysis.low_pass_curves import low_pass_curves, low_pass_summary
from rig.detector.low_pass import NAMED_LOW_PASSES, LowPass, LowPassSettings, design_low_pass

RATE = 1000.0


def mean_of(rows: int) -> LowPass:
    return LowPass(LowPassSettings(stop_dB=21), RATE, np.full(rows, 1 / rows))


def test_the_mean_of_two_rows():
    """Its gain is cos(π f / rate), its delay half a row."""
    low_pass = mean_of(2)
    curves, summary = low_pass_curves(low_pass), low_pass_summary(low_pass)
    f = curves.frequency_Hz[:-1]
    np.testing.assert_allclose(
        curves.gain_dB[:-1], 20 * np.log10(np.cos(np.pi * f / RATE)), atol=1e-6
    )
    np.testing.assert_allclose(curves.phase_deg[:-1], -180 * f / RATE, atol=1e-6)
    np.testing.assert_allclose(curves.group_delay_ms[:-1], 0.5, atol=1e-6)
    assert curves.step_response.tolist() == [0.5, 1.0]
    assert summary.half_power_Hz == pytest.approx(
        RATE / np.pi * np.arccos(10 ** (-3 / 20)), abs=0.01
    )
    assert summary.delay_ms == pytest.approx(0.5)
    assert summary.overshoot_percent == 0
    assert summary.settled_ms == 1.0


def test_the_first_lobe_of_a_mean_is_13_decibels_down():
    """Of many rows: the largest lobe beyond the main one, at 1.43 / length."""
    summary = low_pass_summary(mean_of(200))
    assert summary.largest_lobe_dB == pytest.approx(-13.26, abs=0.02)
    assert 4.0 < summary.lobes_from_Hz < 5.0
    assert summary.step_half_ms == pytest.approx(99.0, abs=0.01)


@pytest.mark.parametrize("name", NAMED_LOW_PASSES)
def test_a_designed_filter_has_what_was_asked_for(name):
    low_pass = design_low_pass(NAMED_LOW_PASSES[name], RATE)
    summary = low_pass_summary(low_pass)
    assert summary.half_power_Hz == pytest.approx(28.0, abs=0.01)
    assert summary.lag_deg == pytest.approx(low_pass.settings.lag_deg, abs=1e-3)
    assert summary.stop_Hz is not None
    beyond = np.linspace(summary.stop_Hz, RATE / 2, 5000)
    assert low_pass.level(beyond).max() <= -low_pass.settings.stop_dB + 1e-9
    assert low_pass.level(beyond[0] - 1.0)[0] > -low_pass.settings.stop_dB
    at_lobes = low_pass.level(summary.lobes_from_Hz)[0]
    assert at_lobes == pytest.approx(summary.largest_lobe_dB, abs=0.05)


def test_an_attenuation_that_is_never_reached_is_reported():
    assert low_pass_summary(mean_of(2)).stop_Hz is not None
    deep = LowPass(LowPassSettings(stop_dB=150), RATE, np.full(201, 1 / 201))
    assert low_pass_summary(deep).stop_Hz is None
