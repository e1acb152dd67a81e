"""Read lists in CSV, as editors and spreadsheets write them, into rows by column name.

A list has a header. Its cells are separated by commas; in a list without a comma in its header, by
semicolons or tabs, as spreadsheets write it in countries with a decimal comma: there 1,9 is 1.9.
"""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path
from typing import NamedTuple

from rig.core.errors import ConfigurationError
from rig.core.toml_files import read_text

_DECIMAL_COMMA = re.compile(r"^([-+]?[0-9]*),([0-9]+)$")


class ListRow(NamedTuple):
    """A row of a list."""

    line: int
    """Its line in the file, from 1; the last one, if a cell holds line breaks."""
    cells: dict[str, str]
    """Its cells by the names of their columns, without blanks around them."""


def read_list(path: Path, what: str, most_bytes: int) -> tuple[list[str], list[ListRow]]:
    """Return the names of the columns of a list, and its rows; empty lines are left out.

    Raises ConfigurationError as `read_text` does, and for a column that is there twice, and, with
    its line, for a row with more or fewer cells than the header.
    """
    text = read_text(path, what, most_bytes)
    header = text.partition("\n")[0]
    delimiter = "," if "," in header else ";" if ";" in header else "\t" if "\t" in header else ","
    reader = csv.reader(io.StringIO(text), delimiter=delimiter)
    try:
        lines = [(reader.line_num, cells) for cells in reader if any(map(str.strip, cells))]
    except csv.Error as error:
        raise ConfigurationError(f"{path}, line {reader.line_num}: {error}") from error
    names = [name.strip() for name in lines[0][1]] if lines else []
    while names and not names[-1]:  # spreadsheets leave empty columns behind the last
        names.pop()
    if twice := [name for name in names if names.count(name) > 1]:
        raise ConfigurationError(f"{path}: the column {twice[0]!r} is there twice")
    rows: list[ListRow] = []
    for line, row in lines[1:]:
        cells = [cell.strip() for cell in row]
        if len(cells) < len(names) or any(cells[len(names) :]):
            raise ConfigurationError(
                f"{path}, line {line}: the number of cells differs from the header"
            )
        if delimiter != ",":
            cells = [_DECIMAL_COMMA.sub(r"\1.\2", cell) for cell in cells]
        rows.append(ListRow(line, dict(zip(names, cells, strict=False))))
    return names, rows
