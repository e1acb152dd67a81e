"""Found against false alarms over all thresholds, and the threshold that keeps to a rate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

ROLL_ALARMS = 0.02
"""The rate of false alarms in rolls to which thresholds are tuned."""
AXES = {"roll": ("roll",), "hold, tap": ("hold", "tap")}
"""False alarms that slips found are drawn against: labels of the trials, by name."""


@dataclass(frozen=True)
class Roc:
    """A curve: what is found and what alarms falsely at each threshold."""

    threshold: Floats
    """As a multiple of the detector's own, falling, (k,)."""
    found: Floats
    """Share of the slips, (k,)."""
    alarms: Floats
    """Share of the trials without, (k,)."""

    def found_at(self, alarms: float) -> float:
        """Share of the slips found at that share of false alarms: linear between the neighbouring
        thresholds, NaN beyond the swept ones."""
        order = np.lexsort((self.found, self.alarms))
        if alarms < self.alarms[order[0]]:
            return math.nan
        last = np.searchsorted(self.alarms[order], alarms, side="right")
        best = np.maximum.accumulate(self.found[order])
        return float(np.interp(alarms, self.alarms[order][: last + 1], best[: last + 1]))


def roc(
    threshold: Sequence[float], labels: Sequence[str], found: Flags, alarmed: Flags, of: str
) -> Roc:
    """The curve of a detector that was run at several thresholds, falling, (k,).

    `labels` (n,) of the trials; `found` and `alarmed` (n, k) say whether its slip was found and
    whether anything alarmed at each threshold; `of` names the trials without a slip (`AXES`).
    Raises ValueError where slips or trials without are missing.
    """
    slips = np.array([label == "slip" for label in labels], bool)
    others = np.array([label in AXES[of] for label in labels], bool)
    if not (slips.any() and others.any()):
        raise ValueError(f"{slips.sum()} slips and {others.sum()} of {of}: both must be there")
    return Roc(np.array(threshold), found[slips].mean(axis=0), alarmed[others].mean(axis=0))


def tune(
    floors: Sequence[float], roll_peaks: Floats, slip_peaks: Floats
) -> tuple[float, float, float]:
    """The floor, and the threshold on it, that find most and keep to `ROLL_ALARMS`.

    Largest scores of whole rolls (m, floors) and of slips where they would have been found
    (n, floors). Returns floor, threshold and the share of slips found. Raises ValueError where
    rolls or slips are missing.
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
    """The least threshold that no more than this share of the trials' largest scores exceeds."""
    ordered = np.sort(np.asarray(others, dtype=np.float64))[::-1]
    return float(ordered[int(most_alarms * ordered.size)])
