"""The vibrator line: what the load cell sees, what the film sees, and what differs per film."""

import numpy as np
import pytest

from rig.physics import pvdf
from rig.physics.front_end import FrontEndSettings, mains_hum, noise_rms
from rig.physics.pvdf import SWEEP_FILM
from rig.physics.vibrator import (
    VibratorOutput,
    VibratorSettings,
    drawn_film,
    true_response,
    vibrator_line,
)


def decibels(response):
    return 20 * np.log10(np.abs(response))


def test_the_generator_can_hold_10_newton_from_2_to_20000_hertz():
    line = vibrator_line(VibratorSettings(), SWEEP_FILM)
    load = np.abs(line.steady_state(np.geomspace(2, 20000, 400))[:, VibratorOutput.LOAD])
    assert load.min() > 1.0, "10 V peak from the generator give at least 10 N peak"
    assert load.min() > 0.2 * np.abs(line.steady_state(1000.0)[VibratorOutput.LOAD])
    assert load.max() < 4.0


def test_film_over_load_is_the_truth_at_every_frequency():
    for seed in range(5):
        vibrator, film = drawn_film(seed)
        f = np.geomspace(2, 20000, 200)
        columns = vibrator_line(vibrator, film).steady_state(f)
        ratio = columns[:, VibratorOutput.FILM] / columns[:, VibratorOutput.LOAD]
        assert ratio == pytest.approx(true_response(f, vibrator, film), rel=1e-8)
        cell = columns[:, VibratorOutput.CELL] / columns[:, VibratorOutput.LOAD]
        assert cell == pytest.approx(np.full(f.shape, 0.1), rel=1e-12)


def test_drops_are_in_the_film_force_and_not_in_the_load():
    vibrator = VibratorSettings()
    line = vibrator_line(vibrator, SWEEP_FILM)
    for drop in vibrator.drops:
        load, _, film_force, _ = line.steady_state(drop.frequency_Hz)
        assert -14.0 < decibels(film_force / load) < -12.5
        around = line.steady_state(drop.frequency_Hz * np.array([0.97, 1.0, 1.03]))[
            :, VibratorOutput.LOAD
        ]
        assert np.ptp(decibels(around)) < 0.6


def test_a_slow_load_cell_bends_what_it_reports():
    slow = VibratorSettings(cell_bandwidth_Hz=20e3)
    columns = vibrator_line(slow, SWEEP_FILM).steady_state(20e3)
    assert decibels(columns[VibratorOutput.CELL] / columns[VibratorOutput.LOAD]) == pytest.approx(
        -23.01, abs=0.01
    )


def test_films_are_drawn_over_the_whole_of_their_ranges_and_no_further():
    films = [drawn_film(seed) for seed in range(400)]
    nominal = pvdf.level_at_one_hertz(SWEEP_FILM)
    ranges = {
        "level": ([pvdf.level_at_one_hertz(c) - nominal for _, c in films], -3, 3),
        "corner": ([pvdf.corner_frequency(c) for _, c in films], 1000, 4000),
    }
    for index, centre in enumerate((500, 2400, 9000)):
        drops = [v.drops[index] for v, _ in films]
        ranges[f"frequency {index}"] = ([d.frequency_Hz / centre for d in drops], 0.8, 1.2)
        ranges[f"Q {index}"] = ([d.pole_Q for d in drops], 5, 20)
        ranges[f"depth {index}"] = ([d.depth_dB for d in drops], 8, 18)
    for name, (values, low, high) in ranges.items():
        assert low - 1e-9 <= min(values) < low + 0.05 * (high - low), name
        assert high - 0.05 * (high - low) < max(values) <= high + 1e-9, name
    octave_up = np.mean(np.array(ranges["corner"][0]) > 2000)
    assert octave_up == pytest.approx(0.5, abs=0.08), "log-uniform"


def test_a_seed_is_a_film():
    assert drawn_film(7) == drawn_film(7)
    assert drawn_film(7) != drawn_film(8)


def test_noise_folds_below_twice_its_bandwidth_and_keeps_its_density_above():
    settings = FrontEndSettings()
    assert noise_rms(settings, 10e3) == pytest.approx(2e-6 * np.sqrt(30e3))
    assert noise_rms(settings, 60e3) == noise_rms(settings, 10e3)
    assert noise_rms(settings, 250e3) == pytest.approx(2e-6 * np.sqrt(125e3))


def test_hum_is_in_volts_at_its_own_frequency():
    t = np.arange(100_000) / 1000.0
    hum = mains_hum(FrontEndSettings(), t, 0.3)
    assert hum.max() == pytest.approx(1e-4, rel=1e-3)
    assert np.argmax(np.abs(np.fft.rfft(hum))) == 5002
