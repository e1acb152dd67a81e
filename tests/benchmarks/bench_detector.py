"""What the detectors cost, live and on files, with scipy's `lfilter` of the same taps beside them.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_detector.py``; keep the ratios.
"""

from __future__ import annotations

import resource
import time
from functools import cache

import numpy as np
import pytest
from measured import heading, row
from scipy.signal import lfilter

from rig.detector.detector import IncipientSlipDetector
from rig.detector.settings import named_detectors
from rig.evaluation.front_ends import through_front_end
from rig.evaluation.labelled_trials import labelled_trial
from rig.physics.population import PopulationSettings, Range, StripFrontEndSettings
from rig.physics.skin.condensed import build_skin

pytestmark = [pytest.mark.benchmark, pytest.mark.short, pytest.mark.timeout(3600)]

RATE_Hz = 1000.0
NAMES = ("rig", "paper-hp", "paper-literal")
REPEATS = 9


@cache
def recording(seconds: float) -> np.ndarray:
    """Volts (n, 2): slides and rolls of the skin, each through a front end, repeated."""
    population = PopulationSettings()
    skin = build_skin(population.skin)
    pieces = []
    for seed in range(12):
        for kind in ("slide", "roll", "hold", "tap"):
            trial = labelled_trial(skin, kind, seed, population)
            front_end = StripFrontEndSettings(noise_mV=Range(low=0.3, high=0.3))
            pieces.append(through_front_end(trial, front_end)[0])
    once = np.concatenate(pieces)
    return np.resize(once, (round(seconds * RATE_Hz), 2))


def p99(times_us: list[float]) -> float:
    """Of these the 99th percentile."""
    return float(np.quantile(times_us, 0.99))


@pytest.mark.parametrize("name", NAMES)
def test_a_chunk_of_ten_and_a_row(name: str) -> None:
    volts = recording(60)
    heading(f"{name}: 6000 chunks of 10 rows and 60000 rows")
    ten = IncipientSlipDetector(named_detectors()[name], RATE_Hz)
    one = IncipientSlipDetector(named_detectors()[name], RATE_Hz)
    taps = ten.low_pass.taps
    state = np.zeros((taps.size - 1, 2))
    tens, ones, filters = [], [], []
    for k in range(0, len(volts), 10):
        chunk = volts[k : k + 10]
        begin = time.perf_counter()
        ten.add(chunk)
        tens.append(1e6 * (time.perf_counter() - begin))
    for k in range(len(volts)):
        at = volts[k : k + 1]
        begin = time.perf_counter()
        one.add(at)
        between = time.perf_counter()
        _, state = lfilter(taps, 1.0, at, axis=0, zi=state)
        ones.append(1e6 * (between - begin))
        filters.append(1e6 * (time.perf_counter() - between))
    for what, times in (("chunk of 10", tens), ("one row", ones), ("lfilter, one row", filters)):
        row(what, times, "us")
        print(f"{what}: 99 % below {p99(times):.1f} us")
    print(f"p99 of a row to lfilter's: {p99(ones) / p99(filters):.2f}")


@pytest.mark.parametrize("name", NAMES)
def test_a_file(name: str) -> None:
    volts = recording(120)
    heading(f"{name}: a file of 120 s, {REPEATS} times, by turns with one pass of lfilter")
    taps = IncipientSlipDetector(named_detectors()[name], RATE_Hz).low_pass.taps
    ratios, rates = [], []
    for _ in range(REPEATS):
        detector = IncipientSlipDetector(named_detectors()[name], RATE_Hz)
        begin = time.perf_counter()
        detector.add(volts)
        between = time.perf_counter()
        lfilter(taps, 1.0, volts, axis=0)
        ratios.append((between - begin) / (time.perf_counter() - between))
        rates.append(120 / (between - begin))
    row("to lfilter", ratios, "times")
    row("to real time", rates, "times")


def test_memory_does_not_grow_with_length() -> None:
    heading("one hour at 1 kHz in chunks of 100 rows: largest memory of the process, MiB")
    volts = recording(60)
    detector = IncipientSlipDetector(named_detectors()["rig"], RATE_Hz)
    reported = 0
    for minute in range(60):
        for k in range(0, len(volts), 100):
            reported += len(detector.add(volts[k : k + 100]))
        if minute in (0, 9, 29, 59):
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            print(f"after minute {minute + 1}: {peak:.1f} MiB, {reported} events")
