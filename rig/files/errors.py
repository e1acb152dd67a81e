"""Errors of recordings, as RigErrors that name the file and the place."""

from __future__ import annotations

import errno
import re
from pathlib import Path

from rig.core.errors import ConfigurationError, ExitCode, FoundWrongError, RigError

_MISSING = re.compile(r"object '([^']+)' doesn't exist")


LOCKS_NEEDED = (
    "use a folder on a file system that locks files: a local disk, or NFS with its lock service"
)
"""Remedy where a lock is refused by the file system itself."""
NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
"""Error numbers of a file system that cannot lock files."""
TOO_MANY_OPEN = (errno.EMFILE, errno.ENFILE)
"""Error numbers of a process or computer with too many open files."""
_NOT_THE_FILE = {
    **dict.fromkeys(
        NO_LOCKS,
        "its file system does not lock files; copy it to a local disk, or set "
        "HDF5_USE_FILE_LOCKING=FALSE",
    ),
    **dict.fromkeys(TOO_MANY_OPEN, "too many files are open; raise the limit (ulimit -n)"),
    errno.ENOMEM: "the memory is not enough for it",
    errno.EACCES: "its permissions do not allow it",
    errno.EWOULDBLOCK: "another program has it open for writing; close it there",
}
"""Reasons why a file cannot be opened that say nothing about what is in it, by error number."""


def room_for(error: OSError) -> str:
    """Return what to do so that a file can be written where the disk has refused it, as the
    beginning of a hint."""
    if error.errno == errno.EFBIG:
        return "raise the limit on the size of a file (ulimit -f), or use another file system"
    if error.errno in TOO_MANY_OPEN:
        return "raise the limit on open files (ulimit -n)"
    return "free space or write access there"


class JournalError(RigError):
    """A journal that cannot be used. Names the file, the byte offset and the reason."""

    code = ExitCode.USAGE

    def __init__(
        self,
        path: Path | str,
        offset: int | None,
        reason: str,
        hint: str | None = None,
        code: ExitCode | None = None,
    ) -> None:
        place = f"{path}" if offset is None else f"{path}: byte {offset}"
        super().__init__(f"{place}: {reason}", hint, code)
        self.path = Path(path)
        self.offset = offset
        self.reason = reason


class RecordingError(RigError):
    """The run can no longer be recorded. Names the file, the cause and the remedy."""

    def __init__(self, path: Path | str, cause: str, hint: str | None = None) -> None:
        super().__init__(f"{path}: {cause}", hint)
        self.path = Path(path)


class JournalMovedError(RecordingError):
    """The journal's file lost its name while it was written. Nothing is lost: the writer has copied
    it to `now_at` and writes there, but the run ends, because whoever did this may do more."""

    def __init__(self, path: Path | str, cause: str, now_at: Path) -> None:
        super().__init__(
            path,
            f"{cause} while the run was writing it; everything recorded is in {now_at}",
            "find out who deletes or moves files in the results folder, then resume the run",
        )
        self.now_at = now_at


class DiskLateError(RecordingError):
    """The disk has acknowledged nothing for a time. Nothing is lost as long as the run lives: it
    still waits to be written."""


class RunFileError(FoundWrongError):
    """A file that is not a sound run file or processed file. Names the file and the reason."""

    def __init__(
        self,
        path: Path | str,
        reason: str,
        hint: str | None = None,
        code: ExitCode | None = None,
    ) -> None:
        super().__init__(f"{path}: {reason}", hint, code)
        self.path = Path(path)
        self.reason = reason


class ForeignFileError(ConfigurationError):
    """A file of another program that cannot be imported; names file, place and reason."""

    def __init__(
        self, name: str, reason: str, hint: str | None = None, place: str | None = None
    ) -> None:
        super().__init__(f"{name}: {place}: {reason}" if place else f"{name}: {reason}", hint)
        self.place = place
        self.reason = reason


def why_not_opened(error: Exception) -> str:
    """Return why a file that may be sound cannot be opened; empty where the file is to blame."""
    number = error.errno if isinstance(error, OSError) else None
    return "" if number is None else _NOT_THE_FILE.get(number, "")


def in_words(error: Exception) -> str:
    """Return what a library's error about a damaged file means for the user."""
    if isinstance(error, KeyError):
        named = _MISSING.search(str(error))
        return f"{named[1] if named else 'something that belongs there'} is missing"
    if reason := why_not_opened(error):
        return reason
    if isinstance(error, OSError | RuntimeError):
        return "it is damaged: some of its bytes cannot be read"
    return "a value in it is not what belongs there"


def not_written(target: Path, error: OSError) -> RecordingError:
    """Return the error that reports results of a run file that could not be written."""
    elsewhere = "name another folder with --to; the run file is untouched"
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        elsewhere = f"free space there, or {elsewhere}"
    reason = error.strerror or str(error)
    if error.errno in (errno.EEXIST, errno.ENOTDIR) and error.filename is not None:
        reason = f"{error.filename} is not a folder"
    return RecordingError(target, f"cannot be written: {reason}", elsewhere)
