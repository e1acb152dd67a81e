"""How far the clocks of force sensor and data acquisition are apart, from a touch-down both saw.

Force frames carry no time stamp, and the acquisition counts its own samples. When the object is
pressed on, the force rises and the strips see their stress rise with it. A ridge takes its share of
the force later or sooner than the others, so that the sum of the strips' volts is

    v(t) = P(F) dF/dt + v_0,      F and dF/dt at t + offset,

with a share P that is a function of the force alone. It is not known, only that it is smooth: here
a broken line between some forces. Both series are first smoothed by the same Gaussian, so that
rates and frame times do not matter; least squares over P, v_0 and mains at each offset, then over
the offset.

*What it takes.* A press that closes in on its force evenly looks the same a little later: P
imitates any shift. A rise, a raised cosine or an exponential, leaves the offset open to some 10 ms,
whatever the noise. A force that goes back by a tenth and comes again passes the same forces twice,
and P cannot be both: a tap of 4 µm in 10 ms right after the touch-down gives 0.1 ms.

*Uncertainty.* The residuals are correlated by the smoothing and by what the broken line cannot
follow: the sandwich estimate with their own autocovariance (Newey and West 1987), how far other
broken lines lead away, and `LEAST_s`; without a way back also `UNREVERSED_s`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rig.analysis.estimate import Estimate
from rig.analysis.trial.touch_down import (
    GRID_Hz,
    Reals,
    SampledSeries,
    SmoothForce,
    TouchDownError,
    standard_error,
    still_columns,
    volts_on_grid,
)

KNOTS = (
    (0.0, 0.1, 0.25, 0.5, 1.0),
    (0.0, 0.08, 0.16, 0.28, 0.45, 0.7, 1.0),
    (0.0, 0.05, 0.1, 0.16, 0.24, 0.34, 0.48, 0.65, 0.82, 1.0),
)
"""Shares of the largest force between which P is straight. The offset is the middle set's; how
far the others' lie from it is part of the error."""
STEP_s = 0.004
"""Between the offsets that are tried before the nearest is looked for finely."""
THINNED = round(STEP_s * GRID_Hz)
"""Of the grid, for that: the Gaussian leaves nothing in between."""
FINE_s = 1e-7
"""To which the offset is looked for then."""
LONGEST = 30
"""Steps of that at most: three or four are taken."""
LEAST_s = 6e-5
"""Frame shape, transducer and P are not known better: what was left on simulated touch-downs."""
REVERSAL = 0.05
"""Of the largest force: as far as it has to go back to count as going back."""
UNREVERSED_s = 0.015
"""Rms error on simulated presses that only rise."""
ENOUGH = 0.5
"""Share of the volts' variance that the force has to explain."""


class ClockOffsetError(TouchDownError):
    """Two series from which no offset follows."""


@dataclass(frozen=True)
class ClockOffset:
    """The offset, and how well force explains volts with it."""

    offset: Estimate
    """s: what was at t on the volts' clock was at t + offset on the force's."""
    explained: float
    """Share of the volts' variance."""
    reversed: bool
    """Whether the force went back on its way, so that the offset could be told."""


def clock_offset(
    force_N: SampledSeries, volts: SampledSeries, within_s: float = 0.2
) -> ClockOffset:
    """Offset of the force's clock against the volts', searched for in ±`within_s`.

    `force_N` is F_n, `volts` the sum v_1 + v_2, raw or decimated; both hold the touch-down and some
    time before and after, at least `within_s` more of the force. ClockOffsetError where the series
    do not overlap, or have no touch-down in common.
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
            "look whether the object touches the ridge with the strips, and at their wiring",
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
            f"the force explains only {100 * max(explained, 0):.0f} % of what the strips say: no "
            "touch-down in common",
            "look whether the object touches the ridge with the strips, and at their wiring",
        )
    if abs(offset) > within_s - 2 / GRID_Hz:
        raise ClockOffsetError(f"the offset is not within ±{within_s:g} s", "search further")
    return ClockOffset(Estimate.normal(offset, error, "s"), explained, reversed_)


class _Fit:
    def __init__(self, touch: SmoothForce, time: Reals, seen: Reals, knots: tuple[float, ...]):
        self._touch, self._time, self._seen, self._knots = touch, time, seen, knots
        self._still = still_columns(time)

    def nearest(self, within_s: float) -> float:
        """Offset of the least residual, to half of `STEP_s`. That is also from one of its times to
        the next: the force of one offset is that of the next one, a row further."""
        count, offsets = self._time.size, math.floor(2 * within_s / STEP_s + 1e-6) + 1
        times = self._time[0] - within_s + STEP_s * np.arange(count + offsets - 1)
        moving = self._touch.columns(times, self._knots)
        costs = [self._cost(moving[k : k + count]) for k in range(offsets)]
        return STEP_s * int(np.argmin(costs)) - within_s

    def best(self, near_s: float, within_s: float) -> float:
        """Offset of the least residual next to `near_s`: Gauss-Newton with P and the rest projected
        out (Kaufman 1975)."""
        low, high = max(near_s - STEP_s, -within_s), min(near_s + STEP_s, within_s)
        offset_s = near_s
        for _ in range(LONGEST):
            residual, slope = self._residual(offset_s)
            steepness = float(slope @ slope)
            if not steepness > 0:  # a force that does not change tells no time
                break
            before_s = offset_s
            offset_s = min(max(offset_s + float(residual @ slope) / steepness, low), high)
            if abs(offset_s - before_s) < FINE_s:
                break
        return offset_s

    def error(self, offset_s: float) -> tuple[Reals, float]:
        """Residuals and the offset's standard error."""
        residual, slope = self._residual(offset_s)
        influence = slope / float(slope @ slope)
        return residual, standard_error(influence, residual, len(self._knots) + 4)

    def _residual(self, offset_s: float) -> tuple[Reals, Reals]:
        """Residuals, and how the fit changes with the offset beyond what P and v_0 can imitate."""
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
        """The fitted curve with the force moved: P, v_0 and mains stay."""
        weights = np.linalg.lstsq(self._columns(offset_s), self._seen, rcond=1e-9)[0]
        moved: Reals = self._columns(offset_s + by_s) @ weights
        return moved
