"""Recognises the kind of a file by its first bytes."""

from __future__ import annotations

import stat
from pathlib import Path
from typing import Literal

from rig.files.journal.format import MAGIC

FileKind = Literal[
    "missing", "folder", "special", "unreadable", "empty", "journal", "hdf5", "other"
]

IN_WORDS: dict[FileKind, str] = {
    "missing": "no such file",
    "folder": "a folder, not a file",
    "special": "not a regular file",
    "unreadable": "it cannot be read",
    "empty": "an empty file",
    "journal": "a journal",
    "hdf5": "an HDF5 file",
    "other": "not a journal and not a run file",
}
"""The kinds in words."""

_HDF5 = b"\x89HDF\r\n\x1a\n"


def kind_of(path: Path) -> FileKind:
    """Return what the file is by its first bytes, whatever its name says. Raises nothing."""
    try:
        if not stat.S_ISREG(mode := path.stat().st_mode):  # a pipe would be waited for
            return "folder" if stat.S_ISDIR(mode) else "special"
        with path.open("rb") as file:
            begins = file.read(max(len(MAGIC), len(_HDF5)))
    except (FileNotFoundError, NotADirectoryError):
        return "missing"
    except OSError:
        return "unreadable"
    if not begins:
        return "empty"
    if begins.startswith(MAGIC) or MAGIC.startswith(begins):
        return "journal"
    return "hdf5" if begins.startswith(_HDF5) else "other"
