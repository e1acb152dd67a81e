"""The predictive low-pass: the paper's numbers, other specifications, and what cannot be had."""

import math

import numpy as np
import pytest
from scipy import signal

from rig.detector.low_pass import (
    NAMED_LOW_PASSES,
    LowPassSettings,
    design_low_pass,
    least_lag_deg,
)

RATES_Hz = [500.0, 1000.0, 2000.0]


def test_the_papers_filter_is_3_db_down_at_28_hz_and_lags_9_degrees_at_1_hz():
    paper = design_low_pass(NAMED_LOW_PASSES["paper"], 1000.0)
    assert paper.level(28.0)[0] == pytest.approx(-3.0, abs=0.01)
    assert paper.lag_deg(1.0) == pytest.approx(9.0, abs=0.05)
    assert paper.response(0.0)[0].real == pytest.approx(1.0, abs=1e-12)
    assert paper.level(50.0)[0] < -55
    assert np.abs(np.roots(paper.taps)).max() <= 1 + 1e-4


@pytest.mark.parametrize("name", NAMED_LOW_PASSES)
@pytest.mark.parametrize("rate_Hz", RATES_Hz)
def test_the_design_follows_the_sampling_rate(name: str, rate_Hz: float):
    settings = NAMED_LOW_PASSES[name]
    filter_ = design_low_pass(settings, rate_Hz)
    assert filter_.level(settings.half_power_Hz)[0] == pytest.approx(-3.0, abs=0.01)
    assert filter_.lag_deg(settings.lag_Hz) == pytest.approx(settings.lag_deg, abs=0.05)


def test_response_and_group_delay_agree_with_scipy():
    filter_ = design_low_pass(NAMED_LOW_PASSES["fast"], 1000.0)
    frequency = np.array([0.5, 3.0, 12.0, 40.0])
    _, wanted = signal.freqz(filter_.taps, worN=frequency, fs=1000.0)
    _, delay = signal.group_delay((filter_.taps, [1.0]), w=frequency[:3], fs=1000.0)
    assert filter_.response(frequency) == pytest.approx(wanted, abs=1e-12)
    assert filter_.group_delay_s(frequency[:3]) * 1000 == pytest.approx(delay, rel=1e-3)


def test_the_step_response_ends_at_one():
    steps = design_low_pass(NAMED_LOW_PASSES["paper"], 1000.0).step_response()
    assert steps[-1] == pytest.approx(1.0, abs=1e-12)
    assert steps.max() < 1.2


def test_a_stop_band_may_be_asked_for_in_place_of_a_lag():
    settings = LowPassSettings(lag_deg=None, stop_Hz=60.0, stop_dB=50.0)
    filter_ = design_low_pass(settings, 1000.0)
    assert filter_.level(28.0)[0] == pytest.approx(-3.0, abs=0.01)
    assert filter_.level(np.linspace(60.0, 500.0, 2000)).max() <= -49.0
    assert filter_.lag_deg(1.0) >= least_lag_deg(28.0, 60.0, 50.0, 1000.0, 1.0)


@pytest.mark.parametrize(("order", "ripple_dB"), [(3, 0.001), (5, 0.01)])
def test_no_elliptic_filter_lags_less_than_bodes_bound(order: int, ripple_dB: float):
    """Minimum phase too, and steeper: the bound has to hold for filters of another family."""
    stop_dB, rate = 40.0, 1000.0
    sections = signal.ellip(order, ripple_dB, stop_dB, 25.0, fs=rate, output="sos")
    frequency = np.linspace(0.01, 499.99, 200_000)
    _, response = signal.sosfreqz(sections, worN=frequency, fs=rate)
    level = 20 * np.log10(np.abs(response))
    half_power = frequency[level > -3.0].max()
    stop = frequency[level > -stop_dB + 1e-6].max()
    _, at = signal.sosfreqz(sections, worN=[1.0], fs=rate)
    lag = -math.degrees(np.angle(at[0]))
    bound = least_lag_deg(half_power, stop, stop_dB, rate, 1.0)
    assert bound <= lag < 2 * bound


