"""An HDF5 file of this program that is open for reading."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    import h5py


class OpenFile:
    """An HDF5 file that is open for reading; use it as a context."""

    def __init__(self, path: Path, file: h5py.File) -> None:
        self.path = path
        self._file = file

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def entry(self) -> h5py.Group:
        """Return the file's ``/entry``."""
        return self._file["entry"]
