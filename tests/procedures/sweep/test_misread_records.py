"""A sample that does not belong to its record: once it is misread, always it is the signal."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from procedures.sweep import sampling
from procedures.sweep.sampling import RecordSampler
from rig.analysis.response.sine_fit import fit_sine

RATE_Hz, TONE_Hz, SAMPLES = 10_000.0, 100.0, 2000


def record(spike: float, at: int = 1234) -> np.ndarray:
    """A tone of 1 in noise of 1e-3, the sample number `at` of which is off by `spike`."""
    t = np.arange(SAMPLES) / RATE_Hz
    samples = np.cos(2 * np.pi * TONE_Hz * t)
    samples += np.random.default_rng(1).normal(scale=1e-3, size=SAMPLES)
    samples[at] += spike
    return samples


def taken(
    spikes: Iterator[float],
    monkeypatch: pytest.MonkeyPatch,
    at: int = 1234,
    after_change: bool = False,
) -> tuple[int, float, list[str]]:
    """The number of records that were taken, each with the next spike at its sample number `at`,
    the lone residual of the one that was used, and what was said."""
    reported: list[str] = []
    count = 0

    def acquire(acquisition: object) -> np.ndarray:
        nonlocal count
        count += 1
        return record(next(spikes), at)

    def event(level: str, code: str, text: str) -> None:
        reported.append(text)

    run = SimpleNamespace(bench=SimpleNamespace(daq=SimpleNamespace(acquire=acquire)), event=event)
    sampler: Any = RecordSampler.__new__(RecordSampler)
    sampler.run, sampler.physics_s, sampler.largest_load_N = run, 0.0, 0.0
    sampler._begins_with_change = after_change
    sampler.condition = SimpleNamespace(frequency_Hz=TONE_Hz)
    learn = SimpleNamespace(learn=lambda *values: None)
    sampler.memory = SimpleNamespace(vibrator=learn, film=learn, drive_V=1.0)
    sampler._acquisition = lambda *needs: SimpleNamespace(samples=SAMPLES, rate_S_s=RATE_Hz)
    sampler._overloaded = lambda record: False
    sampler._fit = lambda record, *rest: fit_sine(record, RATE_Hz, TONE_Hz)
    monkeypatch.setattr(sampling, "refuse_overload", lambda run, load: None)
    found = sampler.take(None, only_load=True)
    return count, found.load.lone_residual, reported


def test_a_record_without_such_a_sample_is_taken_once(monkeypatch: pytest.MonkeyPatch) -> None:
    count, largest, reported = taken(itertools.repeat(0.0), monkeypatch)
    assert (count, reported) == (1, [])
    assert largest < 5e-3


def test_one_misread_record_is_taken_again(monkeypatch: pytest.MonkeyPatch) -> None:
    count, largest, reported = taken(iter([0.25, 0.0]), monkeypatch)
    assert count == 2
    assert largest < 5e-3
    assert reported == ["1 record at 100 Hz repeated: a sample did not belong to it"]


def test_a_signal_that_is_disturbed_in_every_record_is_used_and_said(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    count, largest, reported = taken(itertools.repeat(0.25), monkeypatch)
    assert count == 3
    assert largest > 0.2
    (text,) = reported
    assert "3 records at 100 Hz in a row have samples far beyond their noise" in text
    assert "load_cell, film" in text


@pytest.mark.parametrize("at", [0, 1, SAMPLES - 1])
def test_a_misread_sample_at_the_ends_of_a_record_is_noticed(at: int) -> None:
    """Found by an attack: the first sample of a block has one bit turned over."""
    assert fit_sine(record(0.25, at), RATE_Hz, TONE_Hz).lone_residual > 0.2


def test_the_first_sample_counts_unless_the_drive_has_just_changed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A quick transient looks like a misread sample; a clean sweep took every eighth record of a
    high frequency again."""
    count, _, reported = taken(iter([0.25, 0.0]), monkeypatch, at=0)
    assert (count, len(reported)) == (2, 1)
    count, largest, reported = taken(itertools.repeat(0.25), monkeypatch, at=0, after_change=True)
    assert (count, reported) == (1, [])
    assert largest > 0.2
    count, _, reported = taken(iter([0.25, 0.0]), monkeypatch, at=1234, after_change=True)
    assert (count, len(reported)) == (2, 1)


@pytest.mark.parametrize("samples_in_a_period", [2.2, 3.0, 4.0, 5.3])
def test_ringing_from_the_first_sample_on_is_no_misread_one(samples_in_a_period: float) -> None:
    turns = np.arange(SAMPLES) / samples_in_a_period
    ringing = np.exp(-np.arange(SAMPLES) / 10) * np.cos(2 * np.pi * turns)
    found = fit_sine(record(0.0) + 0.5 * ringing, RATE_Hz, TONE_Hz)
    assert found.lone_residual == 0.0


def test_a_transient_is_no_misread_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ringing at the begin of a record, a hundred times the rms of its residual."""
    t = np.arange(SAMPLES) / RATE_Hz
    ringing = np.exp(-t / 1e-3) * np.cos(2 * np.pi * 1.9e3 * t)
    found = fit_sine(record(0.0) + 0.5 * ringing, RATE_Hz, TONE_Hz)
    assert 10 * found.residual_rms < 0.3
    assert found.lone_residual == 0.0
