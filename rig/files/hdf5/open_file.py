"""An HDF5 file of this program that is open for reading."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Self

from rig.files.file_kind import kind_of
from rig.files.hdf5.safe_reading import DAMAGE, refuse_links, text_of

if TYPE_CHECKING:
    import h5py


def definition_of(path: Path) -> str:
    """Return what a file says that it is; "" for a damaged or foreign one."""
    import h5py

    if kind_of(path) != "hdf5":
        return ""
    try:
        with h5py.File(path, "r") as file:
            refuse_links(file)
            return text_of(file["entry/definition"])
    except DAMAGE:
        return ""


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
