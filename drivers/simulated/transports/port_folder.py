"""The folder of a simulated serial port, which no killed simulator leaves behind for long.

A simulator holds a lock (``flock``) on its folder for as long as it lives. One that is killed can
remove nothing, so each start removes the folders of this user on which no one holds the lock. It
may not touch anything else in the temporary folder.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
from pathlib import Path

PREFIX = "tactile-rig-port-"


class PortFolder:
    """A new folder in the temporary folder, locked until `remove`."""

    def __init__(self) -> None:
        """Make the folder, after those of simulators that were killed have been removed. Raises
        OSError if it cannot be made."""
        remove_leftovers()
        while True:
            # Another start may remove the folder at any time before it is locked.
            self.path = Path(tempfile.mkdtemp(prefix=PREFIX))
            try:
                self._lock = os.open(self.path, os.O_RDONLY | os.O_DIRECTORY)
            except FileNotFoundError:
                continue
            fcntl.flock(self._lock, fcntl.LOCK_EX)
            if self.path.exists():
                return
            os.close(self._lock)

    def remove(self) -> None:
        """Remove the folder with what is in it."""
        shutil.rmtree(self.path, ignore_errors=True)
        os.close(self._lock)


def remove_leftovers() -> None:
    """Remove this user's folders whose simulator has died; what cannot be removed stays."""
    for path in Path(tempfile.gettempdir()).glob(PREFIX + "*"):
        with contextlib.suppress(OSError):
            folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            try:
                if os.fstat(folder).st_uid == os.geteuid():
                    fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    shutil.rmtree(path)
            finally:
                os.close(folder)
