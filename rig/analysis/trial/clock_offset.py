"""Offset between the clocks of force sensor and data acquisition, from a touch-down that both
recorded.

Force frames carry no time stamp, and the acquisition counts its own samples. When the object is
pressed on, the force rises, and the stress in the strips rises with it. A ridge takes up its share
of the force earlier or later than the others, so the sum of the strips' volts is

    v(t) = P(F) dF/dt + v_0,      F and dF/dt at t + offset

with a share P that depends on the force alone. P is unknown but smooth: here it is linear between
fixed shares of the largest force. Both records are first smoothed by the same Gaussian, so that
rates and frame times do not matter. P, v_0 and mains follow by least squares at each offset, and
the offset is the one with the smallest residual.

*Requirements.* A press that approaches its force evenly looks the same a little later, because P
can imitate any shift. A mere rise, be it a raised cosine or an exponential, leaves the offset open
to some 10 ms, whatever the noise. A force that goes back by a tenth and returns passes the same
forces twice, and P cannot have two values: a tap of 4 µm in 10 ms right after the touch-down gives
0.1 ms.

*Uncertainty.* The residuals are correlated, by the smoothing and by what the model of P cannot
follow. The error combines the sandwich estimate with the autocovariance of the residuals (Newey and
West 1987), the distance to the offsets found with other knots of P, and `LEAST_s`; without a way
back also `UNREVERSED_s`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rig.analysis.estimate import Estimate
from rig.analysis.trial.touch_down import (
    GRID_Hz,
    Reals,
    SmoothForce,
    TouchDownError,
    TouchRecord,
    standard_error,
    still_columns,
    volts_on_grid,
)

KNOTS = (
    (0.0, 0.1, 0.25, 0.5, 1.0),
    (0.0, 0.08, 0.16, 0.28, 0.45, 0.7, 1.0),
    (0.0, 0.05, 0.1, 0.16, 0.24, 0.34, 0.48, 0.65, 0.82, 1.0),
)
"""Shares of the largest force between which P is linear. The offset is that of the middle set; its
distance from those of the others is part of the error."""
STEP_s = 0.004
"""Step between the offsets that are tried in the coarse search, in s."""
THINNED = round(STEP_s * GRID_Hz)
"""Step of the samples used in the coarse search: the Gaussian leaves nothing between them."""
FINE_s = 1e-7
"""Accuracy of the fine search, in s."""
LONGEST = 30
"""Maximum number of steps of the fine search; three or four are usual."""
LEAST_s = 6e-5
"""Minimum standard error, in s. Frame shape, transducer and P are not known better: this was the
remaining error on simulated touch-downs."""
REVERSAL = 0.05
"""Share of the largest force by which the force has to go back."""
UNREVERSED_s = 0.015
"""Rms error on simulated presses that only rise, in s."""
ENOUGH = 0.5
"""Share of the variance of the volts that the force has to explain."""


class ClockOffsetError(TouchDownError):
    """Raised when two records do not determine an offset."""


@dataclass(frozen=True)
class ClockOffset:
    """An offset, and how well the force explains the volts with it."""

    offset: Estimate
    """Offset in s: an event at t on the clock of the volts was at t + offset on that of the
    force."""
    explained: float
    """Share of the variance of the volts that the force explains."""
    reversed: bool
    """True if the force went back on its way, without which the offset is poorly determined."""


def clock_offset(force_N: TouchRecord, volts: TouchRecord, within_s: float = 0.2) -> ClockOffset:
    """Return the offset of the force's clock against the volts', searched for in ±`within_s`.

    `force_N` is F_n and `volts` the sum v_1 + v_2, raw or decimated. Both must contain the
    touch-down and some time before and after it, the force at least `within_s` more.

    Raises ClockOffsetError if the records do not overlap or have no touch-down in common.
    """
    time, seen = volts_on_grid(volts, force_N.rate_Hz)
    touch = SmoothForce(force_N)
    inside = (time - within_s >= touch.first_s) & (time + within_s <= touch.last_s)
    time, seen = time[inside], seen[inside]
    if time.size < 10 * len(KNOTS[-1]):
        raise ClockOffsetError(
            f"the force's frames and the volts have {time.size / GRID_Hz:.3g} s in common, with "
            f"{within_s:g} s to either side",
            "record both from before the touch-down until after it",
        )
    variation = float(np.square(seen - seen.mean()).sum())
    if not (variation > 0 and touch.largest_N > 0):
        still = "force" if variation > 0 else "strips"
        raise ClockOffsetError(
            f"the {still} did not change: no touch-down in common",
            "check that the object touches the ridge with the strips, and check their wiring",
        )
    fits = [_Fit(touch, time, seen, knots) for knots in KNOTS]
    near_s = _Fit(touch, time[::THINNED], seen[::THINNED], KNOTS[1]).nearest(within_s)
    offsets = [fit.best(near_s, within_s) for fit in fits]
    offset = offsets[1]
    residual, error = fits[1].error(offset)
    error = math.hypot(error, LEAST_s, max(abs(other - offset) for other in offsets))
    reversed_ = touch.way_back(time[0] + offset, time[-1] + offset) >= REVERSAL
    if not reversed_:
        error = math.hypot(error, UNREVERSED_s)
    explained = 1 - float(residual @ residual) / variation
    if not explained > ENOUGH:
        raise ClockOffsetError(
            f"the force explains only {100 * max(explained, 0):.0f} % of the strips' signal: no "
            "touch-down in common",
            "check that the object touches the ridge with the strips, and check their wiring",
        )
    if abs(offset) > within_s - 2 / GRID_Hz:
        raise ClockOffsetError(f"the offset is not within ±{within_s:g} s", "search further")
    return ClockOffset(Estimate.normal(offset, error, "s"), explained, reversed_)


class _Fit:
    """Least-squares fit of volts by the force, as a function of the offset."""

    def __init__(self, touch: SmoothForce, time: Reals, seen: Reals, knots: tuple[float, ...]):
        self._touch, self._time, self._seen, self._knots = touch, time, seen, knots
        self._still = still_columns(time)

    def nearest(self, within_s: float) -> float:
        """Return the offset with the smallest residual, to half of `STEP_s`.

        `STEP_s` is also the step of the thinned samples, so the force at one offset is that at the
        next one, shifted by one row.
        """
        count, offsets = self._time.size, math.floor(2 * within_s / STEP_s + 1e-6) + 1
        times = self._time[0] - within_s + STEP_s * np.arange(count + offsets - 1)
        moving = self._touch.columns(times, self._knots)
        costs = [self._cost(moving[k : k + count]) for k in range(offsets)]
        return STEP_s * int(np.argmin(costs)) - within_s

    def best(self, near_s: float, within_s: float) -> float:
        """Return the offset with the smallest residual near `near_s`.

        Gauss-Newton with P and the other parameters projected out (Kaufman 1975).
        """
        low, high = max(near_s - STEP_s, -within_s), min(near_s + STEP_s, within_s)
        offset_s = near_s
        for _ in range(LONGEST):
            residual, slope = self._residual(offset_s)
            steepness = float(slope @ slope)
            # A constant force carries no information about time.
            if not steepness > 0:
                break
            before_s = offset_s
            offset_s = min(max(offset_s + float(residual @ slope) / steepness, low), high)
            if abs(offset_s - before_s) < FINE_s:
                break
        return offset_s

    def error(self, offset_s: float) -> tuple[Reals, float]:
        """Return the residuals and the standard error of the offset, NaN where the force is
        constant."""
        residual, slope = self._residual(offset_s)
        steepness = float(slope @ slope)
        if not steepness > 0:
            return residual, math.nan
        return residual, standard_error(slope / steepness, residual, len(self._knots) + 4)

    def _residual(self, offset_s: float) -> tuple[Reals, Reals]:
        """Return the residuals, and the change of the fit with the offset that P and v_0 cannot
        imitate."""
        model, orthonormal = self._model(self._columns(offset_s))
        step = 2e-4
        later, earlier = self._shifted(offset_s, step), self._shifted(offset_s, -step)
        slope = (later - earlier) / (2 * step)
        return self._seen - model, slope - orthonormal @ (orthonormal.T @ slope)

    def _cost(self, moving: Reals) -> float:
        model, _ = self._model(np.column_stack([moving, self._still]))
        residual = self._seen - model
        return float(residual @ residual)

    def _columns(self, offset_s: float) -> Reals:
        moving = self._touch.columns(self._time + offset_s, self._knots)
        return np.column_stack([moving, self._still])

    def _model(self, columns: Reals) -> tuple[Reals, Reals]:
        left, kept, _ = np.linalg.svd(columns, full_matrices=False)
        orthonormal: Reals = left[:, kept > 1e-9 * kept[0]]
        return orthonormal @ (orthonormal.T @ self._seen), orthonormal

    def _shifted(self, offset_s: float, by_s: float) -> Reals:
        """Return the fitted curve with the force shifted, while P, v_0 and mains stay."""
        weights = np.linalg.lstsq(self._columns(offset_s), self._seen, rcond=1e-9)[0]
        moved: Reals = self._columns(offset_s + by_s) @ weights
        return moved
