"""What an ideal observer could find in a record: the bound with which a detector is compared.

The observer knows when the slip comes and what it does to both signals. What it does not know is
what noise, mains and the servo do meanwhile: of these it knows how they were from the press on to
the slip, as a Gaussian process. For such an observer the likelihood ratio is the output of the
matched filter behind a filter that whitens (Kay 1998, Fundamentals of Statistical Signal Processing
II, 4.4 and 13.3), and its detectability d' is the size of the whitened change. It is a bound: no
real detector knows the change, and steps of a servo are more often large than a Gaussian process.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.core.settings import Settings
from rig.evaluation.scoring.outcomes import (
    EARLY_WITHIN_S,
    FOUND_WITHIN_S,
    DetectorReport,
    Truth,
)

Floats = NDArray[np.float64]

ORDER = 8
"""Samples of both channels from which the next one is predicted."""
LEAST_ROWS = 100
"""Minimum number of rows from which a process is learnt."""
LEAST_NOISE_V = 1e-6
"""Lowest noise that is assumed, rms: a constant channel has none."""


class IdealSettings(Settings):
    """Parameters of the ideal observer."""

    needed: float = 6.0
    """Detectability from which a slip can be found: with it 95 % are found at one false alarm an
    hour. It is the sum of the quantiles of the normal distribution for 0.95 (1.6) and for one in
    the 1.4e5 stretches of 25 ms of an hour (4.4)."""


@dataclass(frozen=True)
class Process:
    """An autoregressive process of several channels, of which the next row is a weighted sum of the
    last ones plus white noise."""

    weights: Floats
    """Weights (order, channels, channels): the first are those of the latest row."""
    covariance: Floats
    """Covariance of the white noise, (channels, channels)."""


def process_of(rows: Floats, order: int = ORDER) -> Process:
    """Return the process that rows (n, channels) follow best, by least squares about their mean.

    Raises ValueError for fewer than `LEAST_ROWS` rows.
    """
    if len(rows) < LEAST_ROWS:
        raise ValueError(f"{len(rows)} rows: a process is learnt from at least {LEAST_ROWS}")
    about = rows - rows.mean(axis=0)
    count, channels = len(rows) - order, rows.shape[1]
    past = np.hstack([about[order - lag : order - lag + count] for lag in range(1, order + 1)])
    found, *_ = np.linalg.lstsq(past, about[order:], rcond=None)
    left = about[order:] - past @ found
    weights = found.reshape(order, channels, channels).transpose(0, 2, 1)
    covariance = left.T @ left / max(count - order * channels, 1)
    return Process(weights, covariance + LEAST_NOISE_V**2 * np.eye(channels))


def whitened(change: Floats, process: Process) -> Floats:
    """Return what is left of a change (n, channels) that begins with its first row, behind the
    filter that makes the process white noise of unit size and independent channels."""
    left = change.copy()
    for lag, weight in enumerate(process.weights, 1):
        left[lag:] -= change[:-lag] @ weight.T
    white: Floats = np.linalg.solve(np.linalg.cholesky(process.covariance), left.T).T
    return white


def detectability(change: Floats, process: Process) -> float:
    """Return d' of a known change (n, channels) in a process: the distance of the means of the
    matched filter's output with and without it, in standard deviations.

    >>> white = Process(np.zeros((1, 1, 1)), np.array([[4.0]]))
    >>> detectability(np.array([[0.0], [6.0], [8.0]]), white)
    5.0
    """
    return float(np.linalg.norm(whitened(change, process)))


def slip_detectability(volts: Floats, rate_Hz: float, truth: Truth) -> float:
    """Return d' of the slip of a trial from its record (n, 2) up to 30 ms after the slip of the
    whole ridge; NaN where too little comes before it to learn the process from.

    The change is what the rows before do not foretell, from the first node's slip on, 10 ms before
    that of the whole ridge at the earliest. It is measured with the noise in it, whose mean share
    of d'^2, one for each number, is taken off.
    """
    first_s = truth.ridge_slip_s - EARLY_WITHIN_S
    if math.isfinite(truth.node_slip_s):
        first_s = max(first_s, truth.node_slip_s)
    first, last = round(first_s * rate_Hz), round((truth.ridge_slip_s + FOUND_WITHIN_S) * rate_Hz)
    pressed_s = truth.quiet_s[0][0] if truth.quiet_s else truth.motion_s
    before = volts[round(pressed_s * rate_Hz) : first]
    if len(before) < LEAST_ROWS:
        return math.nan
    about = volts[first - ORDER : last] - before.mean(axis=0)
    change = whitened(about, process_of(before))[ORDER:]
    return math.sqrt(max(float((change**2).sum()) - change.size, 0.0))


def ideal_report(
    volts: Floats, rate_Hz: float, truth: Truth, settings: IdealSettings | None = None
) -> DetectorReport:
    """Return the alarm of an observer who finds what can be found: at the end of the time in which
    the slip is found, all of which it uses, if the slip stands out, and none otherwise. Nothing is
    judged where the process is not known."""
    needed = (IdealSettings() if settings is None else settings).needed
    if not truth.slipped:
        return DetectorReport()
    found = slip_detectability(volts, rate_Hz, truth)
    if math.isnan(found):
        return DetectorReport(unjudged_s=((0.0, math.inf),))
    return DetectorReport(np.array([truth.window_s()[1]] if found >= needed else []))
