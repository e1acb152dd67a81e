"""A touch-down recorded by force sensor and strips: its two records, prepared for one model.

When the object is pressed on, the force rises, and the stress in the strips rises with it. A ridge
takes up its share of the force earlier or later than the others, so the volts are

    v(t) = P(F) dF/dt + v_0 + mains

with a share P that is a function of the force alone: a broken line between some forces. Both
records are first smoothed by the same Gaussian, so that rates and frame times do not matter. The
frames of a slow force sensor, means over an interval that is long compared with the Gaussian, are
first interpolated, and the volts are averaged over as long an interval.
`rig.analysis.trial.clock_offset` finds when the two were taken, `rig.analysis.trial.touch_gain` how
large P is.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.core.errors import ExitCode, RigError

Reals = NDArray[np.float64]

WIDTH_s = 0.004
"""Standard deviation of the Gaussian, in s. It reduces 3 mN of noise per frame to 0.2 N/s of
dF/dt."""
GRID_Hz = 1000.0
"""Rate of the common time grid on which force and volts are compared."""
FINE_RATE_Hz = 500.0
"""Lowest frame rate in Hz at which the Gaussian can be sampled at the frames: there are two frames
in its width. At 100 frames/s its sampled derivative would be half of the true one, and the gains
twice as large."""
MAINS_Hz = 50.0
"""Mains frequency, in Hz."""
MEMORY = 4.0
"""Widths of the Gaussian over which residuals are taken to be correlated."""


class TouchDownError(RigError):
    """Raised when two records have no usable touch-down in common."""

    code = ExitCode.FINISHED_WITH_FAILURES


@dataclass(frozen=True)
class TouchRecord:
    """Equally spaced samples (n,) on a clock of their own."""

    values: Reals
    """The samples, (n,)."""
    rate_Hz: float
    """Sampling rate, in Hz."""
    first_s: float = 0.0
    """Time of the first sample on its clock, in s."""
    delay_s: float = 0.0
    """Delay between an event and the sample that shows it, in s: half a frame for a mean, `delay_s`
    for a filter."""


def _gaussian(values: Reals, rate_Hz: float, order: int) -> Reals:
    from scipy.ndimage import gaussian_filter1d

    smooth = gaussian_filter1d(values, WIDTH_s * rate_Hz, order=order, mode="nearest", truncate=5.0)
    result: Reals = np.asarray(smooth, dtype=np.float64) * rate_Hz**order
    return result


def volts_on_grid(volts: TouchRecord, force_rate_Hz: float) -> tuple[Reals, Reals]:
    """Return times on the volts' clock, corrected, and smoothed volts, as slow as frames at that
    rate.

    Times are (m,) in s, volts (m,) in V. Raises TouchDownError for too few samples.
    """
    values = np.asarray(volts.values, dtype=np.float64)
    if force_rate_Hz < FINE_RATE_Hz:
        values = _averaged(values, round(volts.rate_Hz / force_rate_Hz))
    start = volts.first_s - volts.delay_s
    edge = 4 * WIDTH_s
    end = start + (values.size - 1) / volts.rate_Hz
    time = np.arange(start + edge, end - edge, 1 / GRID_Hz)
    if not time.size:
        raise TouchDownError(f"{values.size} samples of volts are too few")
    return time, _cubic(start, volts.rate_Hz, _gaussian(values, volts.rate_Hz, 0))(time)


def _averaged(values: Reals, width: int) -> Reals:
    """Return the centred running mean over `width` samples. If `width` is even, it is the mean of
    the two running means that begin half a sample before and half a sample after."""
    from scipy.ndimage import uniform_filter1d

    means = uniform_filter1d(values, width, mode="nearest")
    if width % 2 == 0:
        means = (means + uniform_filter1d(values, width, mode="nearest", origin=-1)) / 2
    result: Reals = means
    return result


def _interpolated(series: TouchRecord) -> TouchRecord:
    """Return the series at a whole multiple of its rate, of at least that of the grid."""
    values = np.asarray(series.values, dtype=np.float64)
    times = math.ceil(GRID_Hz / series.rate_Hz)
    at = np.arange((values.size - 1) * times + 1) / times
    between = _cubic(0.0, 1.0, values)(at)
    return TouchRecord(between, times * series.rate_Hz, series.first_s, series.delay_s)


def _cubic(first_s: float, rate_Hz: float, values: Reals) -> Callable[[Reals], Reals]:
    """Return the cubic spline through equally spaced values, as a function of time."""
    from scipy.ndimage import map_coordinates, spline_filter1d

    coefficients = spline_filter1d(values, mode="mirror")

    def at(time: Reals) -> Reals:
        places = ((time - first_s) * rate_Hz)[None, :]
        between: Reals = map_coordinates(coefficients, places, mode="mirror", prefilter=False)
        return between

    return at


class SmoothForce:
    """Smoothed force and its rate, at any time on the clock of the force."""

    def __init__(self, series: TouchRecord):
        if series.rate_Hz < FINE_RATE_Hz:
            series = _interpolated(series)
        values = np.asarray(series.values, dtype=np.float64)
        self._time = series.first_s - series.delay_s + np.arange(values.size) / series.rate_Hz
        self._force = _gaussian(values, series.rate_Hz, 0)
        first_s, rate_Hz = float(self._time[0]), series.rate_Hz
        self._force_at = _cubic(first_s, rate_Hz, self._force)
        self._rate_at = _cubic(first_s, rate_Hz, _gaussian(values, rate_Hz, 1))
        edge = 4 * WIDTH_s
        self.first_s = float(self._time[0]) + edge
        self.last_s = float(self._time[-1]) - edge
        self.largest_N = float(self._force.max())

    def way_back(self, start_s: float, end_s: float) -> float:
        """Return how far the force fell after it had risen, as a share of the largest force."""
        inside = (self._time >= start_s) & (self._time <= end_s)
        force = self._force[inside]
        return float((np.maximum.accumulate(force) - force).max()) / self.largest_N

    def columns(self, time: Reals, knots: tuple[float, ...]) -> Reals:
        """Return dF/dt times each hat function of F, (n, knots)."""
        force = np.clip(self._force_at(time) / self.largest_N, 0.0, 1.0)
        rate = self._rate_at(time)
        hats = [np.interp(force, knots, row) for row in np.eye(len(knots))]
        return np.column_stack([rate * hat for hat in hats])


def still_columns(time: Reals) -> Reals:
    """Return the columns that describe the volts at rest: a constant and the mains, (n, 3)."""
    turn = 2 * np.pi * MAINS_Hz * time
    return np.column_stack([np.ones(time.size), np.cos(turn), np.sin(turn)])


def standard_error(influence: Reals, residual: Reals, parameters: int) -> float:
    """Return the standard error of a fitted number, ``influence @ volts``, in the number's unit.

    It is computed from the residuals with their own autocovariance (Newey and West 1987), and
    enlarged for the `parameters` that were fitted.
    """
    product = influence * residual
    lags = round(MEMORY * WIDTH_s * GRID_Hz)
    long_run = float(product @ product)
    for lag in range(1, lags):
        long_run += 2 * (1 - lag / lags) * float(product[lag:] @ product[:-lag])
    independent = max(residual.size / lags, parameters + 1.0)
    inflation = independent / (independent - min(parameters, 0.5 * independent))
    return float(np.sqrt(max(long_run, 0.0) * inflation))
