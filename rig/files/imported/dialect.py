"""Recognise how a text file separates its cells and writes its numbers, from its own lines.

Numbers are ASCII digits with one decimal sign and an exponent: what else `float` takes (``1_0``,
``nan``, other scripts' digits) is not a number of a recording. There are no thousands separators: a
comma between digits is the decimal sign or the end of a cell, as all of the rows show.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

Delimiter = Literal["tab", "semicolon", "comma", "space"]
Decimal = Literal["point", "comma"]

CHARACTER: dict[Delimiter, str] = {"tab": "\t", "semicolon": ";", "comma": ",", "space": " "}
SAMPLED_LINES = 50
"""Number of lines at the end of the file, where there are only numbers, from which the dialect is
recognised."""

_NUMBER: dict[Decimal, str] = {
    "point": r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?",
    "comma": r"[+-]?[0-9]+(?:,[0-9]+)?(?:[eE][+-]?[0-9]+)?",
}
_NO_VALUE = re.compile(r"[+-]?(?:nan|inf|infinity)\Z|n/?a\Z|null\Z", re.IGNORECASE)

_BLANKS = re.compile(r"[ \t]+")
_OF_NUMBERS = re.compile(r"[-+.,;eE\s]*[0-9][-+0-9.,;eE\s]*")
"""A line of nothing but what numbers are made of."""


@dataclass(frozen=True)
class TextDialect:
    """The way a text is written: the delimiter of its cells, and its decimal sign."""

    delimiter: Delimiter
    decimal: Decimal

    def __str__(self) -> str:
        return f"{self.delimiter}, decimal {self.decimal}"

    @cached_property
    def _number(self) -> re.Pattern[str]:
        return re.compile(_NUMBER[self.decimal])

    def cells(self, line: str) -> list[str]:
        """Return the cells of a line, without the quotes and blanks around them."""
        if self.delimiter == "space":
            return _BLANKS.split(line.strip(" \t"))
        mark = CHARACTER[self.delimiter]
        try:
            found = next(csv.reader([line], delimiter=mark, skipinitialspace=True, strict=True), [])
        except csv.Error:  # quotes that quote nothing
            found = line.split(mark)
        return [cell.strip(" \t") for cell in found]

    def is_number(self, cell: str) -> bool:
        """Return whether a cell is a number in this dialect."""
        return self._number.fullmatch(cell) is not None

    def is_number_or_none(self, cell: str) -> bool:
        """Return whether a cell is a number or stands for a missing one: NaN, inf, null."""
        return self.is_number(cell) or _NO_VALUE.match(cell) is not None

    def number(self, cell: str) -> float:
        """Return the value of a cell, with this file's decimal sign. Raises ValueError for a cell
        that is not a number."""
        return float(cell.replace(",", ".") if self.decimal == "comma" else cell)

    def row_pattern(self, width: int, wanted: Sequence[int]) -> re.Pattern[str]:
        """Return a pattern for rows of `width` cells without quotes, with a group for each wanted
        cell, in their order in the row.
        """
        number = f"({_NUMBER[self.decimal]})"
        if self.delimiter == "space":
            cells = [number if k in wanted else r"[^ \t]+" for k in range(width)]
            return re.compile(r"[ \t]*" + r"[ \t]+".join(cells) + r"[ \t]*")
        mark = re.escape(CHARACTER[self.delimiter])
        cells = [f" *{number} *" if k in wanted else f'[^"{mark}]*' for k in range(width)]
        return re.compile(mark.join(cells))


@dataclass(frozen=True)
class Shape:
    """The shape of a row of the file: its dialect, its cells, and which of them are numbers."""

    dialect: TextDialect
    width: int
    numbers: tuple[int, ...]

    def fits(self, line: str) -> bool:
        """Return whether a line is a row of this shape."""
        cells = self.dialect.cells(line)
        return len(cells) == self.width and all(
            self.dialect.is_number(cells[k]) for k in self.numbers
        )

    def nearly(self, line: str) -> bool:
        """Return whether a line looks like a row of this shape with something wrong in it, and not
        like the text above the rows.
        """
        cells = self.dialect.cells(line)
        like = [self.dialect.is_number_or_none(cell) for cell in cells]
        if len(cells) == self.width and any(like[k] for k in self.numbers):
            return True
        return 2 * sum(like) > len(cells) or _OF_NUMBERS.fullmatch(line) is not None


def recognised(
    lines: Sequence[str], delimiter: Delimiter | None = None, decimal: Decimal | None = None
) -> Shape | None:
    """Return the dialect in which the last lines are rows of two numbers or more, or None.

    Of several, the one that makes numbers of the most lines, then of the most cells of a line.
    """
    sample = [line for line in lines[-SAMPLED_LINES:] if line.strip()]
    best: tuple[tuple[int, float], Shape] | None = None
    tabs = any("\t" in line for line in sample)
    for candidate in _candidates(delimiter, decimal):
        if candidate.delimiter == "space" and tabs and delimiter is None:
            continue  # an empty cell between tabs would vanish, and the columns behind it shift
        found = _shape(sample, candidate)
        if found is not None and (best is None or found[0] > best[0]):
            best = found
    return None if best is None else best[1]


def _candidates(delimiter: Delimiter | None, decimal: Decimal | None) -> list[TextDialect]:
    delimiters: Sequence[Delimiter] = [delimiter] if delimiter else list(CHARACTER)
    decimals: Sequence[Decimal] = [decimal] if decimal else list(_NUMBER)
    return [TextDialect(d, p) for d in delimiters for p in decimals if (d, p) != ("comma", "comma")]


def _shape(sample: Sequence[str], dialect: TextDialect) -> tuple[tuple[int, float], Shape] | None:
    rows = []
    for line in sample:
        cells = dialect.cells(line)
        numbers = {k for k, cell in enumerate(cells) if dialect.is_number(cell)}
        if len(numbers) > 1:
            rows.append((len(cells), numbers))
    if not rows:
        return None
    width = Counter(width for width, _ in rows).most_common(1)[0][0]
    alike = [numbers for found, numbers in rows if found == width]
    always = set.intersection(*alike)
    if not always:
        return None
    share = sum(map(len, alike)) / len(alike) / width
    return (len(alike), share), Shape(dialect, width, tuple(sorted(always)))
