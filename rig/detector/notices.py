"""What a bench knows beside v_1 and v_2: moves of x and normal forces that it has commanded.

A detector may be given them (`rig.detector.contract.Detector.command`); recordings of other
programs have none, and every detector works without. A trial stores the commands that its detector
was given, so that `rig detect` gives them again at the same rows.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import astuple, dataclass
from typing import Any

MOVES_COLUMN, FORCES_COLUMN = "x_moves", "held_forces"
"""Columns of a trial's reading that have the commands of each kind, as JSON."""


@dataclass(frozen=True)
class XMove:
    """A move of x as it was commanded. Rows count from the first one of the record."""

    sample: int
    """Row from which on x has this speed."""
    speed_mm_s: float
    """Commanded speed, positive towards larger positions; 0 for a stop."""
    until: int
    """Row at which x comes to its target and stops, unless a further move comes before."""

    def at_rows(self, row_of: Callable[[int], int]) -> XMove:
        """Return the same move for a resampled record.

        `row_of` converts a row of this record to the corresponding row of that one.
        """
        return XMove(row_of(self.sample), self.speed_mm_s, row_of(self.until))


@dataclass(frozen=True)
class HeldForce:
    """A normal force that z was commanded to hold. Rows count from the first one of the record."""

    sample: int
    """Row from which on it is to be held; the servo reaches it some ticks later."""
    force_N: float
    """Set point of the normal force."""

    def at_rows(self, row_of: Callable[[int], int]) -> HeldForce:
        """Return the same command for a resampled record; see `XMove.at_rows`."""
        return HeldForce(row_of(self.sample), self.force_N)


Command = XMove | HeldForce
"""What a detector may be given."""


def to_text(commands: Iterable[Command]) -> str:
    """Return commands of both kinds as one text.

    >>> to_text([XMove(100, -0.5, 300), HeldForce(120, 3.6)])
    '[["x", 100, -0.5, 300], ["force", 120, 3.6]]'
    """
    return json.dumps(
        [("x" if isinstance(one, XMove) else "force", *astuple(one)) for one in commands]
    )


def from_text(text: str) -> list[Command]:
    """Return the commands in a text of `to_text`. Raises ValueError for any other."""
    return _parsed(text, _of_kind)


def columns_of(commands: Iterable[Command]) -> dict[str, str]:
    """Return commands as the columns of a trial's reading.

    >>> columns_of([XMove(100, -0.5, 300), HeldForce(120, 3.6)])
    {'x_moves': '[[100, -0.5, 300]]', 'held_forces': '[[120, 3.6]]'}
    """
    given = list(commands)
    return {
        column: json.dumps([astuple(one) for one in given if isinstance(one, kind)])
        for column, kind in ((MOVES_COLUMN, XMove), (FORCES_COLUMN, HeldForce))
    }


def commands_in(reading: Mapping[str, Any]) -> list[Command]:
    """Return the commands in a trial's reading; none where it has no such columns, as in older
    files. Their order is that within each kind, and a detector needs no other.

    Raises ValueError for columns that are not those of `columns_of`.
    """
    moves = _parsed(reading.get(MOVES_COLUMN) or "", _move)
    return [*moves, *_parsed(reading.get(FORCES_COLUMN) or "", _force)]


def _parsed(text: str, command: Callable[..., Command]) -> list[Command]:
    try:
        return [command(*parts) for parts in (json.loads(text) if text else [])]
    except (TypeError, ValueError) as error:
        raise ValueError(f"not a list of commands: {error}") from error


def _of_kind(kind: Any, *values: Any) -> Command:
    if kind == "x":
        return _move(*values)
    if kind == "force":
        return _force(*values)
    raise ValueError(f"no kind of command {kind!r}")


def _move(sample: Any, speed_mm_s: Any, until: Any) -> Command:
    return XMove(int(sample), float(speed_mm_s), int(until))


def _force(sample: Any, force_N: Any) -> Command:
    return HeldForce(int(sample), float(force_N))
