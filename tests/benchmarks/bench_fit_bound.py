"""The fit's error against the Cramer-Rao bound of the same record: at most 1.2 times.

Records are the World's own (film, hum at 50.02 Hz, noise, quantisation), at the sweep's own
settings and after its settling time; the fit is the sweep's. The bound is that of one tone of known
frequency in white noise, sigma sqrt(2 / n) for each of real and imaginary part, sigma from the
front end's noise and the converter's step: what no estimate of the tone can beat, hum or not.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_fit_bound.py``; `RIG_REPEATS=8` for
the first, the last and six frequencies between instead of all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from measured import heading, repeats

from drivers.simulated.instruments.u2300a_models import MODELS, codes_of_volts, volts_of_codes
from drivers.simulated.ports import Excitation
from drivers.simulated.world.mounted_film import FILM_TERMINAL, LOAD_CELL_TERMINAL
from drivers.simulated.world.settings import WorldSettings
from drivers.simulated.world.world import World
from procedures.sweep.settings import SweepSettings
from rig.analysis.film.frequency_plan import FrequencyPlanSettings, scan_frequencies_Hz
from rig.analysis.response.complex_response import quantisation_rms
from rig.analysis.response.sine_fit import fit_sine, mains_lines, record_length
from rig.physics.front_end import FrontEndSettings, noise_rms
from rig.physics.modal import SineDrive
from rig.physics.vibrator import VibratorOutput, drawn_film, vibrator_line

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(1800)]

DRAWS = 120
LARGEST_RATIO = 1.2
SETTINGS = SweepSettings()
AMPLITUDE_V, SETTLING_S, RANGE_V = 0.7, 0.2, 1.25
LEAST_S, LEAST_CYCLES, MOST_S = 0.1, 4, 20.0


@dataclass(frozen=True)
class Sampled:
    """A frequency and the record that is fitted there: whole cycles, a beat with every line."""

    condition: float
    rate_S_s: float
    samples: int


SHORTEST_GAP_S = 0.05
TERMINALS = {VibratorOutput.CELL: LOAD_CELL_TERMINAL, VibratorOutput.FILM: FILM_TERMINAL}


def chosen_points():
    """Every fifth point of the sweep, its ends, and all within 20 Hz of the first mains lines."""
    every = [sampled_at(f) for f in scan_frequencies_Hz(FrequencyPlanSettings())]
    near = [p for p in every if min(abs(p.condition - line) for line in mains_lines()) < 20]
    chosen = sorted({*every[::5], every[-1], *near}, key=lambda point: point.condition)
    wanted = min(len(chosen), repeats(len(chosen)))
    return [chosen[round(k)] for k in np.linspace(0, len(chosen) - 1, wanted)]


def sampled_at(frequency):
    rate = SETTINGS.rate_at(frequency)
    least = max(LEAST_S, LEAST_CYCLES / frequency)
    lines = mains_lines()
    n = record_length(frequency, rate, least, interference=lines, maximum_duration=MOST_S)
    return Sampled(frequency, rate, n)


def errors_at(point, daq, draws):
    """Complex errors of the fitted phasors, V, shape (draws, 2): load cell, film."""
    random = np.random.default_rng([7, round(1000 * point.condition)])
    seed = int(random.integers(1, 1000))
    world = World(WorldSettings(daq_model=daq), seed, slaved=True)
    response = vibrator_line(*drawn_film(seed)).steady_state(point.condition)[list(TERMINALS)]
    acquisition = point
    rate, n = float(int(acquisition.rate_S_s)), acquisition.samples
    skew = MODELS[daq].skew_s(2, int(rate), burst=True)
    tone = SineDrive()

    def drive_for(frequency, interval_us):
        """Excite the vibrator for a while; the phase runs on, as direct synthesis does."""
        nonlocal tone
        tone = SineDrive(frequency, AMPLITUDE_V, tone.phase_rad)
        world.excite(1, Excitation(True, "SIN", frequency, tone.amplitude, 0.0, 0.0), "bench")
        world.timeline.advance(interval_us)
        tone = tone.after(interval_us * 1e-6)

    errors = np.empty((draws, 2), complex)
    for draw in range(draws):
        world.announce(draw, round(point.condition))
        # From another frequency, as in a sweep, and at any phase of the mains.
        drive_for(0.97 * point.condition, round(1e6 * (SHORTEST_GAP_S + random.random())))
        drive_for(point.condition, round(1e6 * SETTLING_S))
        number = world.begin_acquisition()
        volts = world.volts(number, tuple(TERMINALS.values()), world.now_us, rate, 0, n, skew)
        truth = response * tone.phasor
        for k, range_V in enumerate((RANGE_V, RANGE_V)):
            errors[draw, k] = fitted(volts[:, k], range_V, daq, point, skew[k]) - truth[k]
    return errors


def fitted(volts, range_V, daq, point, delay_s):
    """The phasor the sweep would find after this converter."""
    bits = MODELS[daq].bits
    return fit_sine(
        volts_of_codes(codes_of_volts(volts, range_V, "BIP", bits), range_V, "BIP", bits),
        float(int(point.rate_S_s)),
        point.condition,
        interference=mains_lines(SETTINGS.mains_Hz),
        delay_s=delay_s,
    ).phasor


def bound(point, daq):
    """Least standard error of a phasor's real or imaginary part, V."""
    acquisition = point
    bits = MODELS[daq].bits
    step = 2 * RANGE_V / (2**bits - 1 if bits < 16 else 2**bits)
    noise = noise_rms(FrontEndSettings(), acquisition.rate_S_s)
    return math.hypot(noise, quantisation_rms(step)) * math.sqrt(2 / acquisition.samples)


@pytest.mark.parametrize("daq", ["U2542A", "U2331A"])
def test_error_of_the_fit_is_near_the_bound(daq):
    chosen = chosen_points()
    heading(f"fit_sine on World records, {daq}, {len(chosen)} frequencies x {DRAWS} draws")
    print("ratio of the rms error of a phasor's parts to the bound; bias in standard errors")
    ratios = np.empty((len(chosen), 2))
    for row, point in enumerate(chosen):
        errors = errors_at(point, daq, DRAWS)
        least = bound(point, daq)
        ratios[row] = np.sqrt(np.square(np.abs(errors)).mean(axis=0) / 2) / least
        bias = np.abs(errors.mean(axis=0)) / least * math.sqrt(DRAWS)
        print(
            f"{point.condition:9.2f} Hz, n = {point.samples:6d}: "
            f"load cell {ratios[row, 0]:.3f} (bias {bias[0]:.1f}), "
            f"film {ratios[row, 1]:.3f} (bias {bias[1]:.1f})"
        )
    print(f"median ratio {np.median(ratios):.3f}, largest {ratios.max():.3f}")
    too_large = [
        f"{point.condition:g} Hz: load cell {pair[0]:.2f}, film {pair[1]:.2f}"
        for point, pair in zip(chosen, ratios, strict=True)
        if pair.max() > LARGEST_RATIO
    ]
    assert not too_large, "; ".join(too_large)
