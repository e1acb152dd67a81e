"""The sine fit: unbiased, its stated errors right, near the Cramer-Rao bound, mains or not."""

import math

import numpy as np
import pytest

from rig.analysis.response.complex_response import cramer_rao_amplitude, quantisation_rms
from rig.analysis.response.sine_fit import (
    RecordError,
    fit_sine,
    mains_lines,
    record_length,
    whole_cycles,
)

RATE = 10e3
DRAWS = 1500


def tone(phasor, frequency, n, rate=RATE, delay_s=0.0):
    t = np.arange(n) / rate + delay_s
    return (phasor * np.exp(2j * np.pi * frequency * t)).real


def fits(frequency, n, sigma, phasor=0.4 - 0.9j, hum=0.0, step=0.0, rate=RATE, draws=DRAWS):
    """Fits of the same tone in ``draws`` records of fresh noise (and hum of fresh phase)."""
    random = np.random.default_rng([int(frequency), n])
    for _ in range(draws):
        y = 2.5 + tone(phasor, frequency, n, rate) + sigma * random.standard_normal(n)
        y += tone(hum * np.exp(2j * np.pi * random.random()), 50.0, n, rate)
        if step:
            y = step * np.round(y / step)
        yield fit_sine(y, rate, frequency, interference=mains_lines())


def relative_to_bound(found, phasor, sigma):
    errors = np.array([abs(fit.phasor) for fit in found]) - abs(phasor)
    return math.sqrt(np.mean(errors**2)) / cramer_rao_amplitude(sigma, found[0].n)


@pytest.mark.thorough
@pytest.mark.parametrize("frequency", [53.0, 4000.0])
def test_phasor_is_unbiased_and_its_covariance_is_its_scatter(frequency):
    n = record_length(frequency, RATE, 0.05, interference=mains_lines(), maximum_duration=1.0)
    phasor = 0.4 - 0.9j
    found = list(fits(frequency, n, 0.3, phasor, hum=0.5))
    errors = np.array([fit.phasor - phasor for fit in found])
    expected = np.mean([fit.covariance for fit in found], axis=0)
    scatter = np.cov([errors.real, errors.imag])
    assert abs(errors.mean()) < 3.5 * math.sqrt(np.trace(scatter) / DRAWS)
    assert np.sqrt(np.diag(scatter) / np.diag(expected)) == pytest.approx([1, 1], abs=0.07)
    pulls = [(fit.amplitude - abs(phasor)) / fit.standard_error for fit in found]
    assert np.std(pulls) == pytest.approx(1.0, abs=0.07)
    offsets = np.array([fit.offset for fit in found])
    assert offsets.mean() == pytest.approx(2.5, abs=0.02)


@pytest.mark.parametrize("frequency", [2.0, 46.0, 51.5, 300.0, 786.1, 4900.0])
@pytest.mark.parametrize("step", [0.0, 0.2], ids=["fine", "quantised"])
@pytest.mark.thorough
def test_error_is_within_a_fifth_of_the_cramer_rao_bound(frequency, step):
    sigma, phasor = 0.2, 1.0j
    n = record_length(frequency, RATE, 0.02, interference=mains_lines(), maximum_duration=1.0)
    draws = 600 if n < 5000 else 300
    found = list(fits(frequency, n, sigma, phasor, hum=0.3, step=step, draws=draws))
    whole = math.hypot(sigma, quantisation_rms(step))
    assert 0.85 < relative_to_bound(found, phasor, whole) < 1.2


