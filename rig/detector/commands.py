"""What a bench knows beside v_1 and v_2: moves of x and normal forces that it has commanded.

A detector may be given them (`rig.detector.contract.Detector.command`); recordings of other
programs have none, and every detector works without. A trial stores the commands that its detector
was given, so that `rig detect` gives them again at the same rows.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

COLUMN, FORMER_COLUMN = "commands", "x_moves"
"""Name of the reading's column that has the commands; and of that in files of before, which has the
moves of x only."""


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


@dataclass(frozen=True)
class HeldForce:
    """A normal force that z was commanded to hold. Rows count from the first one of the record."""

    sample: int
    """Row from which on it is to be held; a servo comes to it some ticks later."""
    force_N: float
    """Set point of the normal force."""

    def at_rows(self, row_of: Callable[[int], int]) -> HeldForce:
        """Return the same command at the rows of a resampled record, as `XMove.at_rows` does."""
        return HeldForce(row_of(self.sample), self.force_N)


Command = XMove | HeldForce
"""What a detector may be given."""


def to_text(commands: Iterable[Command]) -> str:
    """Return commands as the text of a reading's column.

    >>> to_text([XMove(100, -0.5, 300), HeldForce(120, 3.6)])
    '[["x", 100, -0.5, 300], ["force", 120, 3.6]]'
    """
    return json.dumps(
        [
            ("x", one.sample, one.speed_mm_s, one.until)
            if isinstance(one, XMove)
            else ("force", one.sample, one.force_N)
            for one in commands
        ]
    )


def from_text(text: str) -> list[Command]:
    """Return the commands in a reading's column; none for "".

    Raises ValueError for a text that is not one of `to_text`, or of a former version.
    """
    try:
        return [_command(*parts) for parts in (json.loads(text) if text else [])]
    except TypeError as error:
        raise ValueError(f"not a list of commands: {error}") from error


def _command(kind: Any, *values: Any) -> Command:
    if kind == "force":
        sample, force_N = values
        return HeldForce(int(sample), float(force_N))
    # Files of before have moves of x only, which do not say so.
    sample, speed_mm_s, until = values if kind == "x" else (kind, *values)
    return XMove(int(sample), float(speed_mm_s), int(until))


def text_in(reading: Mapping[str, Any]) -> str:
    """Return the text of the commands in a reading; "" where it has none.

    >>> text_in({"x_moves": "[[100, -0.5, 300]]"})
    '[[100, -0.5, 300]]'
    """
    return str(reading.get(COLUMN) or reading.get(FORMER_COLUMN) or "")
