"""What an observer who knows when a slip comes could find in a record, for comparison.

The observer knows when the slip comes. What it does not know is what noise, mains and the servo do
meanwhile: of these it knows how they were from the press on to the slip, as a Gaussian process. The
size of what that process does not foretell is the detectability d' (Kay 1998, Fundamentals of
Statistical Signal Processing II, 4.4 and 13.3). The slip is found where so much would come by
chance, without a change, in fewer stretches of that length than the stated rate of false alarms
allows. The test is Chow's for observations that were not fitted (1960, Econometrica 28, 591), of
both channels together: it allows for the errors of a process that was learnt from few rows.

The stated rate is that in Gaussian noise: steps of a servo are more often large.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from rig.core.settings import Settings
from rig.detector.contract import DESIGN_RATE_Hz
from rig.detector.resampling import RATE_ERROR, StreamingResampler
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

    false_per_hour: float = Field(1.0, gt=0)
    """False alarms an hour in Gaussian noise, if stretches of the length that is judged follow one
    another. One of 40 ms is then taken for a slip with a probability of 1.1e-5."""


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


def probability_unchanged(before: Floats, during: Floats) -> float:
    """Return the probability that a process shows, in the rows `during` (m, channels) that follow
    the rows `before` (n, channels), at least as much as they do of what the latter do not foretell.

    The errors of the prediction are weighted by their covariance, with that of the weights in it.
    The trace of their matrix over that of the rows before is Hotelling's generalised T^2, for which
    an F distribution is taken (McKeon 1974, Biometrika 61, 381).
    """
    # Imported here because scipy takes long to import and not every command comes here.
    from scipy.special import fdtrc

    scale = np.maximum(before.std(axis=0), LEAST_NOISE_V)
    rows = (np.vstack([before, during]) - before.mean(axis=0)) / scale
    past = [rows[ORDER - lag : len(rows) - lag] for lag in range(1, ORDER + 1)]
    known = np.hstack([np.ones((len(rows) - ORDER, 1)), *past])
    learnt, channels = len(before) - ORDER, rows.shape[1]
    inverse = np.linalg.pinv(known[:learnt])
    lever = known[learnt:] @ inverse
    left = rows[ORDER:] - known @ (inverse @ rows[ORDER : ORDER + learnt])
    within = left[:learnt].T @ left[:learnt] + learnt * np.diag((LEAST_NOISE_V / scale) ** 2)
    beyond = np.linalg.solve(np.eye(len(during)) + lever @ lever.T, left[learnt:])
    found = float(np.trace(np.linalg.solve(within, left[learnt:].T @ beyond)))
    free, count = learnt - known.shape[1], len(during)
    first = channels * count
    ratio = (free + count - channels - 1) * (free - 1) / (free - channels - 3) / (free - channels)
    second = 4 + (first + 2) / (ratio - 1)
    unit = first * (second - 2) / second / (free - channels - 1)
    return float(fdtrc(first, second, found / unit))


def slip_rows(volts: Floats, rate_Hz: float, truth: Truth) -> tuple[Floats, Floats, float]:
    """Return the rows (n, 2) before the slip of a trial, from which the process is learnt, those
    (m, 2) in which the slip shows, up to 30 ms after that of the whole ridge, and their rate in Hz.

    The slip shows from that of the first node on, from 10 ms before that of the whole ridge at the
    earliest. Faster recordings are judged at the rate at which detectors judge, by the same
    resampler: as late as a detector sees it.
    """
    first_s = truth.ridge_slip_s - EARLY_WITHIN_S
    if math.isfinite(truth.node_slip_s):
        first_s = max(first_s, truth.node_slip_s)
    pressed_s = truth.quiet_s[0][0] if truth.quiet_s else truth.motion_s
    times_s = (pressed_s, first_s, truth.ridge_slip_s + FOUND_WITHIN_S)
    begin, first, last = (round(time_s * rate_Hz) for time_s in times_s)
    if rate_Hz > DESIGN_RATE_Hz * (1 + RATE_ERROR):
        resampler = StreamingResampler(rate_Hz, DESIGN_RATE_Hz, volts.shape[1])
        missing = resampler.outputs
        volts, rate_Hz = resampler.add(volts), resampler.rate_Hz
        rows = (resampler.ratio.outputs_before(row) - missing for row in (begin, first, last))
        begin, first, last = (max(row, 0) for row in rows)
    return volts[begin:first], volts[first:last], rate_Hz


def slip_detectability(volts: Floats, rate_Hz: float, truth: Truth) -> float:
    """Return d' of the slip of a trial from its record (n, 2); NaN where too little comes before it
    to learn the process from.

    The change is what the rows before do not foretell (`slip_rows`). It is measured with the noise
    in it, whose mean share of d'^2, one for each number, is taken off. What the noise scatters
    remains: 9 times out of 10 d' is below 5 where nothing changes.
    """
    before, during, _ = slip_rows(volts, rate_Hz, truth)
    if len(before) < LEAST_ROWS:
        return math.nan
    about = np.vstack([before[-ORDER:], during]) - before.mean(axis=0)
    change = whitened(about, process_of(before))[ORDER:]
    return math.sqrt(max(float((change**2).sum()) - change.size, 0.0))


def ideal_report(
    volts: Floats, rate_Hz: float, truth: Truth, settings: IdealSettings | None = None
) -> DetectorReport:
    """Return the alarm of an observer who finds what can be found: at the end of the time in which
    the slip is found, all of which it uses, if the slip stands out, and none otherwise. Nothing is
    judged where the process is not known."""
    settings = IdealSettings() if settings is None else settings
    if not truth.slipped:
        return DetectorReport()
    before, during, judged_Hz = slip_rows(volts, rate_Hz, truth)
    if len(before) < LEAST_ROWS or not len(during):
        return DetectorReport(unjudged_s=((0.0, len(volts) / rate_Hz),))
    allowed = settings.false_per_hour * len(during) / judged_Hz / 3600
    found = probability_unchanged(before, during) <= allowed
    return DetectorReport(np.array([truth.window_s()[1]] if found else []))
