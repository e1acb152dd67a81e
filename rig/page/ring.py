"""The last minutes of a stream, decimated: of each short interval the smallest and largest value.

A peak of one sample stays visible however slowly it is drawn. The size is bounded whatever comes.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

BIN_S = 0.05
"""Length of an interval in s: four of them in each of the at most five drawings a second."""
KEPT_S = 180.0
"""The last minutes that are kept, in s."""


class Ring:
    """Decimated channels of one stream over time."""

    def __init__(self, channels: Sequence[str], units: str = ""):
        self.channels = tuple(channels)
        self.units = units
        self._bins: deque[tuple[int, NDArray[np.float64], NDArray[np.float64]]] = deque(
            maxlen=round(KEPT_S / BIN_S)
        )
        self.latest: tuple[float, ...] = ()
        """The newest row; empty before the first."""
        self.latest_s = -math.inf
        """Its time, in s since the run's start."""

    def add(self, times_s: NDArray[np.float64], rows: NDArray[np.float64]) -> None:
        """Add rows (n, channels) at increasing times (n,) in s since the run's start."""
        if not len(times_s):
            return
        keys = np.floor(times_s / BIN_S).astype(np.int64)
        starts = np.flatnonzero(np.r_[True, np.diff(keys) != 0])
        low = np.fmin.reduceat(rows, starts, axis=0)
        high = np.fmax.reduceat(rows, starts, axis=0)
        for key, smallest, largest in zip(keys[starts].tolist(), low, high, strict=True):
            self._put(key, smallest, largest)
        self.latest = tuple(float(value) for value in rows[-1])
        self.latest_s = float(times_s[-1])

    def _put(self, key: int, low: NDArray[np.float64], high: NDArray[np.float64]) -> None:
        if self._bins and key <= self._bins[-1][0]:
            # Blocks of a stream may meet in an interval, or overlap by the computer's jitter.
            last, lows, highs = self._bins[-1]
            self._bins[-1] = (last, np.fmin(lows, low), np.fmax(highs, high))
        else:
            self._bins.append((key, low, high))

    def since(self, key: int) -> dict[str, Any]:
        """Return the intervals from number `key` on, ready for JSON: ``k`` their numbers, and of
        each channel the smallest and largest values, in turn."""
        found = []
        for one in reversed(self._bins):
            if one[0] < key:
                break
            found.append(one)
        found.reverse()
        return {
            "k": [number for number, _, _ in found],
            "low": [[_short(low[c]) for _, low, _ in found] for c in range(len(self.channels))],
            "high": [[_short(high[c]) for _, _, high in found] for c in range(len(self.channels))],
        }

    @property
    def last_key(self) -> int:
        """Number of the newest interval, -1 if there is none."""
        return self._bins[-1][0] if self._bins else -1


def _short(value: float) -> float | None:
    """Return a number with six digits, as much as a screen shows; None for NaN and infinities."""
    number = float(value)
    return float(f"{number:.6g}") if math.isfinite(number) else None
