"""Reading HDF5 that anybody may have written: what a file declares is checked before it is read.

A few bytes can declare more values than any memory holds, or that the values are in another file.
Run files do neither. ValueError says what is refused.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import h5py

DAMAGE = (OSError, KeyError, ValueError, RuntimeError, TypeError, AttributeError, OverflowError)
"""Errors that are raised by reading a damaged or foreign file."""

MAX_BYTES = 1 << 30
"""Largest size of a dataset that is read in one piece."""
MAX_CHUNK_BYTES = 64 << 20
"""Run files have chunks of at most two MiB."""
MAX_COMPRESSION = 1100
"""Deflate makes at most 1032 bytes of one."""


def refuse_links(file: h5py.File) -> None:
    """Raise ValueError if a name in the file is a link and not an object: a link may lead to any
    file of the computer.
    """
    from h5py import h5l

    def link(name: bytes, info: Any) -> str | None:
        return None if info.type == h5l.TYPE_HARD else name.decode(errors="replace")

    if (found := file.id.links.visit(link, info=True)) is not None:
        raise ValueError(f"{found} is a link")


def checked(field: h5py.Dataset) -> h5py.Dataset:
    """Return the dataset if its values are in this file, as many as it declares. ValueError
    otherwise.
    """
    if field.is_virtual or field.external:
        raise ValueError(f"{field.name}: its values are in another file")
    stored = field.id.get_storage_size()
    if field.nbytes > MAX_COMPRESSION * stored:
        raise ValueError(f"{field.name}: declares {field.nbytes} bytes and stores {stored}")
    if field.chunks:
        chunk = field.dtype.itemsize
        for length in field.chunks:
            chunk *= length
        if chunk > MAX_CHUNK_BYTES:
            raise ValueError(f"{field.name}: a chunk of {chunk} bytes")
    return field


def whole(field: h5py.Dataset) -> Any:
    """Return all values of a dataset, an array or a scalar. Raises ValueError beyond MAX_BYTES."""
    if checked(field).nbytes > MAX_BYTES:
        raise ValueError(f"{field.name}: {field.nbytes} bytes in one piece")
    return field[()]


def text_of(field: h5py.Dataset) -> str:
    """Return the value of a text dataset. Raises ValueError beyond MAX_BYTES."""
    value = whole(field)
    return value.decode() if isinstance(value, bytes) else str(value)


def texts_of(field: h5py.Dataset) -> list[str]:
    """Return the values of a dataset of texts. Raises ValueError beyond MAX_BYTES in all."""
    rows = max(MAX_BYTES // field.file.id.get_filesize(), 1)  # each may be as long as the file
    texts: list[str] = []
    read = 0
    for first in range(0, len(checked(field)), rows):
        part = field[first : first + rows]
        read += sum(map(len, part))
        if read > MAX_BYTES:
            raise ValueError(f"{field.name}: more than {MAX_BYTES} bytes of text")
        texts += [value.decode() for value in part]
    return texts
