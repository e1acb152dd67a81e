"""Applies the disturbances of a fault plan to the values of an amplifier's converters."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Reals = npt.NDArray[np.float64]

KINDS = ("saturated", "frozen", "one-axis-stuck", "wrong-value", "previous")
BACK = 2
"""Frames by which ``previous`` is late."""


@dataclass(frozen=True)
class _Disturbance:
    kind: str
    begin_s: float
    end_s: float
    channel: int
    added: Reals | None
    """Addition to the values by a wrong value, (channels,)."""


class DisturbedConverter:
    """The disturbances of one amplifier so far, and the frames that they need to know."""

    def __init__(self, channels: int, end: float):
        """`end` is the value at which the converter stands when it is saturated."""
        self._end = end
        self._disturbances: list[_Disturbance] = []
        self._sent: Reals | None = None
        """The values of the latest frame, as they were sent; None before the first."""
        self._measured = np.zeros((BACK, channels))
        """The values of the latest frames, as they were measured."""

    def add(
        self,
        kind: str,
        begin_s: float,
        for_s: float = math.inf,
        channel: int = 2,
        added: Reals | None = None,
    ) -> None:
        """Add a disturbance that begins at a World time."""
        disturbance = _Disturbance(kind, begin_s, begin_s + for_s, channel, added)
        self._disturbances.append(disturbance)

    def apply(self, ends_s: Reals, values: Reals, saturated: npt.NDArray[np.bool_]) -> None:
        """Change the values (n, channels) of the frames that end at `ends_s`, and whether they are
        saturated, in place."""
        measured = np.concatenate([self._measured, values])
        self._measured = measured[-BACK:]
        for one in self._disturbances:
            during = (ends_s >= one.begin_s) & (ends_s < one.end_s)
            if not during.any():
                continue
            if one.kind == "saturated":
                values[during, 2], saturated[during, 2] = self._end, True
            elif one.kind == "previous":
                values[during] = measured[:-BACK][during]
            elif one.kind == "wrong-value":
                assert one.added is not None
                values[int(during.argmax())] += one.added
                self._disturbances = [other for other in self._disturbances if other is not one]
            else:
                before = values[ends_s < one.begin_s]
                earlier = values[0].copy() if self._sent is None else self._sent
                last = before[-1] if len(before) else earlier
                stuck = slice(None) if one.kind == "frozen" else [one.channel]
                values[np.ix_(during, np.arange(values.shape[1])[stuck])] = last[stuck]
        self._sent = values[-1].copy()
