"""The response of two fits: value, stated errors, coherence, refusals."""

import math

import numpy as np
import pytest

from rig.analysis.response.complex_response import (
    complex_response,
    cramer_rao_amplitude,
    cramer_rao_duration,
    cramer_rao_gain_dB,
    cramer_rao_phase_deg,
    quantisation_rms,
)
from rig.analysis.response.sine_fit import RecordError, fit_sine
from rig.physics.front_end import FrontEndSettings, noise_rms
from rig.physics.modal import SineDrive
from rig.physics.vibrator import VibratorOutput, drawn_film, true_response, vibrator_line

RATE = 250e3
FREQUENCY = 1000.0
N = 2500
LOAD = 0.8 * np.exp(0.3j)
TRUTH = 0.15 * np.exp(1.9j)


def wave(phasor, n=N):
    return (phasor * np.exp(2j * np.pi * FREQUENCY * np.arange(n) / RATE)).real


def measured(random, noise_V=2e-3, noise_N=0.02, load=LOAD):
    voltage = wave(TRUTH * load) + noise_V * random.standard_normal(N)
    force = wave(load) + noise_N * random.standard_normal(N)
    return complex_response(fit_sine(voltage, RATE, FREQUENCY), fit_sine(force, RATE, FREQUENCY))


@pytest.mark.thorough
def test_stated_errors_of_gain_and_phase_are_their_scatter():
    random = np.random.default_rng(11)
    responses = [measured(random) for _ in range(1500)]
    gain = [(r.gain_dB - 20 * math.log10(0.15)) / r.gain_standard_error_dB for r in responses]
    phase = [(r.phase_deg - math.degrees(1.9)) / r.phase_standard_error_deg for r in responses]
    for pulls in (gain, phase):
        assert abs(np.mean(pulls)) < 0.1
        assert np.std(pulls) == pytest.approx(1.0, abs=0.07)


def test_errors_combine_both_channels():
    response = measured(np.random.default_rng(0))
    parts = [
        cramer_rao_gain_dB(2e-3, abs(TRUTH * LOAD), N),
        cramer_rao_gain_dB(0.02, abs(LOAD), N),
    ]
    assert response.gain_standard_error_dB == pytest.approx(math.hypot(*parts), rel=0.1)
    degrees = [
        cramer_rao_phase_deg(2e-3, abs(TRUTH * LOAD), N),
        cramer_rao_phase_deg(0.02, abs(LOAD), N),
    ]
    assert response.phase_standard_error_deg == pytest.approx(math.hypot(*degrees), rel=0.1)


def test_coherence_falls_when_the_channels_do_not_share_the_tone():
    random = np.random.default_rng(2)
    assert measured(random, 1e-4, 1e-3).coherence > 0.9999
    noise = [
        fit_sine(random.standard_normal(N) + wave(load), RATE, FREQUENCY) for load in (0.0, 1.0)
    ]
    assert complex_response(noise[0], noise[1]).coherence < 0.7
    one_cycle = [fit_sine(wave(1.0, 250), RATE, FREQUENCY)] * 2
    assert math.isnan(complex_response(*one_cycle).coherence)


def test_the_vibrator_line_is_recovered_through_noise_and_quantisation():
    vibrator, film = drawn_film(4)
    line = vibrator_line(vibrator, film)
    random = np.random.default_rng(4)
    pulls = []
    for frequency in (37.0, 95.0, 510.0, 2000.0, 9000.0, 20000.0):
        drive = SineDrive(frequency, 0.7, 0.4)
        t = 2.0 + np.arange(round(RATE * 20 / frequency)) / RATE
        clean = line.evaluate(line.rest(), drive, t, [VibratorOutput.FILM, VibratorOutput.CELL])
        step = 20 / 2**16
        noisy = clean + noise_rms(FrontEndSettings(), RATE) * random.standard_normal(clean.shape)
        codes = step * np.round(noisy / step)
        voltage = fit_sine(codes[:, 0], RATE, frequency)
        load = fit_sine(codes[:, 1] / vibrator.cell_sensitivity_V_N, RATE, frequency)
        response = complex_response(voltage, load)
        truth = complex(true_response(frequency, vibrator, film))
        error = response.gain_dB - 20 * math.log10(abs(truth))
        pulls.append(error / response.gain_standard_error_dB)
        turned = math.degrees(np.angle(response.value / truth))
        pulls.append(turned / response.phase_standard_error_deg)
    assert max(np.abs(pulls)) < 3.5
    assert 0.4 < np.std(pulls) < 1.6


def test_no_load_and_different_frequencies_are_refused():
    random = np.random.default_rng(3)
    silent = fit_sine(random.standard_normal(N), RATE, FREQUENCY)
    with pytest.raises(RecordError, match="no load at 1000 Hz"):
        complex_response(silent, silent)
    other = fit_sine(wave(1.0), RATE, 1100.0)
    with pytest.raises(RecordError, match="1000 Hz, load at 1100 Hz"):
        complex_response(fit_sine(wave(1.0), RATE, FREQUENCY), other)


def test_bounds_are_consistent_with_each_other():
    duration = cramer_rao_duration(0.7e-3, 0.25e-3, RATE, 0.05)
    n = round(duration * RATE)
    assert cramer_rao_gain_dB(0.7e-3, 0.25e-3, n) == pytest.approx(0.05, rel=1e-3)
    assert cramer_rao_amplitude(1.0, 200) == pytest.approx(0.1)
    codes = np.random.default_rng(1).uniform(-50, 50, 20000)
    assert np.std(codes - np.round(codes)) == pytest.approx(quantisation_rms(1.0), rel=0.02)