def test_mains_near_the_tone_bends_it_only_if_it_is_not_fitted():
    n = record_length(51.0, RATE, 0.1, interference=mains_lines(), maximum_duration=2.0)
    y = tone(1.0, 51.0, n) + tone(0.5j, 50.0, n) + tone(0.2, 150.0, n)
    beside = fit_sine(y, RATE, 51.0, interference=mains_lines())
    assert beside.phasor == pytest.approx(1.0, abs=1e-9)
    assert beside.unresolved_Hz == ()
    assert set(mains_lines()) == set(beside.fitted_Hz)
    alone = fit_sine(y[: n // 2], RATE, 51.0)
    assert abs(alone.phasor - 1.0) > 0.1


def test_a_line_the_record_cannot_separate_is_named():
    n = whole_cycles(50.3, RATE, 1.0)
    near = fit_sine(tone(1.0, 50.3, n), RATE, 50.3, interference=mains_lines())
    assert near.unresolved_Hz == (50.0,)
    on_it = fit_sine(tone(1.0, 50.0, 10_000), RATE, 50.0, interference=mains_lines())
    assert on_it.unresolved_Hz == (50.0,)
    assert 100.0 in on_it.fitted_Hz, "the tone's own second harmonic falls on a mains line"
    assert math.isnan(on_it.harmonics[0].real)


def test_a_short_record_leaves_out_what_would_cost_the_tone():
    n = whole_cycles(786.0, RATE, 2e-3)
    fit = fit_sine(tone(1.0, 786.0, n), RATE, 786.0, interference=mains_lines())
    assert len(fit.left_out_Hz) >= 3
    assert fit.phasor == pytest.approx(1.0, abs=1e-9)


def beside_wandering_mains(hum, draws=400, sigma=0.05):
    """Fits of 51 Hz in records of 1 s with mains at 50.02 Hz, fitted as if it were at 50 Hz."""
    n = record_length(51.0, RATE, 0.1, interference=mains_lines(), maximum_duration=2.0)
    random = np.random.default_rng(8)
    for _ in range(draws):
        y = tone(1.0, 51.0, n) + sigma * random.standard_normal(n)
        y += tone(hum * np.exp(2j * np.pi * random.random()), 50.02, n)
        yield fit_sine(y, RATE, 51.0, interference=mains_lines())


@pytest.mark.thorough
def test_mains_a_beat_away_is_followed_to_its_true_frequency():
    found = list(beside_wandering_mains(hum=0.1))
    assert relative_to_bound(found, 1.0, 0.05) < 1.2
    lines = np.array([fit.fitted_Hz[0] for fit in found])
    assert lines.mean() == pytest.approx(50.02, abs=0.001)
    pulls = [(fit.amplitude - 1.0) / fit.standard_error for fit in found]
    assert np.std(pulls) == pytest.approx(1.0, abs=0.12)
    assert abs(np.mean(pulls)) < 3.5 / math.sqrt(len(pulls))


def test_mains_lost_in_the_noise_is_taken_at_its_nominal_frequency():
    found = list(beside_wandering_mains(hum=0.001))
    assert {fit.fitted_Hz[0] for fit in found} == {50.0}
    assert relative_to_bound(found, 1.0, 0.05) < 1.2


def test_noise_alone_has_an_amplitude_compatible_with_zero():
    found = list(fits(333.0, 2000, 1.0, phasor=0.0))
    chi2 = [
        np.array([f.phasor.real, f.phasor.imag])
        @ np.linalg.inv(f.covariance)
        @ np.array([f.phasor.real, f.phasor.imag])
        for f in found
    ]
    assert np.mean(chi2) == pytest.approx(2.0, abs=0.2)
    assert np.mean(np.array(chi2) > 5.99) == pytest.approx(0.05, abs=0.02)
    assert np.mean([f.signal_to_noise_dB for f in found]) < -25


def test_phase_refers_to_the_first_sample_and_to_no_channel_delay():
    phasor, delay = 0.7 * np.exp(1.1j), 3.7e-6
    y = tone(phasor, 4321.0, 5000, rate=250e3, delay_s=delay)
    fit = fit_sine(y, 250e3, 4321.0, delay_s=delay)
    assert fit.phasor == pytest.approx(phasor, abs=1e-10)
    assert fit.block_phasors == pytest.approx(np.full(8, phasor), abs=1e-10)
    late = fit_sine(y, 250e3, 4321.0)
    assert np.angle(late.phasor / phasor) == pytest.approx(2 * np.pi * 4321.0 * delay)


def test_a_long_record_keeps_its_phase():
    n = 2_000_000
    y = tone(1.0 + 0.5j, 20_000.0, n, rate=250e3)
    fit = fit_sine(y, 250e3, 20_000.0, interference=mains_lines())
    assert fit.phasor == pytest.approx(1.0 + 0.5j, abs=1e-9)
    assert fit.residual_rms < 1e-8


def test_distortion_is_of_the_harmonics_and_not_of_the_noise():
    n = whole_cycles(120.0, RATE, 1.0)
    y = tone(2.0, 120.0, n) + tone(0.06j, 240.0, n) + tone(0.08, 480.0, n)
    y += 1e-3 * np.random.default_rng(1).standard_normal(n)
    fit = fit_sine(y, RATE, 120.0, interference=mains_lines())
    assert fit.harmonic_distortion == pytest.approx(0.05, rel=1e-2)
    assert fit.residual_rms == pytest.approx(1e-3, rel=0.05)
    assert fit.signal_to_noise_dB == pytest.approx(
        20 * math.log10(2 / math.sqrt(2) / 1e-3), abs=0.5
    )
    above = fit_sine(tone(1.0, 3000.0, 1000), RATE, 3000.0)
    assert math.isnan(above.harmonic_distortion), "no harmonic of 3 kHz is below 5 kHz"


def test_records_are_whole_cycles_to_a_fraction_of_a_sample():
    for frequency in np.geomspace(2, 20_000, 60):
        n = whole_cycles(frequency, 250e3, 0.01)
        cycles = n * frequency / 250e3
        assert n / 250e3 >= 0.01 - 0.5 / 250e3
        assert abs(cycles - round(cycles)) * 250e3 / frequency <= 0.5
        assert n <= max(1.06 * 0.01 * 250e3, 1.01 * 250e3 / frequency) + 250e3 / frequency
    assert whole_cycles(100.0, RATE, 0.05) == 500


def test_record_length_waits_for_the_beat_if_it_may():
    lines = mains_lines()
    waited = record_length(49.0, RATE, 0.05, interference=lines, maximum_duration=2.0)
    assert 1.0 <= waited / RATE < 1.1
    in_a_hurry = record_length(49.0, RATE, 0.05, interference=lines, maximum_duration=0.5)
    assert in_a_hurry / RATE < 0.1


@pytest.mark.parametrize(
    ("samples", "frequency", "reason"),
    [
        (np.full(100, np.nan), 500.0, "not finite"),
        (np.r_[np.zeros(99), np.inf], 500.0, "1 of 100 samples are not finite"),
        (np.zeros(10), 4000.0, "too short"),
        (np.zeros(100), 50.0, "0.50 cycles, one needed"),
        (np.zeros(100), 5000.0, "not below half the rate"),
        (np.zeros(100), 6000.0, "not below half the rate"),
        (np.zeros(100), 4990.0, "image"),
        (np.zeros(100), -5.0, "positive"),
        (np.zeros(100), np.nan, "positive"),
        (np.zeros((100, 2)), 500.0, "shape"),
    ],
)
def test_what_cannot_be_fitted_is_refused_by_reason(samples, frequency, reason):
    with pytest.raises(RecordError, match=reason):
        fit_sine(samples, RATE, frequency)


def test_what_a_line_that_is_not_fitted_leaks_is_in_the_leakage():
    """53 Hz in one cycle beside weak mains: the mains cannot be distinguished from the tone."""
    rate, frequency, hum = 64e3, 53.0, 1e-3
    n = whole_cycles(frequency, rate, 0.0)
    t = np.arange(n) / rate
    errors, variances = [], []
    for phase in np.linspace(0, 2 * np.pi, 40, endpoint=False):
        y = np.cos(2 * np.pi * frequency * t) + hum * np.cos(2 * np.pi * 50.0 * t + phase)
        found = fit_sine(y, rate, frequency, interference=(50.0,), bounds={50.0: hum})
        assert found.left_out_Hz == (50.0,)
        errors.append(found.phasor - 1)
        variances.append(np.diag(found.leakage))
    spread = np.array([np.square(np.real(errors)).mean(), np.square(np.imag(errors)).mean()])
    assert np.mean(variances, axis=0) == pytest.approx(spread, rel=0.01)


def test_a_line_that_is_fitted_leaks_nothing():
    t = np.arange(64000) / 64e3
    found = fit_sine(
        np.cos(2 * np.pi * 53.0 * t), 64e3, 53.0, interference=(50.0,), bounds={50.0: 1.0}
    )
    assert not found.left_out_Hz
    assert np.all(found.leakage == 0)
