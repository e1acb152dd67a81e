"""LVM, the text files of LabVIEW's "Write To Measurement File": a table that says its own rate.

    LabVIEW Measurement      file header: Separator, Decimal_Separator, X_Columns, ...
    ***End_of_Header***
    Channels  2              segment header, a cell a channel: Samples, Y_Unit_Label, X_Dimension,
    Delta_X  0.001  0.001    X0, Delta_X, ...
    ***End_of_Header***
    X_Value  Voltage  Voltage_0  Comment
    0.000000  1.25  -0.5

Source: National Instruments, "Specification for the LabVIEW Measurement File (.lvm)". One segment a
file; files with special blocks or several segments are refused by name.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import TypeVar

from rig.core.errors import shortened
from rig.files.errors import ForeignFileError
from rig.files.imported.dialect import CHARACTER, Decimal, Delimiter, Shape, TextDialect
from rig.files.imported.source import Format
from rig.files.imported.text import UNITS, TextTable, lines_of

MAGIC = b"LabVIEW Measurement"
PRINTED_TOLERANCE = 1e-6
"""Relative, by which printed numbers that are meant to be equal may differ."""

_END = "***End_of_Header***"
_FIELD = re.compile(r"(\w+)([\t,;])(.*)")
_SEPARATORS: dict[str, Delimiter] = {"Tab": "tab", "Comma": "comma", "Semicolon": "semicolon"}
_DECIMALS: dict[str, Decimal] = {".": "point", ",": "comma"}

Fields = Mapping[str, Sequence[str]]
"""Cells of the header's lines, by the word that begins them."""
T = TypeVar("T")


class LvmTable(TextTable):
    """The segment of an LVM file (see `source.ImportSource`)."""

    format: Format = "LVM"

    def __init__(
        self, name: str, lines: Sequence[str], first: int, shape: Shape, segment: Fields, x: str
    ) -> None:
        super().__init__(name, lines, first, shape)
        self._segment = segment
        self._x = x
        self.time = "1" if x == "One" else None
        self.rate_Hz = self._own_rate()
        self._check_samples()

    def unit(self, column: int) -> str | None:
        """Return the channel's unit from Y_Unit_Label, or else from its name."""
        labels = self._segment.get("Y_Unit_Label", ())
        channel = (column - 1) // 2 if self._x == "Multi" else column - 1
        is_channel = 0 <= channel < len(labels) and not (self._x == "Multi" and column % 2 == 0)
        if column == 0 and self._x == "One":
            return "s"
        return (UNITS.get(labels[channel]) if is_channel else None) or super().unit(column)

    def _own_rate(self) -> float | None:
        """Return the 1/Delta_X of all channels, which have to begin together and be in seconds."""
        for dimension in self._segment.get("X_Dimension", ()):
            if dimension not in ("", "Time"):
                raise ForeignFileError(
                    self._file, f"X_Dimension {shortened(dimension)}: not over time"
                )
        self._equal("X0")
        step = self._equal("Delta_X")
        if step is None:
            return None
        if not 0 < step < math.inf:
            raise ForeignFileError(self._file, f"Delta_X {step:g} s is not a sampling period")
        return 1 / step

    def _equal(self, field: str) -> float | None:
        """Return the number that all channels have in a line of the header."""
        numbers = []
        for cell in filter(None, self._segment.get(field, ())):
            if not self._dialect.is_number(cell):
                raise ForeignFileError(self._file, f"{field} {shortened(cell)!r} is not a number")
            numbers.append(self._dialect.number(cell))
        for number in numbers:
            if not math.isclose(number, numbers[0], rel_tol=PRINTED_TOLERANCE):
                raise ForeignFileError(
                    self._file,
                    f"{field} is {numbers[0]:g} s for one channel and {number:g} s for another",
                    "write the channels that belong together into a file of their own",
                )
        return numbers[0] if numbers else None

    def _check_samples(self) -> None:
        for cell in filter(None, self._segment.get("Samples", ())):
            if cell != str(self.rows):
                raise ForeignFileError(
                    self._file,
                    f"{self.rows} rows, the header says Samples {shortened(cell)}",
                    "it is cut, or changed: write it again",
                )


def read_lvm(content: bytes, name: str) -> LvmTable:
    """Return the one segment of an LVM file.

    Raises ForeignFileError for several segments, special blocks, channels of different rates or
    starts, and rows that are not as many as the header says.
    """
    lines = lines_of(content, name)
    ends = _ends_of_headers(lines, name)
    head, segment = _fields(lines[: ends[0]]), _fields(lines[ends[0] + 1 : ends[1]])
    dialect = TextDialect(
        _stated(head, "Separator", _SEPARATORS, "tab", name),
        _stated(head, "Decimal_Separator", _DECIMALS, "point", name),
    )
    first = ends[1] + 2
    if first >= len(lines):
        raise ForeignFileError(name, "no rows below its header", "write it again")
    width = len(dialect.cells(lines[first - 1]))
    mark = CHARACTER[dialect.delimiter]
    # The column of comments has a name, but a cell only in rows with a comment.
    rows = [line + mark if line.count(mark) == width - 2 else line for line in lines[first:]]
    x = _stated(head, "X_Columns", {"No": "No", "One": "One", "Multi": "Multi"}, "No", name)
    return LvmTable(name, [*lines[:first], *rows], first, Shape(dialect, width, ()), segment, x)


def _ends_of_headers(lines: Sequence[str], name: str) -> list[int]:
    ends = [number for number, line in enumerate(lines) if line.rstrip("\t ,;") == _END]
    if len(ends) < 2:
        raise ForeignFileError(
            name, f"{len(ends)} of 2 lines {_END}", "it is cut, or no LVM file: write it again"
        )
    special = [n for n, line in enumerate(lines) if line.startswith("***Start_Special***")]
    for found, what in ((special[:1], "a special block"), (ends[2:3], "a second segment's header")):
        for number in found:
            raise ForeignFileError(
                name,
                what,
                "write one segment per file, without special blocks",
                f"line {number + 1}",
            )
    return ends


def _fields(lines: Sequence[str]) -> Fields:
    found = filter(None, map(_FIELD.match, lines))
    return {m[1]: [cell.strip() for cell in m[3].split(m[2])] for m in found}


def _stated(head: Fields, field: str, known: Mapping[str, T], usual: T, name: str) -> T:
    """Return the value in a line of the file's header, or the usual value if there is no such
    line."""
    if field not in head:
        return usual
    cell = next(filter(None, head[field]), ",")  # a decimal comma behind a comma
    if cell not in known:
        raise ForeignFileError(
            name, f"{field} {shortened(cell)!r} is not one of {', '.join(known)}", "write it again"
        )
    return known[cell]
