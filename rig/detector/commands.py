"""What a bench knows beside v_1 and v_2: the moves of x that it has commanded.

A detector may be given them (`rig.detector.contract.Detector.command`); recordings of other
programs have none, and every detector works without. A trial stores the moves that its detector was
given, so that `rig detect` gives them again at the same rows.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from dataclasses import astuple, dataclass


@dataclass(frozen=True)
class XMove:
    """A move of x as it was commanded. Rows count from the first one of the record."""

    sample: int
    """Row from which on x moves so."""
    speed_mm_s: float
    """Commanded speed, positive towards larger positions; 0 for a stop."""
    until: int
    """Row at which x comes to its target and stops, unless a further move comes before."""

    def at_rows(self, row_of: Callable[[int], int]) -> XMove:
        """Return the same move at the rows of a resampled record; `row_of` gives the row there of a
        row of this one."""
        return XMove(row_of(self.sample), self.speed_mm_s, row_of(self.until))


def to_text(moves: Iterable[XMove]) -> str:
    """Return moves as the text of a reading's column.

    >>> to_text([XMove(100, -0.5, 300)])
    '[[100, -0.5, 300]]'
    """
    return json.dumps([astuple(one) for one in moves])


def from_text(text: str) -> list[XMove]:
    """Return the moves in a reading's column; none for "", as in files of before.

    Raises ValueError for a text that is not one of `to_text`.
    """
    try:
        return [
            XMove(int(sample), float(speed_mm_s), int(until))
            for sample, speed_mm_s, until in (json.loads(text) if text else [])
        ]
    except TypeError as error:
        raise ValueError(f"not a list of moves of x: {error}") from error