def test_the_bound_is_the_phase_of_the_ideal_magnitude():
    """Closed form against a numerical Hilbert transform of the same log magnitude."""
    points, rate = 1 << 20, 1000.0
    frequency = np.fft.fftfreq(points, 1 / rate)
    drop = np.where(np.abs(frequency) > 60.0, 40.0, np.where(np.abs(frequency) > 28.0, 3.0, 0.0))
    cepstrum = np.fft.ifft(-drop * math.log(10) / 20).real
    at = np.arange(1, points // 2)
    lag = math.degrees(2 * float(cepstrum[at] @ np.sin(2 * np.pi * 1.0 / rate * at)))
    assert least_lag_deg(28.0, 60.0, 40.0, rate, 1.0) == pytest.approx(lag, rel=1e-3)


def test_too_little_lag_is_refused_with_bodes_bound():
    with pytest.raises(ValueError, match=r"must be at least \d\.\d\d deg .* Bode's integral"):
        design_low_pass(LowPassSettings(lag_deg=2.0), 1000.0)


def designed(lag_deg: float, rate_Hz: float, stop_dB: float = 73.5) -> float:
    """Return the lag at 20 Hz of the filter for it, from the phase at many frequencies."""
    settings = LowPassSettings(lag_deg=lag_deg, lag_Hz=20.0, stop_dB=stop_dB)
    filter_ = design_low_pass(settings, rate_Hz)
    phase = np.unwrap(np.angle(filter_.response(np.linspace(0.0, 20.0, 2001))))
    assert filter_.level(28.0)[0] == pytest.approx(-3.0, abs=0.01)
    assert filter_.lag_deg(20.0) == pytest.approx(-math.degrees(phase[-1]), abs=1e-6)
    return filter_.lag_deg(20.0)


@pytest.mark.parametrize(
    ("lag_deg", "rate_Hz"), [(97.3, 2000.0), (100.0, 2000.0), (170.0, 1000.0), (198.0, 1000.0)]
)
def test_a_large_lag_is_that_of_the_design(lag_deg: float, rate_Hz: float):
    assert designed(lag_deg, rate_Hz) == pytest.approx(lag_deg, abs=1e-3)


@pytest.mark.thorough
def test_a_lag_of_more_than_a_turn_is_that_of_the_design():
    assert designed(400.0, 1000.0) == pytest.approx(400.0, abs=1e-3)


@pytest.mark.parametrize(
    ("lag_deg", "rate_Hz", "stop_dB"), [(50.0, 2000.0, 73.5), (59.0, 1000.0, 25.0)]
)
def test_the_least_lag_of_the_message_can_be_had(lag_deg: float, rate_Hz: float, stop_dB: float):
    with pytest.raises(ValueError, match="must be at least") as refused:
        designed(lag_deg, rate_Hz, stop_dB)
    least = float(str(refused.value).split("must be at least ")[1].split()[0])
    assert designed(least, rate_Hz, stop_dB) == pytest.approx(least, abs=1e-3)


def test_too_steep_a_filter_is_refused():
    with pytest.raises(ValueError, match=r"lag_deg 60 deg .* more than 20001 taps at 1000 Hz"):
        design_low_pass(LowPassSettings(lag_deg=60.0), 1000.0)
    with pytest.raises(ValueError, match=r"^half_power_Hz 28 Hz and stop_dB 73.5 dB would need"):
        design_low_pass(LowPassSettings(), 1e9)


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({"stop_Hz": 50.0}, "lag_deg 9.0 and stop_Hz 50.0: give exactly one"),
        ({"lag_deg": None}, "lag_deg None and stop_Hz None: give exactly one"),
        ({"lag_Hz": 30.0}, "lag_Hz 30 Hz must be below half_power_Hz 28 Hz"),
        ({"lag_deg": None, "stop_Hz": 20.0}, "stop_Hz 20 Hz must be above half_power_Hz 28 Hz"),
    ],
)
def test_contradictory_specifications_are_refused_by_name(values: dict[str, float], named: str):
    with pytest.raises(ValueError, match=named):
        LowPassSettings.model_validate(values)


def test_a_rate_below_twice_the_half_power_frequency_is_refused():
    with pytest.raises(ValueError, match="half_power_Hz 28 Hz must be below half the sampling"):
        design_low_pass(LowPassSettings(), 50.0)
