"""Slips found against false alarms over all thresholds, and the choice of a threshold."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.evaluation.scoring.outcomes import SLIPS

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

ROLL_ALARMS = 0.02
"""Rate of false alarms in rolls to which thresholds are tuned."""
AXES = {"roll": ("roll",), "hold, tap": ("hold", "partial slip", "tap")}
"""Labels of the trials whose false alarms are plotted against the slips found, by name of the
axis."""


@dataclass(frozen=True)
class Roc:
    """Slips found and false alarms at each threshold."""

    threshold: Floats
    """Threshold as a multiple of the detector's own, descending, (k,)."""
    found: Floats
    """Share of the slips that were found, (k,)."""
    alarms: Floats
    """Share of the trials without a slip in which there was an alarm, (k,)."""

    def found_at(self, alarms: float) -> float:
        """Return the share of slips found at a given share of false alarms.

        The value is interpolated between the neighbouring thresholds; NaN outside the swept range.
        """
        order = np.lexsort((self.found, self.alarms))
        if alarms < self.alarms[order[0]]:
            return math.nan
        last = np.searchsorted(self.alarms[order], alarms, side="right")
        best = np.maximum.accumulate(self.found[order])
        return float(np.interp(alarms, self.alarms[order][: last + 1], best[: last + 1]))


def roc(
    threshold: Sequence[float], labels: Sequence[str], found: Flags, alarmed: Flags, of: str
) -> Roc:
    """Return the curve of a detector that was run at several thresholds (k,), descending.

    `labels` (n,) are those of the trials. `found` and `alarmed` (n, k) state whether the slip was
    found and whether there was any alarm at each threshold. `of` selects the trials without a slip
    (`AXES`).

    Raises ValueError if there is no slip or no such trial.
    """
    slips = np.array([label in SLIPS for label in labels], bool)
    others = np.array([label in AXES[of] for label in labels], bool)
    if not (slips.any() and others.any()):
        raise ValueError(f"{slips.sum()} slips and {others.sum()} of {of}: both must be there")
    return Roc(np.array(threshold), found[slips].mean(axis=0), alarmed[others].mean(axis=0))


def tune(
    floors: Sequence[float], roll_peaks: Floats, slip_peaks: Floats
) -> tuple[float, float, float]:
    """Return the floor and the threshold that find most slips at `ROLL_ALARMS`, and the share
    found.

    `floors` are tried one by one. `roll_peaks` (m, floors) are the largest scores of whole rolls,
    `slip_peaks` (n, floors) those of slips in the interval where an alarm would find them.

    Raises ValueError if there are no rolls or no slips.
    """
    if not (len(roll_peaks) and len(slip_peaks)):
        raise ValueError(
            f"thresholds cannot be chosen on {len(roll_peaks)} rolls and {len(slip_peaks)} slips: "
            "both must be there; take more seeds, and slides and rolls among the kinds"
        )
    best = (floors[0], math.inf, -1.0)
    for column, floor in enumerate(floors):
        threshold = threshold_for(roll_peaks[:, column])
        found = float((slip_peaks[:, column] > threshold).mean())
        if found > best[2]:
            best = (floor, threshold, found)
    return best


def threshold_for(others: ArrayLike, most_alarms: float = ROLL_ALARMS) -> float:
    """Return the lowest threshold that at most this share of the largest scores exceeds.

    >>> threshold_for([1.0, 2.0, 3.0, 4.0], most_alarms=0.25)
    3.0
    """
    ordered = np.sort(np.asarray(others, dtype=np.float64))[::-1]
    return float(ordered[int(most_alarms * ordered.size)])
