"""Recognises the kind of a file by its first bytes, and refuses one of the wrong kind."""

from __future__ import annotations

import contextlib
import errno
import stat
from pathlib import Path
from typing import Literal

from rig.core.errors import ExitCode
from rig.core.text import in_shell
from rig.files.errors import RunFileError
from rig.files.journal.format import MAGIC
from rig.files.naming import CHECKSUM_SUFFIX, RUN_SUFFIX

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

MISTYPED: frozenset[FileKind] = frozenset({"missing", "folder", "special"})
"""Kinds of a path that does not lead to a file: nothing was checked, so nothing was found wrong."""
BATCH_QUEUE = "queue.sqlite"
"""Name by which the folder of a batch is recognised (`rig.batch.folder`)."""

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
    except OSError as error:
        return "missing" if error.errno == errno.ENAMETOOLONG else "unreadable"
    if not begins:
        return "empty"
    if begins.startswith(MAGIC) or MAGIC.startswith(begins):
        return "journal"
    return "hdf5" if begins.startswith(_HDF5) else "other"


def described(path: Path, kind: FileKind) -> tuple[str, str | None]:
    """Return what a file of a kind that cannot be used is, in words, and a hint where another
    command or file helps. Raises nothing."""
    if kind == "journal":
        return "a journal, not a run file", "`rig recover` compiles it"
    with contextlib.suppress(OSError):  # a folder that may not be looked into
        if kind == "folder" and (path / BATCH_QUEUE).is_file():
            return (
                "the folder of a batch, not a file",
                f"`rig batch status {in_shell(path)}` shows the batch",
            )
        if kind == "folder" and any(path.glob(f"*{RUN_SUFFIX}")):
            return IN_WORDS[kind], f"name the files in it: {path / f'*{RUN_SUFFIX}'}"
    if kind == "other" and path.name == BATCH_QUEUE:
        return "the queue of a batch", f"`rig batch status {in_shell(path.parent)}` shows the batch"
    if kind == "other" and path.name.endswith(CHECKSUM_SUFFIX):
        return "a checksum, not the file itself", f"name {path.name.removesuffix(CHECKSUM_SUFFIX)}"
    if kind == "unreadable":
        try:
            path.open("rb").close()
        except OSError as error:
            return f"{IN_WORDS[kind]} ({error.strerror})", None
    return IN_WORDS[kind], None


def require_hdf5(path: Path) -> None:
    """Raise RunFileError for a file that is not an HDF5 file; it says what the file is instead. The
    exit code is that of a usage error where nothing has that name."""
    if (kind := kind_of(path)) != "hdf5":
        code = ExitCode.USAGE if kind in MISTYPED else None
        raise RunFileError(path, *described(path, kind), code)
