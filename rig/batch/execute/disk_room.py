"""A disk that is full: whether it has room again, and writes to the queue that wait for it."""

from __future__ import annotations

import contextlib
import fcntl
import os
import tempfile
from collections import deque
from collections.abc import Callable
from pathlib import Path

from rig.batch.queue_file import QueueDamagedError, QueueWriteError

LEAST_B = 1_000_000
"""Room, in bytes, that is asked for in any case: for the queue, the logs and the heartbeat."""
MOST_WAITING = 10_000
"""Writes that wait at most; the oldest are dropped. A batch on hold has few."""


def has_room(folder: Path, size_B: int) -> bool:
    """Return whether files of this size can be written, and locked as a journal is, below `folder`
    now. They are written as far as the file system reserves their blocks, and deleted."""
    try:
        descriptor, name = tempfile.mkstemp(prefix=".room-", dir=folder)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.posix_fallocate(descriptor, 0, max(size_B, LEAST_B))
    except OSError:
        return False
    finally:
        os.close(descriptor)
        with contextlib.suppress(OSError):
            Path(name).unlink()
    return True


class DeferredWrites:
    """Writes to the queue, in their order; those that the disk does not take wait for it."""

    def __init__(self) -> None:
        self._waiting: deque[Callable[[], object]] = deque(maxlen=MOST_WAITING)
        self.why = ""
        """Reason why writes wait; empty if none waits."""

    def __len__(self) -> int:
        """Return the number of waiting writes."""
        return len(self._waiting)

    def add(self, write: Callable[[], object]) -> None:
        """Do this write after those that wait for the disk, at once if possible."""
        self._waiting.append(write)
        self.flush()

    def flush(self) -> None:
        """Write what waits, as far as the disk takes it."""
        while self._waiting:
            try:
                self._waiting[0]()
            except (QueueWriteError, QueueDamagedError) as error:
                self.why = error.one_line()
                return
            self._waiting.popleft()
        self.why = ""
