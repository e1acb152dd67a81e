"""What a bench knows besides v_1 and v_2: moves of x and normal forces that it has commanded, and
rows in which a strip's voltage was cut off at an end of the DAQ's range.

A detector is given such notices (`rig.detector.contract.Detector.notice`); recordings of other
programs have none, and every detector works without. A trial stores the notices that its detector
was given, so that `rig detect` gives them again at the same rows.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import astuple, dataclass
from typing import Any

MOVES_COLUMN, FORCES_COLUMN, CUT_OFF_COLUMN = "x_moves", "held_forces", "cut_off_rows"
"""Columns of a trial's reading that have the notices of each kind, as JSON."""
NOTICE_COLUMNS = MOVES_COLUMN, FORCES_COLUMN, CUT_OFF_COLUMN


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


@dataclass(frozen=True)
class CutOff:
    """A strip's voltage that left the range of the DAQ. Rows count from the first one of the
    record.

    The rows of a trial are filtered, so that their values do not show it: a peak that was cut off
    is smoothed, and the rows beside it overshoot.
    """

    sample: int
    """First row that contains a cut-off sample."""
    until: int
    """Row after the first one that contains the last cut-off sample."""

    def at_rows(self, row_of: Callable[[int], int]) -> CutOff:
        """Return the same notice for a resampled record; see `XMove.at_rows`."""
        first = row_of(self.sample)
        return CutOff(first, max(row_of(self.until), first + 1))


Notice = XMove | HeldForce | CutOff
"""What a detector may be given."""

_KINDS: dict[type[Notice], tuple[str, str]] = {
    XMove: ("x", MOVES_COLUMN),
    HeldForce: ("force", FORCES_COLUMN),
    CutOff: ("cut off", CUT_OFF_COLUMN),
}
"""Name of each kind in `to_text`, and its column."""


def to_text(notices: Iterable[Notice]) -> str:
    """Return notices of all kinds as one text.

    >>> to_text([XMove(100, -0.5, 300), HeldForce(120, 3.6)])
    '[["x", 100, -0.5, 300], ["force", 120, 3.6]]'
    """
    return json.dumps([(_KINDS[type(one)][0], *astuple(one)) for one in notices])


def from_text(text: str) -> list[Notice]:
    """Return the notices in a text of `to_text`. Raises ValueError for any other."""
    return _parsed(text, _of_kind)


def columns_of(notices: Iterable[Notice]) -> dict[str, str]:
    """Return notices as the columns of a trial's reading.

    >>> columns_of([XMove(100, -0.5, 300), HeldForce(120, 3.6)])
    {'x_moves': '[[100, -0.5, 300]]', 'held_forces': '[[120, 3.6]]', 'cut_off_rows': '[]'}
    """
    given = list(notices)
    return {
        column: json.dumps([astuple(one) for one in given if isinstance(one, kind)])
        for kind, (_, column) in _KINDS.items()
    }


def notices_in(reading: Mapping[str, Any]) -> list[Notice]:
    """Return the notices in a trial's reading; none of a kind whose column it lacks, as older files
    do. Their order is that within each kind, and a detector needs no other.

    Raises ValueError for columns that are not those of `columns_of`.
    """
    return [
        one
        for kind, (_, column) in _KINDS.items()
        for one in _parsed(reading.get(column) or "", _BUILDERS[kind])
    ]


def _parsed(text: str, build: Callable[..., Notice]) -> list[Notice]:
    try:
        return [build(*parts) for parts in (json.loads(text) if text else [])]
    except (TypeError, ValueError) as error:
        raise ValueError(f"not a list of notices: {error}") from error


def _of_kind(name: Any, *values: Any) -> Notice:
    for kind, (known, _) in _KINDS.items():
        if name == known:
            return _BUILDERS[kind](*values)
    raise ValueError(f"no kind of notice {name!r}")


def _move(sample: Any, speed_mm_s: Any, until: Any) -> Notice:
    return XMove(int(sample), float(speed_mm_s), int(until))


def _force(sample: Any, force_N: Any) -> Notice:
    return HeldForce(int(sample), float(force_N))


def _cut_off(sample: Any, until: Any) -> Notice:
    return CutOff(int(sample), int(until))


_BUILDERS: dict[type[Notice], Callable[..., Notice]] = {
    XMove: _move,
    HeldForce: _force,
    CutOff: _cut_off,
}
