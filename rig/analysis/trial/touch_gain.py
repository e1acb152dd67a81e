"""Gain of a strip from a touch-down: volts per newton per second of the force on the object.

A film that wears, tears or comes off its amplifier shows here from trial to trial, without a
vibrator and whatever happens later in the trial. The strip's share P of the touch-down
(`rig.analysis.trial.touch_down`) depends on the force, because the ridge takes up its part earlier
or later than the others. Its mean over the force, from zero to the largest, is the gain: the
integral of the volts over time, divided by the force that was reached. It holds for this skin on
this object under this force; compare only like with like.
"""

from __future__ import annotations

import numpy as np

from rig.analysis.estimate import Estimate
from rig.analysis.trial.touch_down import (
    Reals,
    SmoothForce,
    TouchDownError,
    TouchRecord,
    standard_error,
    still_columns,
    volts_on_grid,
)

KNOTS = (0.0, 0.08, 0.16, 0.28, 0.45, 0.7, 1.0)
"""Shares of the largest force between which P is linear."""
ENOUGH = 10
"""Minimum number of samples per knot."""


def touch_gain(force_N: TouchRecord, volts: TouchRecord, offset_s: float) -> Estimate:
    """Return a strip's gain in V s/N, with its sign; what was at t on the volts' clock was at t +
    `offset_s` on the force's, which is taken as known.

    An event at t on the clock of the volts was at t + `offset_s` on that of the force; the offset
    is taken as known. Both records contain the touch-down and some time before and after it.

    Raises TouchDownError if they do not overlap.
    """
    time, seen = volts_on_grid(volts, force_N.rate_Hz)
    touch = SmoothForce(force_N)
    inside = (time + offset_s >= touch.first_s) & (time + offset_s <= touch.last_s)
    time, seen = time[inside], seen[inside]
    if time.size < ENOUGH * len(KNOTS):
        raise TouchDownError(
            f"the force's frames and the strip's volts have {time.size} ms in common",
            "record both from before the touch-down until after it",
        )
    columns = np.column_stack([touch.columns(time + offset_s, KNOTS), still_columns(time)])
    weighting = np.zeros(columns.shape[1])
    weighting[: len(KNOTS)] = _mean_weights()
    inverse = np.linalg.pinv(columns, rcond=1e-9)
    influence, residual = weighting @ inverse, seen - columns @ (inverse @ seen)
    error = standard_error(influence, residual, columns.shape[1])
    return Estimate.normal(float(influence @ seen), error, "V s/N")


def _mean_weights() -> Reals:
    """Return the weights of the values at the knots in their average over the force."""
    widths = np.diff(KNOTS)
    weights: Reals = 0.5 * (np.append(widths, 0.0) + np.append(0.0, widths))
    return weights
