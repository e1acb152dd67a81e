"""Baselines on bursts made by hand: they alarm at the burst, armed, causally, above their floor."""

import numpy as np
import pytest

from rig.evaluation.scoring.baselines import (
    DB4,
    STATISTICS,
    BaselineSettings,
    baseline_reports,
    baseline_score,
    tuned_baselines,
    wavelet_details,
)
from rig.evaluation.scoring.seeds import FIRST_REPORTING_SEED

RATE_Hz = 1000.0
BURST_S = 1.0


def recorded(burst_mV: float, hump_mV: float = 30.0, noise_mV: float = 0.2) -> np.ndarray:
    """2 s of v_1 and v_2 in V: a slow hump that arms, and a 220 Hz burst of 10 ms on its way."""
    time = np.arange(2000) / RATE_Hz
    volts = noise_mV * np.random.default_rng(1).standard_normal((2000, 2))
    hump = hump_mV * np.exp(-(((time - 1.0) / 0.15) ** 2))
    within = (time >= BURST_S) & (time < BURST_S + 0.01)
    burst = burst_mV * np.sin(2 * np.pi * 220 * (time - BURST_S)) * within
    volts[:, 0] += (hump + burst) / 2
    volts[:, 1] -= (hump + burst) / 2
    return 1e-3 * volts


def settings(statistic, threshold=8.0, floor_mV=0.1) -> BaselineSettings:
    return BaselineSettings(statistic=statistic, threshold=threshold, floor_mV=floor_mV)


@pytest.mark.parametrize("statistic", STATISTICS)
def test_a_burst_on_a_hump_alarms_within_the_burst(statistic):
    (said,) = baseline_reports(recorded(20.0), RATE_Hz, settings(statistic))
    assert said.alarms_s.size == 1
    assert BURST_S < said.alarms_s[0] < BURST_S + 0.012
    assert said.armings_s.size == 1
    assert 0.6 < said.armings_s[0] < BURST_S


@pytest.mark.parametrize("statistic", STATISTICS)
def test_a_second_burst_is_reported_again_and_one_that_continues_is_not(statistic):
    volts = recorded(20.0)
    second = volts.copy()
    second[1200:1210] += volts[1000:1010] - volts[[1000]]
    (said,) = baseline_reports(second, RATE_Hz, settings(statistic))
    assert np.round(said.alarms_s, 1).tolist() == [1.0, 1.2]


@pytest.mark.parametrize("statistic", STATISTICS)
def test_nothing_alarms_without_the_burst_nor_without_the_hump(statistic):
    (without_burst,) = baseline_reports(recorded(0.0), RATE_Hz, settings(statistic))
    assert without_burst.alarms_s.size == 0
    volts = recorded(20.0, hump_mV=0.0)
    score = baseline_score(volts, RATE_Hz, settings(statistic))
    assert score[: round(1e3 * BURST_S)].max() == 0.0
    (said,) = baseline_reports(recorded(2.5, hump_mV=0.0), RATE_Hz, settings(statistic))
    assert said.alarms_s.size == 0
    assert said.armings_s.size == 0


@pytest.mark.parametrize("statistic", STATISTICS)
def test_scores_do_not_look_ahead(statistic):
    volts = recorded(20.0)
    whole = baseline_score(volts, RATE_Hz, settings(statistic))
    begun = baseline_score(volts[:1010], RATE_Hz, settings(statistic))
    np.testing.assert_allclose(begun, whole[:1010], atol=1e-9)


@pytest.mark.parametrize("statistic", [one for one in STATISTICS if one != "cusum"])
def test_where_there_is_no_noise_the_floor_is_the_measure(statistic):
    volts = recorded(20.0, noise_mV=1e-6)
    low = baseline_score(volts, RATE_Hz, settings(statistic, floor_mV=0.5)).max()
    high = baseline_score(volts, RATE_Hz, settings(statistic, floor_mV=1.0)).max()
    assert low == pytest.approx(2 * high)
    assert np.isfinite(low)


def test_a_factor_on_the_threshold_is_that_threshold():
    volts = recorded(20.0)
    own = settings("band power", threshold=8.0)
    _, twice = baseline_reports(volts, RATE_Hz, own, (1.0, 2.0))
    (directly,) = baseline_reports(volts, RATE_Hz, settings("band power", threshold=16.0))
    np.testing.assert_array_equal(twice.alarms_s, directly.alarms_s)
    (deaf,) = baseline_reports(volts, RATE_Hz, own, (100.0,))
    assert deaf.alarms_s.size == 0


def test_the_single_channel_never_hears_the_second():
    volts = recorded(20.0)
    changed = volts.copy()
    changed[:, 1] = 0.0
    own = settings("single channel")
    np.testing.assert_array_equal(
        baseline_score(volts, RATE_Hz, own), baseline_score(changed, RATE_Hz, own)
    )


def test_the_scaling_filter_is_orthonormal_and_has_four_vanishing_moments():
    taps = np.array(DB4)
    assert taps.sum() == pytest.approx(2**0.5, abs=1e-12)
    for shift in range(4):
        product = taps[2 * shift :] @ taps[: taps.size - 2 * shift]
        assert product == pytest.approx(float(shift == 0), abs=1e-11)
    time = np.arange(60.0)
    for power in range(4):
        for detail in wavelet_details((time / 60) ** power):
            assert np.abs(detail[25:]).max() < 1e-9


def test_the_details_of_an_impulse_are_the_published_filters():
    impulse = np.zeros(32)
    impulse[0] = 1.0
    first, second = wavelet_details(impulse)
    # dec_hi of "db4" in PyWavelets 1.8
    published = [-0.23037781, 0.71484657, -0.63088077, -0.02798377, 0.18703481, 0.03084138,
                 -0.03288301, -0.01059740]  # fmt: skip
    np.testing.assert_allclose(first[:8], published, atol=1e-8)
    assert second @ second == pytest.approx(1.0, abs=1e-9)


def test_a_recording_without_more_than_its_quiet_is_refused():
    with pytest.raises(ValueError, match=r"noise is judged in the first 0\.25 s"):
        baseline_score(np.zeros((250, 2)), RATE_Hz, settings("wavelet"))


def test_the_shipped_baselines_say_that_they_were_tuned_on_tuning_seeds():
    shipped = tuned_baselines().baselines
    assert [one.statistic for one in shipped] == list(STATISTICS)
    for one in shipped:
        assert one.tuned_on is not None
        assert one.tuned_on.end <= FIRST_REPORTING_SEED
