"""An HDF5 file of this program that is open for reading."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Self

from rig.files.errors import RunFileError, in_words, why_not_opened
from rig.files.file_kind import kind_of, require_hdf5
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
    """An HDF5 file that is open for reading; use it as a context. Whatever is wrong with it is a
    RunFileError that names it."""

    KIND: ClassVar[str]
    """What such a file is called in a message: "run file"."""
    REMEDY: ClassVar[str | None] = None
    """What helps where one is damaged."""

    def __init__(self, path: Path, file: h5py.File) -> None:
        self.path = path
        self._file = file

    @classmethod
    def open(cls, path: Path | str) -> Self:
        """Open a file. Raises RunFileError if it cannot be read or is another kind of file."""
        import h5py

        path = Path(path)
        require_hdf5(path)
        with cls._naming_damage(path):
            file = h5py.File(path, "r")
        opened = cls(path, file)
        try:
            with opened._naming():
                refuse_links(file)
                opened._check()
        except RunFileError:
            file.close()
            raise
        return opened

    def _check(self) -> None:
        """Read what every file of this kind has. Raises RunFileError for another kind of file, and
        whatever reading raises for a damaged one."""
        raise NotImplementedError

    def _naming(self) -> AbstractContextManager[None]:
        """Raise damage to the file within the block as a RunFileError that names it."""
        return self._naming_damage(self.path)

    @classmethod
    @contextmanager
    def _naming_damage(cls, path: Path) -> Iterator[None]:
        try:
            yield
        except RunFileError:
            raise
        except DAMAGE as error:
            cause = f"not a readable {cls.KIND}: {in_words(error)}"
            remedy = None if why_not_opened(error) else cls.REMEDY
            raise RunFileError(path, cause, remedy) from error

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def entry(self) -> h5py.Group:
        """The file's NeXus entry, ``/entry``, with all else in it. Raises KeyError without one."""
        return self._file["entry"]
