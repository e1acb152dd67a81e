"""The interface of the readers of all formats: columns that can be found, named and read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal, Protocol

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Format = Literal["text", "LVM", "MATLAB 5", "MATLAB 7.3", "NumPy npz"]

MAX_BYTES = 128 << 20
"""Largest size of a file: an hour of four columns at 1 kHz, as text. The file is read in one
piece."""
MAX_HEAD = 64 << 10
"""Characters of the text before the numbers that are recorded with them."""


class ImportSource(Protocol):
    """The columns of a file. Every error is a ForeignFileError that names the place."""

    format: Format
    head: str
    """The text before the numbers, verbatim, at most MAX_HEAD characters."""
    written_as: str
    """The way the file is written, if it was recognised: ``tab, decimal comma``."""
    rate_Hz: float | None
    """The rate that the file itself states."""
    time: str | None
    """The column of times that the file itself names, as ``column`` takes it."""

    def column(self, wanted: str) -> int:
        """Return the index of the column that the user named by a number (from 1) or a name."""
        ...

    def name(self, column: int) -> str:
        """Return a column as the user finds it: ``column 2 (Voltage)``."""
        ...

    def unit(self, column: int) -> str | None:
        """Return the unit that the file states for a column, or None if it states none that is
        known.
        """
        ...

    def is_mask(self, column: int) -> bool:
        """Return whether the file says that a column holds truth values, which are no signal."""
        ...

    def values(self, columns: Sequence[int]) -> NDArray[np.float64]:
        """Return columns as they stand in the file, finite numbers of shape (rows, columns)."""
        ...

    def place(self, row: int) -> str:
        """Return where a row (from 0) stands in the file: ``line 12``."""
        ...
