"""A file for HDF5 to write on, which survives a full disk.

HDF5 2.0 does not: after a failed write (ENOSPC) it prints pages of errors, cannot close its file,
and crashes the process at exit. Here the first failure is stored and later writes are dropped, so
that HDF5 sees a disk that takes everything and closes its file; then ``check`` raises the failure.
What was written is worthless, so the file has to have a temporary name.
"""

from __future__ import annotations

import os
from pathlib import Path


class GuardedFile:
    """A new file in the form that h5py's ``fileobj`` driver takes. Raises FileExistsError if it
    exists."""

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o644)
        self._position = 0
        self._failure: OSError | None = None

    def check(self) -> None:
        """Raise the first failure to write, if there was one (OSError)."""
        if self._failure is not None:
            raise self._failure

    def write(self, data: bytes | memoryview) -> int:
        """Write at the position. Does not raise: the first failure is stored for ``check``."""
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
        """Read at the position; behind the end there are zeros, as in a hole of a sparse file."""
        view = memoryview(buffer).cast("B")
        count = os.preadv(self._descriptor, [view], self._position)
        view[count:] = bytes(len(view) - count)
        self._position += len(view)
        return len(view)

    def read(self, size: int) -> bytes:
        """Read `size` bytes at the position. h5py calls ``readinto``, but takes an object for a
        file only if it has this method.
        """
        data = bytearray(size)
        self.readinto(memoryview(data))
        return bytes(data)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move the position; returns the new one."""
        base = (0, self._position, os.fstat(self._descriptor).st_size)[whence]
        self._position = base + offset
        return self._position

    def tell(self) -> int:
        """Return the position."""
        return self._position

    def truncate(self, size: int) -> int:
        """Set the file's length. Does not raise: the first failure is stored for ``check``."""
        try:
            if self._failure is None:
                os.ftruncate(self._descriptor, size)
        except OSError as error:
            self._failure = error
        return size

    def flush(self) -> None:
        """Do nothing: every write goes straight to the kernel."""

    def close(self) -> None:
        """Close the file."""
        os.close(self._descriptor)
