"""The SQLite file of a queue: what is wrong with it, named wherever it is noticed."""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

from rig.core.errors import ConfigurationError, RigError


class QueueDamagedError(ConfigurationError):
    """Raised where the file of a queue is not, or not any more, one that can be read."""

    def __init__(self, why: str, path: Path):
        super().__init__(
            f"{path} cannot be read as the queue of a batch: {why}",
            f"its runs' files are sound without it; rebuild it: rig batch rebuild {path.parent}",
        )


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
