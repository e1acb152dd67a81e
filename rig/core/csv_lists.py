"""Read lists in CSV, as editors and spreadsheets write them, into rows by column name.

A list has a header. Its cells are separated by commas; in a list without a comma in its header, by
semicolons or tabs, as spreadsheets write it in countries with a decimal comma: there 1,9 is 1.9. A
first line such as ``sep=;`` says by what.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

from rig.core.errors import ConfigurationError, shortened
from rig.core.toml_files import read_text

_QUOTED = re.compile(r'"[^"]*"')
_STATED = re.compile(r"sep=([,;\t])", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"^([-+]?[0-9]*),([0-9]+)$")


class ListRow(NamedTuple):
    """A row of a list in CSV, with its place in the file."""

    line: int
    """Number of the line in the file, from 1; of the last one, if a cell holds line breaks."""
    cells: dict[str, str]
    """Cells by the names of their columns, without blanks around them."""


def read_list(
    path: Path, what: str, most_bytes: int, texts: Collection[str]
) -> tuple[list[str], list[ListRow]]:
    """Return the names of the columns of a list, and its rows; empty lines, and columns without a
    name in which nothing is, are left out. In all columns but `texts` a decimal comma is replaced.

    Raises ConfigurationError as `read_text` does, and for a column that appears twice, and, with
    its line, for a row with more or fewer cells than the header or with a cell under no name.
    """
    text = io.StringIO(read_text(path, what, most_bytes), newline=None).read()  # any line ends
    header = next((line for line in text.split("\n") if line.strip(' ,;\t"')), "")
    stated = _STATED.fullmatch(header.strip(' "'))
    delimiter = stated[1] if stated else _delimiter_of(header)
    reader = csv.reader(io.StringIO(text), delimiter=delimiter)
    try:
        lines = [(reader.line_num, cells) for cells in reader if any(map(str.strip, cells))]
    except csv.Error as error:
        raise ConfigurationError(f"{path}, line {reader.line_num}: {error}") from error
    if stated:
        lines = lines[1:]
    names = [name.strip() for name in lines[0][1]] if lines else []
    while names and not names[-1]:  # spreadsheets leave empty columns behind the last
        names.pop()
    if twice := [name for name in names if name and names.count(name) > 1]:
        raise ConfigurationError(f"{path}: the column {twice[0]!r} appears twice")
    rows: list[ListRow] = []
    for line, row in lines[1:]:
        cells = [cell.strip() for cell in row]
        if len(cells) < len(names) or any(cells[len(names) :]):
            raise ConfigurationError(
                f"{path}, line {line}: the number of cells differs from the header"
            )
        if stray := [cell for name, cell in zip(names, cells, strict=False) if cell and not name]:
            raise ConfigurationError(
                f"{path}, line {line}: {shortened(stray[0])!r} is in a column without a name"
            )
        named = {name: cell for name, cell in zip(names, cells, strict=False) if name}
        if delimiter != ",":
            for name in named.keys() - set(texts):
                named[name] = _DECIMAL_COMMA.sub(r"\1.\2", named[name])
        rows.append(ListRow(line, named))
    return [name for name in names if name], rows


def _delimiter_of(header: str) -> str:
    """Return by what the cells of a header are separated; what is quoted is part of a name."""
    unquoted = _QUOTED.sub("", header)
    return next((one for one in ",;\t" if one in unquoted), ",")
