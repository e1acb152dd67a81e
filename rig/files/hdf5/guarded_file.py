"""A file for HDF5 to write on, which survives a full disk.

HDF5 does not: after a failed write it prints, cannot close its file, and may take the process down
with it. Here the first failure is kept, later writes are dropped, HDF5 closes in peace, and then
the failure is raised. What was written so far is worthless, and belongs to a temporary name.
"""

from __future__ import annotations

import os
from pathlib import Path


class GuardedFile:
    """A new file in the form h5py's ``fileobj`` driver wants."""

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o644)
        self._position = 0
        self._failure: OSError | None = None

    def check(self) -> None:
        """Raise the first failure to write, if there was one."""
        if self._failure is not None:
            raise self._failure

    def write(self, data: bytes | memoryview) -> int:
        """Write at the position; a failure is kept for ``check``."""
        left = memoryview(data).cast("B")
        size = len(left)
        try:
            while left and self._failure is None:
                written = os.pwrite(self._descriptor, left, self._position + size - len(left))
                left = left[written:]
        except OSError as error:
            self._failure = error
        self._position += size
        return size

    def readinto(self, buffer: memoryview) -> int:
        """Read at the position; zeros behind the end, as in a hole."""
        view = memoryview(buffer).cast("B")
        count = os.preadv(self._descriptor, [view], self._position)
        view[count:] = bytes(len(view) - count)
        self._position += len(view)
        return len(view)

    def read(self, size: int) -> bytes:
        """Read at the position; h5py knows a file by this method, and calls ``readinto``."""
        data = bytearray(size)
        self.readinto(memoryview(data))
        return bytes(data)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move the position."""
        base = (0, self._position, os.fstat(self._descriptor).st_size)[whence]
        self._position = base + offset
        return self._position

    def tell(self) -> int:
        """The position."""
        return self._position

    def truncate(self, size: int) -> int:
        """Set the file's length; a failure is kept for ``check``."""
        try:
            if self._failure is None:
                os.ftruncate(self._descriptor, size)
        except OSError as error:
            self._failure = error
        return size

    def flush(self) -> None:
        """Nothing is held back."""

    def close(self) -> None:
        """Close the file."""
        os.close(self._descriptor)
