"""The order, rates and settling of a sweep's points."""

from __future__ import annotations

import itertools
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from procedures.sweep import Sweep
from procedures.sweep.point import SweepPointRun
from procedures.sweep.sampling import FittedRecord
from procedures.sweep.settings import SweepCondition, SweepSettings
from rig.analysis.response.complex_response import complex_response
from rig.analysis.response.sine_fit import fit_sine
from rig.core.errors import InstrumentError


def test_the_load_never_leaps_from_the_largest_to_the_smallest() -> None:
    """A leap of 50 rings above the small tone for longer than anything else."""
    points = Sweep(SweepSettings(loads_N=(0.2, 0.5, 1, 3, 10))).points()
    loads = [point.condition.load_N for point in points]
    assert max(max(a / b, b / a) for a, b in itertools.pairwise(loads)) < 4
    assert loads[:10] == [0.2, 0.5, 1, 3, 10, 10, 3, 1, 0.5, 0.2]


@pytest.mark.parametrize("frequency_Hz", [2.0, 2000.0, 3200.0, 13112.8, 20000.0])
def test_no_two_cycles_are_sampled_at_the_same_phases(frequency_Hz: float) -> None:
    """With 20 samples in each cycle the converter rounds every cycle alike: the amplitude of 1 V in
    steps of 4.9 mV was then wrong by up to 0.003 dB, ten times its stated error."""
    rate = SweepSettings().rate_at(frequency_Hz)
    assert rate >= 20 * frequency_Hz
    apart = 1.0
    for cycles in range(1, 20):
        samples = cycles * rate / frequency_Hz
        apart = min(apart, abs(samples - round(samples)))
    assert apart > 0.02


def amplitude_errors(rate: float) -> float:
    """Rms error of an amplitude of 1 V at 13 kHz on the 10 V range of 12 bits, in stated errors."""
    step, n, random = 20 / 4096, 1700, np.random.default_rng(0)
    errors = []
    for phase in np.linspace(0, 1, 50):
        t = np.arange(n) / rate
        exact = np.cos(2 * np.pi * (13112.8 * t + phase)) + 0.4e-3 * random.standard_normal(n)
        fit = fit_sine(step * np.round(exact / step), rate, 13112.8)
        errors.append((fit.amplitude - 1) / fit.standard_error)
    return float(np.sqrt(np.mean(np.square(errors))))


def test_rounding_of_the_converter_is_in_the_stated_error_of_the_amplitude() -> None:
    assert amplitude_errors(20 * 13112.8) > 3
    assert amplitude_errors(round(SweepSettings().rate_at(13112.8))) < 1.5


# --- settling -----------------------------------------------------------------------------------


class Clock:
    """A clock that a test moves."""

    def __init__(self) -> None:
        self.s = 0.0

    def now(self) -> float:
        """Time in s."""
        return self.s

    def sleep(self, seconds: float) -> None:
        """Wait."""
        self.s += seconds


def record(value: complex, n: int, noise: float, seed: int) -> FittedRecord:
    """A record of 600 Hz, the film's response being `value`."""
    random, rate = np.random.default_rng(seed), 64e3
    t = np.arange(n) / rate
    load = fit_sine(np.cos(2 * np.pi * 600 * t) + noise * random.standard_normal(n), rate, 600.0)
    film = (value * np.exp(2j * np.pi * 600 * t)).real + noise * random.standard_normal(n)
    voltage = fit_sine(film, rate, 600.0)
    nothing: Any = None
    return FittedRecord(nothing, load, voltage, complex_response(voltage, load))


def point(**settings: Any) -> tuple[SweepPointRun, Clock]:
    """A point at 600 Hz, whose records a test provides."""
    clock = Clock()
    run: Any = SimpleNamespace(clock=clock, settings=SweepSettings(**settings))
    memory: Any = SimpleNamespace(decay_s=None)
    found = SweepPointRun(run, SweepCondition(600.0, 1.0), memory)
    found._averages = lambda: False  # type: ignore[method-assign]
    found._sampler.wait = clock.sleep  # type: ignore[method-assign]
    return found, clock


def settle(found: SweepPointRun, clock: Clock, values: list[complex], noise: float) -> int:
    """Give records of 10 ms until the point has settled; how many it took."""
    for taken, value in enumerate(values, 1):
        found.kept.append(record(value, 640, noise, taken))
        clock.s += 0.01
        if found._is_settled():
            return taken
    return 0


def test_ringing_is_outlasted_until_noise_hides_a_fifth_of_it() -> None:
    """It halves from record to record, from 10 %; noise is 1e-4."""
    found, clock = point()
    settle(found, clock, [1 + 0.1 * 0.5**k for k in range(12)], 2e-3)
    assert found._outlasted
    begun_s = clock.now()
    left = 0.1 * 0.5 ** (begun_s / 0.01)
    error = math.sqrt(2) * 2e-3 * math.sqrt(2 / 640)
    assert left < 0.5 * error
    assert found.memory.decay_s == pytest.approx(0.01 / math.log(2), rel=0.5)


def test_ringing_below_the_noise_is_outlasted_as_long_as_the_latest_that_was_seen() -> None:
    found, clock = point()
    found.memory.decay_s = 0.01
    settle(found, clock, [1.0, 1.0], 1e-2)
    assert clock.now() > 0.03
    assert found._outlasted


def test_a_late_point_is_over_if_its_long_record_is_steady_in_itself() -> None:
    """0.2 N at 2 Hz: the two records before had differed by chance, after 20 s."""
    found, clock = point(longest_point_s=1.0)
    found.kept = [record(1.0, 640, 1e-3, 0), record(1.1, 6400, 1e-3, 1)]
    found._latest_N = 1.0
    clock.s = 2.0
    assert not found._agree(found._visible_difference())
    assert found._last_is_steady()


def test_a_restless_point_says_what_differed() -> None:
    """It said "0.2 N after 20 s, 0.2 N wanted"."""
    found, clock = point(longest_point_s=1.0)
    settle(found, clock, [1.0, 1.1], 1e-3)
    found._latest_N = 1.0
    with pytest.raises(InstrumentError, match=r"records differ by 9\.1 %, more than their noise"):
        found._refuse_restless()
    found._latest_N = 0.8
    with pytest.raises(InstrumentError, match=r"0\.8 N after 1 s, 1 N ± 1 % wanted"):
        found._refuse_restless()
