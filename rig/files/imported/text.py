"""Text with a recording in columns: CSV, tab-separated, any of them with or without a header.

The rows begin with the first line that looks like those at the file's end; the lines above are the
header. From there on every line has to be a row: any other line, even an empty one, is refused with
its line number, and nothing is skipped.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rig.core.errors import shortened
from rig.files.errors import ForeignFileError
from rig.files.imported.dialect import Decimal, Delimiter, Shape, recognised
from rig.files.imported.source import MAX_HEAD, Format

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

LONGEST_LINE = 64 << 10
"""Longest line in characters."""
MOST_COLUMNS = 1000

_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")
_COMMENT = ("#", "%")
_TIME_OF_DAY = re.compile(r"\d:\d\d")
_IN_BRACKETS = re.compile(r"[(\[]\s*([^)\]]+?)\s*[)\]]\s*\Z")
UNITS = {
    **dict.fromkeys(("V", "Volt", "Volts", "volt", "volts"), "V"),
    **dict.fromkeys(("uV", "\N{MICRO SIGN}V", "\N{GREEK SMALL LETTER MU}V"), "uV"),
    **dict.fromkeys(("us", "\N{MICRO SIGN}s", "\N{GREEK SMALL LETTER MU}s"), "us"),
    **{name: name for name in ("mV", "N", "mN", "kN", "s", "ms", "min")},
    "sec": "s",
}
"""Units as headers write them, and as the command line takes them."""


def lines_of(content: bytes, name: str) -> list[str]:
    """Return the lines of a text, without their ends: UTF-8, UTF-16 with its mark, or Latin-1.

    Raises ForeignFileError for a file that is empty, is not text, or has lines longer than
    LONGEST_LINE.
    """
    text = _decoded(content, name).replace("\r\n", "\n").replace("\r", "\n")
    if found := _CONTROL.search(text):
        raise ForeignFileError(
            name,
            f"character 0x{ord(found[0]):02x}: a binary file, not text",
            "text, LVM, MATLAB and NumPy npz files can be imported; export it as one of these",
            f"line {text.count(chr(10), 0, found.start()) + 1}",
        )
    if not text.strip():
        raise ForeignFileError(name, "an empty file")
    lines = text.split("\n")
    while not lines[-1].strip():
        lines.pop()
    for number, line in enumerate(lines, 1):
        if len(line) > LONGEST_LINE:
            raise ForeignFileError(
                name,
                f"{len(line)} characters, {LONGEST_LINE} are allowed",
                "a row of the file is one sample of every channel",
                f"line {number}",
            )
    return lines


def _decoded(content: bytes, name: str) -> str:
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        try:
            return content.decode("utf-16")
        except UnicodeDecodeError as error:
            raise ForeignFileError(name, f"not the UTF-16 that it begins as: {error}") from error
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:  # units in a header, as older programs write them
        return content.decode("latin-1")


class TextTable:
    """The rows of a text and the header above them (see `source.ImportSource`)."""

    format: Format = "text"
    rate_Hz: float | None = None
    time: str | None = None

    def __init__(self, name: str, lines: Sequence[str], first: int, shape: Shape) -> None:
        self._file = name
        self._lines = lines
        self._first = first
        self._dialect = shape.dialect
        self._width = shape.width
        self._header = [
            cells for line in lines[:first] if len(cells := self._header_cells(line)) == self._width
        ]
        self.head = "\n".join(lines[:first])[:MAX_HEAD]
        self.written_as = str(shape.dialect)

    def _header_cells(self, line: str) -> list[str]:
        return self._dialect.cells(line.lstrip("".join(_COMMENT)))

    @property
    def rows(self) -> int:
        """Return the number of lines from the first row on."""
        return len(self._lines) - self._first

    def column(self, wanted: str) -> int:
        """Return the column of a number (from 1) or of a name in the header.

        Raises ForeignFileError if the file lacks this column, or several have the name.
        """
        if re.fullmatch(r"[0-9]{1,9}", wanted):
            if not 1 <= int(wanted) <= self._width:
                raise ForeignFileError(
                    self._file,
                    f"column {wanted}: the file has {self._width}",
                    "columns are numbered from 1",
                )
            return int(wanted) - 1
        found = sorted({k for cells in self._header for k, c in enumerate(cells) if c == wanted})
        if len(found) == 1:
            return found[0]
        if found:
            where = ", ".join(str(k + 1) for k in found)
            raise ForeignFileError(
                self._file, f"columns {where} have the name {wanted!r}", "name it by its number"
            )
        known = sorted({shortened(cell) for cells in self._header for cell in cells if cell})
        hint = f"the header has {', '.join(known[:20])}" if known else "it has no header"
        raise ForeignFileError(
            self._file,
            f"no column {wanted!r}",
            f"{hint}; columns 1 to {self._width} can be named by number",
        )

    def name(self, column: int) -> str:
        """Return a column by number, with its name if the header has one."""
        named = next((cells[column] for cells in self._header if cells[column]), "")
        return f"column {column + 1}" + (f" ({shortened(named)})" if named else "")

    def unit(self, column: int) -> str | None:
        """Return the unit in brackets behind a column's name, or in the line below it."""
        for cells in self._header:
            bracketed = _IN_BRACKETS.search(cells[column])
            if unit := UNITS.get(bracketed[1] if bracketed else cells[column]):
                return unit
        return None

    def place(self, row: int) -> str:
        """Return the line of a row."""
        return f"line {self._first + row + 1}"

    def is_mask(self, column: int) -> bool:
        """Return False: numbers in a text do not say what they are."""
        return False

    def values(self, columns: Sequence[int]) -> NDArray[np.float64]:
        """Return the columns, float64 of shape (rows, columns), each number exactly as it is
        written.

        Raises ForeignFileError, with the place, for a row that is not one and for a number that no
        double can represent.
        """
        import numpy as np

        wanted = sorted(set(columns))
        matches = self._dialect.row_pattern(self._width, wanted).fullmatch
        comma = self._dialect.decimal == "comma"
        numbers = array("d")
        for row, line in enumerate(self._lines[self._first :]):
            if found := matches(line):
                cells: Sequence[str] = found.groups()
                numbers.extend(float(c.replace(",", ".") if comma else c) for c in cells)
            else:
                numbers.extend(self._examined(row, line, wanted))
        table = np.frombuffer(numbers, np.float64).reshape(-1, len(wanted))
        if not (finite := np.isfinite(table)).all():
            row, at = np.argwhere(~finite)[0]
            raise ForeignFileError(
                self._file,
                f"{self.name(wanted[at])} has a number beyond any double",
                "correct it there",
                self.place(int(row)),
            )
        return table[:, [wanted.index(k) for k in columns]]

    def _examined(self, row: int, line: str, wanted: Sequence[int]) -> list[float]:
        """Return the wanted numbers of an unusual line. Raises ForeignFileError if it is not a
        row."""

        def refuse(reason: str, hint: str) -> ForeignFileError:
            return ForeignFileError(self._file, reason, hint, self.place(row))

        if not line.strip():
            raise refuse(
                "empty, but rows follow it",
                "one recording per file: cut it there, or close the gap",
            )
        cells = self._dialect.cells(line)
        if len(cells) != self._width:
            last = ", the last line: was its writer killed?" if row == self.rows - 1 else ""
            raise refuse(
                f"{len(cells)} cells, the rows have {self._width} ({self._dialect}){last}",
                "correct or cut the file there",
            )
        for k in wanted:
            if not self._dialect.is_number(cells[k]):
                what = f"{shortened(cells[k])!r} is" if cells[k] else "an empty cell is"
                hint = "cut the file there: a sample that is missing cannot be imported"
                if _TIME_OF_DAY.search(cells[k]):
                    hint = "times are read in s: leave out --time and give --rate"
                raise refuse(
                    f"{self.name(k)}: {what} not a number ({self._dialect})",
                    hint,
                )
        return [self._dialect.number(cells[k]) for k in wanted]


