"""Curves and characteristic numbers of a low-pass filter (paper Figure 14)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.detector.low_pass import HALF_POWER_dB, LowPass

Reals = NDArray[np.float64]

LOWEST_Hz = 0.1
"""Lowest frequency of the curves."""
POINTS = 4000
"""Number of frequencies of a curve, at equal ratios: enough to resolve the lobes of the stop
band."""
SETTLED = 0.01
"""The step response has settled once it stays within this of 1."""


@dataclass(frozen=True)
class LowPassCurves:
    """Curves over frequency, (k,) each, and over the time since a step, (n,) each."""

    frequency_Hz: Reals
    """Frequencies, in Hz."""
    gain_dB: Reals
    """Gain, in dB."""
    phase_deg: Reals
    """Phase, unwrapped from 0 at 0 Hz, in degrees."""
    group_delay_ms: Reals
    """Group delay, in ms."""
    time_ms: Reals
    """Time since the step, in ms."""
    step_response: Reals
    """Response to a unit step."""
    tap: Reals
    """Taps of the filter, over the same time."""


@dataclass(frozen=True)
class LowPassSummary:
    """Characteristic numbers of a filter as designed."""

    rate_Hz: float
    """Sampling rate, in Hz."""
    taps: int
    """Number of taps."""
    half_power_Hz: float
    """Frequency at which the gain is -3 dB."""
    lag_Hz: float
    """Frequency at which the phase lag is stated."""
    lag_deg: float
    """Phase lag at `lag_Hz`."""
    delay_ms: float
    """Group delay at `lag_Hz`."""
    stop_Hz: float | None
    """Frequency from which the gain stays below the specified attenuation; None if it never
    does."""
    largest_lobe_dB: float
    """Gain of the largest lobe beyond the first zero. The lobes of Kaiser's window fall with
    frequency, so the first may lie above the specified attenuation, below `stop_Hz`."""
    lobes_from_Hz: float
    """Frequency at which the gain first falls to that of the largest lobe."""
    step_half_ms: float
    """Time at which the step response passes one half."""
    overshoot_percent: float
    """Overshoot of the step response."""
    settled_ms: float
    """Time from which the step response stays within 1 % of its end."""


def low_pass_curves(low_pass: LowPass) -> LowPassCurves:
    """Return gain, phase, group delay and step response of a filter."""
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
    """Return the characteristic numbers of a filter, to compare with its specification."""
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
    """Return where y first passes a value, interpolated between the samples."""
    after = int(np.flatnonzero((y[:-1] - value) * (y[1:] - value) <= 0)[0])
    share = (value - y[after]) / (y[after + 1] - y[after])
    return float(x[after] + share * (x[after + 1] - x[after]))
