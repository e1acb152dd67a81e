"""The kept points as a table, in the order in which they are plotted; no files."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rig.files.journal.layout import Column
from rig.files.journal.reader import JournalContents
from rig.files.runfile.former_names import value_for

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True)
class PointTable:
    """One row a kept point. ``attempts`` are the rows' indices into the journal's attempts.

    ``columns`` holds float64 arrays (NaN where a reading says nothing) or lists of text.
    """

    ids: list[str]
    attempts: list[int]
    columns: dict[str, NDArray[np.float64] | list[str]]
    warnings: list[str]

    def numbers(self, name: str) -> NDArray[np.float64]:
        """Return a number column, float64 of shape (points,)."""
        import numpy as np

        return np.asarray(self.columns[name], np.float64)

    def order(self, axes: tuple[str, ...]) -> NDArray[np.intp]:
        """Return the row indices (n,) sorted by the axes in turn; NaN comes last, equal rows stay
        in order."""
        import numpy as np

        if not axes:
            return np.arange(len(self.ids))
        return np.lexsort([self.numbers(name) for name in reversed(axes)])


def point_table(contents: JournalContents) -> PointTable:
    """Return the table of a journal's kept points, sorted by the default plot's axes."""
    layout = contents.header.layout
    rank = {point_id: n for n, point_id in enumerate(contents.header.points)}
    kept = sorted(contents.grouping.kept.items(), key=lambda item: rank.get(item[0], len(rank)))
    planned = _table([i for i, _ in kept], [n for _, n in kept], contents)
    order = planned.order(layout.order)
    return _table([kept[k][0] for k in order], [kept[k][1] for k in order], contents)


def _table(ids: list[str], attempts: list[int], contents: JournalContents) -> PointTable:
    import numpy as np

    readings = [contents.reading(attempt) for attempt in attempts]
    warnings: list[str] = []
    columns: dict[str, NDArray[np.float64] | list[str]] = {}
    layout = contents.header.layout
    for column in layout.columns:
        values = [value_for(layout, column, reading) for reading in readings]
        if column.kind == "text":
            columns[column.name] = ["" if value is None else str(value) for value in values]
        else:
            columns[column.name] = np.array(_floats(values, column, warnings), np.float64)
    return PointTable(ids, attempts, columns, warnings)


def _floats(values: list[Any], column: Column, warnings: list[str]) -> list[float]:
    """Return the values as floats; one that is not a number becomes NaN, with a warning."""
    floats, strangers = [], 0
    for value in values:
        try:
            is_number = value is None or isinstance(value, (int, float))
            floats.append(math.nan if value is None or not is_number else float(value))
        except OverflowError:
            is_number = False
            floats.append(math.nan)
        strangers += not is_number
    if strangers:
        warnings.append(f"column {column.name}: {strangers} readings do not hold a number")
    return floats
