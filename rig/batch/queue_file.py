"""The SQLite file of a queue: what is wrong with it, named wherever it is noticed."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

from rig.batch.folder import BatchFolder
from rig.core.errors import ConfigurationError, RigError
from rig.core.text import in_shell

BUSY_S = 30.0
"""Longest wait for a transaction of another process, in s."""
DAMAGED = (
    *("SQLITE_NOTADB", "SQLITE_FORMAT", "SQLITE_ERROR"),
    *("SQLITE_IOERR_READ", "SQLITE_IOERR_SHORT_READ", "SQLITE_IOERR_DATA"),
)
"""SQLite's names of errors that are due to what is in the file, besides all of SQLITE_CORRUPT."""


class QueueNotOpenedError(ConfigurationError):
    """Raised where the file of a queue cannot be opened here, although it may be sound: another
    user's, on a disk that is read only or full, locked. `name` is SQLite's name of the error."""

    def __init__(self, why: str, path: Path, name: str):
        super().__init__(f"{path} cannot be opened: {why}", remedy(name, path.parent))


def remedy(name: str, folder: Path, then: str = "then give the command again") -> str:
    """Return what to do about an error of this name, which is not due to what is in the file."""
    if name.startswith(("SQLITE_FULL", "SQLITE_IOERR_WRITE", "SQLITE_IOERR_FSYNC")):
        return f"free some disk space, {then}"
    if name.startswith(("SQLITE_BUSY", "SQLITE_LOCKED")):
        return f"another program has it open: wait for it or close it, {then}"
    if name == "SQLITE_READONLY_ROLLBACK":
        resume = f"rig batch resume {in_shell(folder)}"
        return f"a write to it was interrupted; roll that back with: {resume}"
    return (
        f"see that you may write to the folder {folder}, or copy it to where you may and name the "
        "copy; the queue itself need not be damaged"
    )


class QueueDamagedError(ConfigurationError):
    """Raised where the file of a queue is not, or not any more, one that can be read."""

    def __init__(self, why: str, path: Path):
        super().__init__(
            f"{path} cannot be read as the queue of a batch: {why}",
            "its runs' files are sound without it; rebuild it: "
            f"rig batch rebuild {in_shell(path.parent)}",
        )


def connected(path: Path, *, writing: bool) -> QueueConnection:
    """Return a connection to the file of an existing queue, which has been checked.

    Raises ConfigurationError if the file does not exist, QueueNotOpenedError if it cannot be opened
    here, QueueDamagedError if it is not a queue.
    """
    if not path.is_file():
        if BatchFolder(path.parent).terms.is_file():  # what `rig batch run` writes before the queue
            raise ConfigurationError(
                f"{path.parent} is the folder of a batch, but there is no {path.name} in it",
                f"put it back, or rebuild it: rig batch rebuild {in_shell(path.parent)}",
            )
        raise ConfigurationError(
            f"{path.parent} holds no batch: there is no {path.name} in it",
            "name the folder of a batch, as `rig batch run` printed it",
        )
    mode = "rw" if writing else "ro"
    try:
        sql = sqlite3.connect(
            f"{path.absolute().as_uri()}?mode={mode}",
            uri=True,
            factory=QueueConnection,
            timeout=BUSY_S,
            isolation_level=None,
            check_same_thread=False,
        )
        sql.execute("SELECT 1 FROM run LIMIT 1")
        (found,) = sql.execute("PRAGMA quick_check(1)").fetchone()
        if found != "ok":
            raise sqlite3.DatabaseError(found)
        if writing:
            sql.execute("PRAGMA journal_mode = WAL")
            sql.execute("PRAGMA synchronous = FULL")
    except (sqlite3.DatabaseError, QueueDamagedError) as error:
        why = error.__cause__ if isinstance(error, QueueDamagedError) else error
        name = getattr(why, "sqlite_errorname", "")
        if name and name not in DAMAGED and not name.startswith("SQLITE_CORRUPT"):
            raise QueueNotOpenedError(str(why), path, name) from error
        raise QueueDamagedError(str(why), path) from error
    sql.path = path
    sql.row_factory = sqlite3.Row
    return sql


class QueueConnection(sqlite3.Connection):
    """A connection that reports a damaged file as QueueDamagedError, wherever it is noticed."""

    path = Path()

    def cursor(self, factory: Any = None) -> Any:
        """Return a cursor that reports the same."""
        return super().cursor(_Cursor)

    def execute(self, *given: Any) -> Any:
        """Return the cursor of a statement."""
        return self.cursor().execute(*given)


class _Cursor(sqlite3.Cursor):
    """A cursor of a `QueueConnection`."""

    def execute(self, *given: Any) -> Self:
        with _damage_named(self):
            return super().execute(*given)

    def fetchone(self) -> Any:
        with _damage_named(self):
            return super().fetchone()

    def fetchall(self) -> list[Any]:
        with _damage_named(self):
            return super().fetchall()

    def fetchmany(self, *given: Any, **named: Any) -> list[Any]:
        with _damage_named(self):
            return super().fetchmany(*given, **named)

    def __next__(self) -> Any:
        with _damage_named(self):
            return super().__next__()


@contextlib.contextmanager
def _damage_named(cursor: sqlite3.Cursor) -> Iterator[None]:
    try:
        yield
    except sqlite3.DatabaseError as error:
        if type(error) is not sqlite3.DatabaseError:  # a full disk and a lock are subclasses
            raise
        assert isinstance(cursor.connection, QueueConnection)
        raise QueueDamagedError(str(error), cursor.connection.path) from error


class QueueWriteError(RigError):
    """Raised where the disk does not take a transaction; the queue is as it was before it."""
