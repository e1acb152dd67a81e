"""What a bench's front end makes of the strips' signals: gains, mains, noise, drift, coupling and
converter."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rig.evaluation.labelled_trials import KINDS, LabelledTrial
from rig.physics.population import StripFrontEndSettings

Floats = NDArray[np.float64]


def through_front_end(
    trial: LabelledTrial, front_end: StripFrontEndSettings, hearing: int = 0
) -> tuple[Floats, dict[str, float]]:
    """Return the volts (n, 2) that a bench would record, and what was added to them, by name and
    unit.

    `hearing` numbers the front ends. Each number draws new values from the trial's kind and seed.
    """
    chance = np.random.default_rng([KINDS.index(trial.kind), trial.seed, 1, hearing])
    return recorded(trial.volts, trial.rate_Hz, front_end, chance)


def recorded(
    volts: Floats, rate_Hz: float, front_end: StripFrontEndSettings, chance: np.random.Generator
) -> tuple[Floats, dict[str, float]]:
    """Return what a front end, drawn by `chance`, makes of the volts (n, 2) of the strips, and the
    numbers that were drawn."""
    drawn = {name: getattr(front_end, name).draw(chance) for name in _FIRST}
    size = len(volts)
    phase = 2 * np.pi * front_end.mains_Hz * np.arange(size) / rate_Hz
    phases = chance.uniform(0, 2 * np.pi) + np.array([0.0, chance.uniform(-0.3, 0.3)])
    mismatch = drawn["gain_mismatch"]
    mains = drawn["mains_mV"] * np.sin(phase[:, None] + phases)
    noise = drawn["noise_mV"] * chance.standard_normal((size, 2))
    # Everything that was added to the front end later is drawn after what there was before.
    drawn |= {name: getattr(front_end, name).draw(chance) for name in _LATER}
    heard = volts * np.array([1 + mismatch / 2, 1 - mismatch / 2]) * drawn["gain"]
    time_s = np.arange(size) / rate_Hz
    heard = heard + 1e-3 * drawn["drift_mV"] * _drift(time_s, drawn["drift_s"], chance)
    heard = heard + 1e-3 * mains
    heard = heard + 1e-3 * noise
    heard = heard + 1e-3 * drawn["flicker_mV"] * _flicker(size, chance)
    heard = heard + 1e-3 * drawn["burst_mV"] * _bursts(time_s, drawn["bursts_Hz"], chance)
    heard = _coupled(heard, drawn["coupling_Hz"], rate_Hz)
    step_V = 1e-3 * drawn["step_mV"]
    return (np.round(heard / step_V) * step_V if step_V > 0 else heard), drawn


_FIRST = ("noise_mV", "mains_mV", "gain_mismatch")
_LATER = (
    "gain", "coupling_Hz", "flicker_mV", "drift_mV", "drift_s", "bursts_Hz", "burst_mV", "step_mV",
)  # fmt: skip


def _drift(time_s: Floats, constant_s: float, chance: np.random.Generator) -> Floats:
    """Return a drift of size 1 that begins at a random time and is mostly common to both."""
    begin_s = chance.uniform(0.0, time_s[-1])
    both, sign = chance.uniform(0.5, 1.0, 2), chance.choice((-1.0, 1.0))
    gone = 1 - np.exp(-np.clip(time_s - begin_s, 0, None) / constant_s)
    drift: Floats = sign * gone[:, None] * both
    return drift


def _flicker(size: int, chance: np.random.Generator) -> Floats:
    """Return noise with a power of 1/f and an rms of 1, (size, 2)."""
    spectrum = np.fft.rfft(chance.standard_normal((size, 2)), axis=0)
    spectrum /= np.sqrt(np.maximum(np.arange(len(spectrum)), 1))[:, None]
    spectrum[0] = 0
    noise = np.fft.irfft(spectrum, size, axis=0)
    scaled: Floats = noise / noise.std(axis=0)
    return scaled


def _bursts(time_s: Floats, rate_Hz: float, chance: np.random.Generator) -> Floats:
    """Return bursts with an rms of 1, half of each common to both channels, (n, 2)."""
    seen = np.zeros((time_s.size, 1))
    for _ in range(chance.poisson(rate_Hz * time_s[-1])):
        begin_s = chance.uniform(0.0, time_s[-1])
        lasts_s = np.exp(chance.uniform(np.log(0.002), np.log(0.02)))
        seen[(time_s >= begin_s) & (time_s < begin_s + lasts_s)] = 1
    common = chance.standard_normal((time_s.size, 1))
    bursts: Floats = seen * (common + chance.standard_normal((time_s.size, 2))) / np.sqrt(2)
    return bursts


def _coupled(volts: Floats, corner_Hz: float, rate_Hz: float) -> Floats:
    """Return the volts behind a coupling capacitor that has settled before the first row."""
    if corner_Hz == 0:
        return volts
    from scipy.signal import butter, lfilter, lfilter_zi

    numerator, denominator = butter(1, corner_Hz, "highpass", fs=rate_Hz)
    settled = lfilter_zi(numerator, denominator)[:, None] * volts[:1]
    coupled: Floats = lfilter(numerator, denominator, volts, axis=0, zi=settled)[0]
    return coupled
