"""What a low-pass does, as curves and as numbers: paper Figure 14."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.detector.low_pass import HALF_POWER_dB, LowPass

Reals = NDArray[np.float64]

LOWEST_Hz = 0.1
POINTS = 4000
"""Frequencies of a curve, evenly by ratio: the lobes of the stop band are still told apart."""
SETTLED = 0.01
"""The step response has settled when it stays within this of 1."""


@dataclass(frozen=True)
class LowPassCurves:
    """Over frequency, each (k,), and over the time since a step, each (n,)."""

    frequency_Hz: Reals
    gain_dB: Reals
    phase_deg: Reals
    """Unwrapped from 0 at 0 Hz."""
    group_delay_ms: Reals
    time_ms: Reals
    step_response: Reals
    tap: Reals


@dataclass(frozen=True)
class LowPassSummary:
    """The numbers that a filter is asked for, as the designed one has them."""

    rate_Hz: float
    taps: int
    half_power_Hz: float
    lag_Hz: float
    lag_deg: float
    delay_ms: float
    """Group delay at `lag_Hz`."""
    stop_Hz: float | None
    """From there on the gain stays below the attenuation that was asked for; None where it never
    does."""
    largest_lobe_dB: float
    """Gain of the largest lobe beyond the first zero. (Lobes of Kaiser's window fall with
    frequency: the first may lie above what was asked for, before `stop_Hz`.)"""
    lobes_from_Hz: float
    """Where the gain has first come down to that."""
    step_half_ms: float
    """When the step response passes one half."""
    overshoot_percent: float
    settled_ms: float
    """When it stays within 1 % of its end."""


def low_pass_curves(low_pass: LowPass) -> LowPassCurves:
    """Gain, phase, group delay and step response of a filter."""
    frequency = np.geomspace(LOWEST_Hz, low_pass.rate_Hz / 2, POINTS)
    taps = low_pass.taps
    return LowPassCurves(
        frequency_Hz=frequency,
        gain_dB=low_pass.level(frequency),
        phase_deg=np.degrees(np.unwrap(np.angle(low_pass.response(frequency)))),
        group_delay_ms=1e3 * low_pass.group_delay_s(frequency),
        time_ms=np.arange(taps.size, dtype=np.float64) * (1e3 / low_pass.rate_Hz),
        step_response=low_pass.step_response(),
        tap=taps,
    )


def low_pass_summary(low_pass: LowPass) -> LowPassSummary:
    """What the filter has become of its specification."""
    asked, step = low_pass.settings, low_pass.step_response()
    lag_Hz = asked.lag_Hz
    even = np.linspace(0.0, low_pass.rate_Hz / 2, 8 * max(low_pass.taps.size, POINTS))
    level = low_pass.level(even)
    rising = np.flatnonzero((np.diff(level) > 0) & (level[:-1] < 2 * HALF_POWER_dB))
    largest = float(level[rising[0] :].max()) if rising.size else float(level[-1])
    loud = int(np.flatnonzero(level > -asked.stop_dB)[-1])
    unsettled = np.flatnonzero(np.abs(step - 1) > SETTLED)
    ms = 1e3 / low_pass.rate_Hz
    return LowPassSummary(
        rate_Hz=low_pass.rate_Hz,
        taps=low_pass.taps.size,
        half_power_Hz=_crossing(even, level, HALF_POWER_dB),
        lag_Hz=lag_Hz,
        lag_deg=low_pass.lag_deg(lag_Hz),
        delay_ms=1e3 * float(low_pass.group_delay_s(lag_Hz)[0]),
        stop_Hz=float(even[loud + 1]) if loud + 1 < even.size else None,
        largest_lobe_dB=largest,
        lobes_from_Hz=_crossing(even, level, largest),
        step_half_ms=ms * _crossing(np.arange(step.size, dtype=np.float64), step, 0.5),
        overshoot_percent=100 * max(float(step.max()) - 1, 0.0),
        settled_ms=ms * float(unsettled[-1] + 1),
    )


def _crossing(x: Reals, y: Reals, value: float) -> float:
    """Where y first passes a value, between the samples."""
    after = int(np.flatnonzero((y[:-1] - value) * (y[1:] - value) <= 0)[0])
    share = (value - y[after]) / (y[after + 1] - y[after])
    return float(x[after] + share * (x[after + 1] - x[after]))
