"""MATLAB files: numeric variables of version 5 (to ``-v7``, also Octave's) and of 7.3; and those of
NumPy npz files.

A channel is a column of a variable, a vector is one column. Structs, cells, objects and text are
refused by name, and never made: MATLAB can unpack them into variables.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from rig.core.errors import shortened
from rig.files.errors import ForeignFileError
from rig.files.imported.matlab_variables import (
    MAGIC_73,
    MAGIC_NPZ,
    Variables,
    arrays_of,
    variables_of,
)
from rig.files.imported.source import Format

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

HEAD_BYTES = 116
MAX_VALUES = 16 << 20
"""Largest number of values of a variable. A compressed variable can declare any number."""
EXACT = 2**53
"""Beyond it a whole number may have no double."""

NUMERIC = frozenset(
    {"double", "single", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))}
)
LOGICAL = "logical"
"""Class of truth values, 0 or 1: columns that mark when something happens."""
MOST_COLUMNS_A_ROW = 100
"""A matrix with more columns for each of its rows has a row for each channel, unless as many of
them are wanted: then a row holds the samples of one packet."""
_WANTED = re.compile(r"([A-Za-z]\w*)(?::([0-9]{1,9}))?\Z", re.ASCII)


class MatlabTable:
    """The numeric variables of a file (see `source.ImportSource`)."""

    written_as = ""
    rate_Hz: float | None = None
    time: str | None = None

    def __init__(self, name: str, content: bytes, variables: Variables) -> None:
        self._file = name
        self._content = content
        self._variables = variables
        self.format: Format = "MATLAB 7.3" if content.startswith(MAGIC_73) else "MATLAB 5"
        self.head = content[:HEAD_BYTES].decode("latin-1").strip("\0 ")
        if content.startswith(MAGIC_NPZ):
            self.format, self.head = "NumPy npz", ""
        self._columns: list[tuple[str, int]] = []
        """Variable and its column (from 0), in the order in which they were asked for."""

    def column(self, wanted: str) -> int:
        """Return the index of a column: a vector by its variable's name, or ``NAME:COLUMN``; a bare
        number (from 1) is a column of the only numeric variable.

        Raises ForeignFileError if the file lacks this variable or column, or it does not contain
        numbers.
        """
        numeric = [name for name, (kind, _) in self._variables.items() if kind in NUMERIC]
        if wanted.isdecimal() and len(numeric) == 1:
            wanted = f"{numeric[0]}:{wanted}"
        found = _WANTED.match(wanted)
        if found is None or found[1] not in self._variables:
            structs = [name for name, (kind, _) in self._variables.items() if kind == "struct"]
            if (whole := wanted.partition(".")[0]) in structs:  # MATLAB calls a part NAME.PART
                raise self._not_numeric(whole)
            if structs and not numeric:
                raise self._not_numeric(sorted(structs)[0])
            masks = [name for name, (kind, _) in self._variables.items() if kind == LOGICAL]
            known = ", ".join(map(shortened, sorted(numeric)[:20])) or "none that is numeric"
            if masks:
                known += f", and for motion, slip and lift_off {', '.join(sorted(masks)[:20])}"
            raise ForeignFileError(
                self._file,
                f"no variable {shortened(wanted)!r}",
                f"it has {known}; write NAME, or NAME:COLUMN of a matrix",
            )
        variable, (kind, shape) = found[1], self._variables[found[1]]
        if kind not in NUMERIC and kind != LOGICAL:
            raise self._not_numeric(variable)
        if len(shape) != 2 or 0 in shape:
            size = " x ".join(map(str, shape)) or "a single number"
            raise ForeignFileError(
                self._file,
                f"variable {variable} is {size}, not a vector or matrix",
                "save it with one row per sample",
            )
        columns = 1 if 1 in shape else shape[1]
        if found[2] is None:
            self._check_orientation(variable, 1)
        number = int(found[2] or 1)
        if not 1 <= number <= columns or (found[2] is None and columns > 1):
            raise ForeignFileError(
                self._file,
                f"variable {variable} has {columns} columns: {wanted} is none of them",
                f"write {variable}:1 to {variable}:{columns}",
            )
        if (key := (variable, number - 1)) not in self._columns:
            self._columns.append(key)
        return self._columns.index(key)

    def _not_numeric(self, variable: str) -> ForeignFileError:
        """Return the error of a variable that is not an array of numbers."""
        kind = shortened(self._variables[variable][0])
        if self.format == "NumPy npz":
            return ForeignFileError(
                self._file,
                f"variable {variable} holds values of the type {kind}, not real numbers",
                "save it as an array of numbers, such as float64",
            )
        return ForeignFileError(
            self._file,
            f"variable {variable} is a {kind}, not an array of numbers",
            "save its parts as variables, a struct with save(FILE, '-struct', NAME)",
        )

    def name(self, column: int) -> str:
        """Return a column as the user finds it: its variable, and its number in a matrix."""
        variable, number = self._columns[column]
        shape = self._variables[variable][1]
        many = 1 not in shape
        return f"column {number + 1} of variable {variable}" if many else f"variable {variable}"

    def unit(self, column: int) -> str | None:
        """Return None: MATLAB's arrays have no units."""
        return None

    def is_mask(self, column: int) -> bool:
        """Return whether a column is of MATLAB's class logical, or of NumPy's type bool."""
        variable, _ = self._columns[column]
        return self._variables[variable][0] == LOGICAL

    def place(self, row: int) -> str:
        """Return a row as MATLAB counts them, from 1."""
        return f"row {row + 1}"

    def values(self, columns: Sequence[int]) -> NDArray[np.float64]:
        """Return the columns as float64, shape (rows, columns).

        Raises ForeignFileError for columns of different lengths and for values that are not finite.
        """
        import numpy as np

        wanted = [self._columns[column][0] for column in columns]
        names = list(dict.fromkeys(wanted))
        for variable in names:
            self._check_size(variable)
            self._check_orientation(variable, wanted.count(variable))
        arrays = arrays_of(self._content, self._file, names)
        loaded = {variable: self._exact(variable, array) for variable, array in arrays.items()}
        taken = []
        for column in columns:
            variable, number = self._columns[column]
            array = loaded[variable]
            taken.append(array.reshape(-1) if 1 in array.shape else array[:, number])
            if len(taken[-1]) != len(taken[0]):
                raise ForeignFileError(
                    self._file,
                    f"{self.name(column)} has {len(taken[-1])} values, {self.name(columns[0])} "
                    f"{len(taken[0])}",
                    "every channel needs the same number of samples",
                )
            if not (finite := np.isfinite(taken[-1])).all():
                row = int(np.argmin(finite))
                raise ForeignFileError(
                    self._file,
                    f"{self.name(column)}: {taken[-1][row]} is not a number",
                    "cut the recording there: a sample that is missing cannot be imported",
                    self.place(row),
                )
        return np.column_stack(taken)

    def _check_size(self, variable: str) -> None:
        count = math.prod(self._variables[variable][1])
        if count > MAX_VALUES:
            raise ForeignFileError(
                self._file,
                f"variable {variable} has {count} values, {MAX_VALUES} are allowed",
                "save the channels that are wanted alone",
            )

    def _check_orientation(self, variable: str, wanted: int) -> None:
        """ForeignFileError for a matrix with a row for each channel, of which so few columns are
        wanted."""
        rows, columns = self._variables[variable][1]
        if rows > 1 and columns > MOST_COLUMNS_A_ROW * rows and wanted < MOST_COLUMNS_A_ROW:
            raise ForeignFileError(
                self._file,
                f"variable {variable} has {rows} rows and {columns} columns",
                "exchange them (transpose it): save it with one row per sample",
            )

    def _exact(self, variable: str, array: NDArray[Any]) -> NDArray[np.float64]:
        """Return a variable as doubles. Raises ForeignFileError where a whole number has none."""
        import numpy as np

        kind, shape = self._variables[variable]
        if array.shape != shape or array.dtype.kind not in "biuf":
            raise ForeignFileError(
                self._file,
                f"variable {variable}: {array.dtype} {array.shape}, not the {kind} {shape} that "
                "the file announces",
                "save it again as an array of real numbers",
            )
        if (
            array.dtype.kind in "iu"
            and array.size
            and max(int(array.max()), -int(array.min())) > EXACT
        ):
            raise ForeignFileError(
                self._file,
                f"variable {variable}: whole numbers beyond {EXACT} have no double",
                "save it as double, if the digits do not matter",
            )
        return array.astype(np.float64)


def read_matlab(content: bytes, name: str) -> MatlabTable:
    """Return the variables of a MATLAB file. Raises ForeignFileError if it cannot be read."""
    return MatlabTable(name, content, variables_of(content, name))
