"""A known load on a calibrated film comes back from the voltage, within its stated interval."""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from recorded_film import FRONT_END, recorded_sweep

from rig.analysis.film.gain_curve import analyse
from rig.analysis.film.load import FilmLoadError, coefficients, film_model, load_from_voltage
from rig.instruments.calibration import FilmCalibration
from rig.physics.front_end import noise_rms
from rig.physics.vibrator import drawn_film, true_response

FILMS = 25
LOADS_PER_FILM = 8
DATE = datetime(2026, 11, 21, tzinfo=UTC)


def calibrated(film, seed, load_cell_error=0.0):
    """The record that a sweep of the film leads to."""
    f, responses, covariances, degrees = recorded_sweep(film, np.random.default_rng([seed, 1]))
    analysis = analyse(f, responses, covariances, degrees=degrees)
    return FilmCalibration.model_validate(
        {
            "sensor": f"film {seed}",
            "date": DATE,
            "valid_until": DATE + timedelta(days=90),
            "simulated": True,
            "source": {"run_uuid": "", "file": "", "simulated": True},
            **coefficients(analysis, load_cell_error),
            "lowest_frequency_Hz": float(f.min()),
            "highest_frequency_Hz": float(f.max()),
        }
    )


def outside_the_drops(record, random):
    """A frequency of the calibrated range, even over its logarithm, in no drop."""
    model = film_model(record)
    while True:
        f = math.exp(random.uniform(math.log(2.0), math.log(20e3)))
        if abs(float(model.loss_dB(np.array([f]))[0])) < 0.5:
            return f


def noisy_voltage(film, f, load, random, seconds=1.0):
    """What a lock-in of a second tells of the film's voltage, and its covariance."""
    rate = 500e3
    variance = noise_rms(FRONT_END, rate) ** 2 * 2 / (rate * seconds)
    noise = math.sqrt(variance) * (random.standard_normal() + 1j * random.standard_normal())
    return complex(true_response(f, *film)) * load + noise, variance * np.eye(2)


@pytest.fixture(scope="module")
def recovered():
    """Loads of 0.2 to 10 N on films that were calibrated before: stated and true."""
    cases = []
    for seed in range(FILMS):
        film = drawn_film(seed)
        record = calibrated(film, seed)
        random = np.random.default_rng([seed, 2])
        for _ in range(LOADS_PER_FILM):
            f = outside_the_drops(record, random)
            amplitude = math.exp(random.uniform(math.log(0.2), math.log(10.0)))
            load = amplitude * complex(np.exp(2j * np.pi * random.random()))
            voltage, covariance = noisy_voltage(film, f, load, random)
            cases.append((load_from_voltage(record, f, voltage, covariance), load))
    return cases


@pytest.mark.thorough
def test_the_interval_of_the_load_covers_it_in_95_percent(recovered):
    covered = sum(found.amplitude.covers(abs(load)) for found, load in recovered)
    assert 183 <= covered <= 200, covered


@pytest.mark.thorough
def test_the_interval_of_the_phase_covers_it_in_95_percent(recovered):
    covered = 0
    for found, load in recovered:
        off = np.angle(found.phasor / load, deg=True)
        covered += abs(off) <= (found.phase_deg.high - found.phase_deg.low) / 2
    assert 183 <= covered <= 200, covered


@pytest.mark.thorough
def test_the_load_is_known_to_a_percent_and_its_interval_is_no_excuse(recovered):
    errors = [abs(abs(found.phasor) / abs(load) - 1) for found, load in recovered]
    widths = [found.amplitude.standard_error / abs(load) for found, load in recovered]
    assert np.median(errors) < 0.005
    assert max(errors) < 0.03
    assert np.median(widths) < 0.01


@pytest.fixture(scope="module")
def record():
    return calibrated(drawn_film(3), 3)


def test_the_load_cells_error_widens_b_and_the_load(record):
    wider = calibrated(drawn_film(3), 3, load_cell_error=0.01)
    b, wide = record.b_dB, wider.b_dB
    assert wide.value == b.value
    added = math.sqrt(wide.standard_error**2 - b.standard_error**2)
    assert added == pytest.approx(0.01 * 20 / math.log(10))
    found = load_from_voltage(wider, 100.0, 0.01 + 0j, 1e-16 * np.eye(2)).amplitude
    assert found.standard_error / found.value == pytest.approx(0.01, rel=0.1)


@pytest.mark.parametrize(
    ("frequency", "voltage", "reported"),
    [
        (1.0, 1e-3, "outside the calibrated 2 to"),
        (30e3, 1e-3, "outside the calibrated"),
        (100.0, 0.0, "it contains no load"),
        (100.0, math.nan, "it contains no load"),
    ],
)
def test_what_cannot_be_determined_is_refused(record, frequency, voltage, reported):
    with pytest.raises(FilmLoadError, match=reported):
        load_from_voltage(record, frequency, complex(voltage), np.eye(2))


def test_in_a_drop_no_load_is_stated(record):
    drop = record.drops[0].frequency_Hz
    with pytest.raises(FilmLoadError, match=r"lies in the drop at .* which takes"):
        load_from_voltage(record, drop, 1e-3 + 0j, 1e-12 * np.eye(2))
