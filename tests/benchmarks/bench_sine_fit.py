"""What a sine fit costs and how near it comes to the Cramer-Rao bound: prints, judges nothing.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_sine_fit.py``.
"""

import math
import time

import numpy as np
import pytest
from measured import heading

from rig.analysis.response.complex_response import cramer_rao_amplitude, quantisation_rms
from rig.analysis.response.sine_fit import fit_sine, mains_lines, record_length
from rig.physics.modal import SineDrive
from rig.physics.vibrator import VibratorOutput, drawn_film, vibrator_line

pytestmark = [pytest.mark.benchmark, pytest.mark.short]


def median_ms(act, repeats=30):
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        act()
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times))


@pytest.mark.parametrize("n", [4_000, 40_000, 400_000])
def test_cost_of_a_fit(n):
    heading(f"fit_sine of {n} samples, 30 times")
    y = np.random.default_rng(0).standard_normal(n)
    cost = median_ms(lambda: fit_sine(y, 250e3, 1234.5, interference=mains_lines()))
    print(f"\nfit of {n} samples, 5 mains lines, 4 harmonics: {cost:.2f} ms")


@pytest.mark.parametrize("frequency", [2.0, 51.0, 500.0, 2000.0, 20000.0])
@pytest.mark.parametrize("step", [0.0, 20 / 2**16])
@pytest.mark.parametrize("assumed_mains", [50.0, 50.02])
def test_error_over_the_bound(frequency, step, assumed_mains):
    """The hum is at 50.02 Hz; the fit is given the nominal frequency or the measured one."""
    rate, sigma, hum, amplitude = 60e3, 3.46e-4, 1e-4, 5e-3
    n = record_length(frequency, rate, 0.02, interference=mains_lines(), maximum_duration=2.0)
    random = np.random.default_rng(1)
    t = np.arange(n) / rate
    errors = []
    for _ in range(300 if n < 10_000 else 100):
        phases = 2 * np.pi * random.random(2)
        y = amplitude * np.cos(2 * np.pi * frequency * t + phases[0])
        y += hum * np.cos(2 * np.pi * 50.02 * t + phases[1]) + sigma * random.standard_normal(n)
        codes = step * np.round(y / step) if step else y
        fit = fit_sine(codes, rate, frequency, interference=mains_lines(assumed_mains))
        errors.append(fit.amplitude - amplitude)
    bound = cramer_rao_amplitude(math.hypot(sigma, quantisation_rms(step)), n)
    ratio = math.sqrt(np.mean(np.square(errors))) / bound
    print(
        f"\n{frequency:7.0f} Hz, step {step * 1e6:3.0f} uV, mains taken as {assumed_mains} Hz, "
        f"n {n}: rms error / bound {ratio:.3f}"
    )


def test_cost_of_the_simulated_line():
    line = vibrator_line(*drawn_film(1))
    t = np.arange(40_000) / 250e3
    drive = SineDrive(1234.5, 1.0)
    cost = median_ms(
        lambda: line.evaluate(line.rest(), drive, t, [VibratorOutput.FILM, VibratorOutput.CELL])
    )
    print(f"\nvibrator line, 40000 samples of 2 outputs, {len(line.poles)} modes: {cost:.2f} ms")