def read_text(
    content: bytes,
    name: str,
    delimiter: Delimiter | None = None,
    decimal: Decimal | None = None,
    header_lines: int | None = None,
) -> TextTable:
    """Return the table in a text file. Arguments that are not given are recognised from the file.

    Raises ForeignFileError where there are no rows of at least two numbers, or more columns than
    MOST_COLUMNS, or where a line above the rows looks like one with something wrong.
    """
    lines = lines_of(content, name)
    shape = recognised(lines[header_lines or 0 :], delimiter, decimal)
    if shape is None:
        given = " ".join(filter(None, (delimiter, decimal and f"decimal {decimal}")))
        raise ForeignFileError(
            name,
            f"no rows of two numbers or more at its end{f' ({given})' if given else ''}",
            "say how its cells are separated with --delimiter and --decimal",
        )
    if shape.width > MOST_COLUMNS:
        raise ForeignFileError(name, f"{shape.width} columns, {MOST_COLUMNS} are allowed")
    first = _first_row(lines, shape, name) if header_lines is None else header_lines
    return TextTable(name, lines, first, shape)


def _first_row(lines: Sequence[str], shape: Shape, name: str) -> int:
    for number, line in enumerate(lines):
        if line.startswith(_COMMENT) or not line.strip():
            continue
        if shape.fits(line):
            _refuse_column_numbers(lines[number : number + 2], number, shape, name)
            return number
        if shape.nearly(line):
            raise ForeignFileError(
                name,
                f"looks like a row, but {_unlike(line, shape)} ({shape.dialect})",
                f"correct it, or --header-lines {number + 1} where it belongs to the header",
                f"line {number + 1}",
            )
    raise ForeignFileError(name, "no rows of numbers")


def _unlike(line: str, shape: Shape) -> str:
    """Return what distinguishes a line from the rows, as the end of "looks like a row, but"."""
    cells = shape.dialect.cells(line)
    if len(cells) == shape.width:
        for k in shape.numbers:
            if not shape.dialect.is_number(cells[k]):
                what = repr(shortened(cells[k])) if cells[k] else "an empty cell"
                return f"column {k + 1} holds {what} where the last ones hold a number"
    return f"not like the last ones: {shape.width} cells with numbers"


def _refuse_column_numbers(rows: Sequence[str], number: int, shape: Shape, name: str) -> None:
    """Raise ForeignFileError for a first row of 0, 1, 2 …: some programs write column numbers above
    columns without names, and they would be read as a sample."""
    first, *below = (shape.dialect.cells(row) for row in rows)
    counted = first in ([str(k + begin) for k in range(shape.width)] for begin in (0, 1))
    if counted and below and not all(cell.isdecimal() for cell in below[0]):
        raise ForeignFileError(
            name,
            f"{', '.join(first[:4])} can be a sample, or numbers of columns",
            f"--header-lines {number} if it is a sample, {number + 1} if it is not",
            f"line {number + 1}",
        )
