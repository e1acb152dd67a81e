"""A disk that fills up, becomes read-only or is slow, under the file calls of this process.

A shim between the recording and the kernel: the calls of `os` with which run files are opened,
written, synchronised and renamed go through it, for files below one folder and for as long as it is
installed. Everything above sees what it would see of such a disk: the same error numbers, short
writes included. It may not know what is written, and never touches what is there.
"""

from __future__ import annotations

import errno
import io
import os
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from drivers.simulated.faults.plan import DiskFault, FileFault, SlowSync

_ERRNO = {"disk-full": errno.ENOSPC, "read-only": errno.EROFS}
_WRITING = frozenset("wax+")


class FaultyDisk:
    """The file system of `folder` with its faults."""

    def __init__(self, faults: Iterable[FileFault], folder: Path):
        self._faults = tuple(faults)
        self._folder = folder.resolve()
        self._written = 0
        self._genuine: dict[tuple[Any, str], Callable[..., Any]] = {}

    def install(self) -> None:
        """Install the shim, from now on."""
        for module, name, shim in (
            (os, "open", self._open),
            (os, "mkdir", self._change),
            (os, "replace", self._change),
            (os, "unlink", self._change),
            (os, "writev", self._writev),
            (os, "pwrite", self._pwrite),
            (os, "ftruncate", self._ftruncate),
            (os, "fsync", self._sync),
            (os, "fdatasync", self._sync),
            (io, "open", self._open_text),
        ):
            genuine = self._genuine[module, name] = getattr(module, name)
            setattr(module, name, _shimmed(shim, genuine))

    def remove(self) -> None:
        """Remove the shim; a second call does nothing."""
        for (module, name), genuine in self._genuine.items():
            setattr(module, name, genuine)
        self._genuine.clear()

    # --- the calls ----------------------------------------------------------------------------

    def _open(
        self, genuine: Callable[..., int], path: Any, flags: int, *rest: Any, **by: Any
    ) -> int:
        if flags & (os.O_WRONLY | os.O_RDWR) and self._holds(path):
            self._refuse_where_read_only(path)
        return genuine(path, flags, *rest, **by)

    def _open_text(self, genuine: Callable[..., Any], file: Any, *rest: Any, **by: Any) -> Any:
        mode = rest[0] if rest else by.get("mode", "r")
        if _WRITING & set(mode) and self._holds(file):
            self._refuse_where_read_only(file)
            self._room(1, file)
        return genuine(file, *rest, **by)

    def _change(self, genuine: Callable[..., Any], path: Any, *rest: Any, **by: Any) -> Any:
        if self._holds(path):
            self._refuse_where_read_only(path)
        return genuine(path, *rest, **by)

    def _writev(self, genuine: Callable[..., int], descriptor: int, buffers: Sequence[Any]) -> int:
        if not self._holds_descriptor(descriptor):
            return genuine(descriptor, buffers)
        data = b"".join(buffers)
        return self._count(os.write(descriptor, data[: self._room(len(data), descriptor)]))

    def _pwrite(self, genuine: Callable[..., int], descriptor: int, data: Any, offset: int) -> int:
        if not self._holds_descriptor(descriptor):
            return genuine(descriptor, data, offset)
        part = memoryview(data)[: self._room(len(data), descriptor)]
        return self._count(genuine(descriptor, part, offset))

    def _ftruncate(self, genuine: Callable[..., None], descriptor: int, length: int) -> None:
        if self._holds_descriptor(descriptor):
            self._refuse_where_read_only(descriptor)
        genuine(descriptor, length)

    def _sync(self, genuine: Callable[..., None], descriptor: int) -> None:
        if self._holds_descriptor(descriptor):
            time.sleep(sum(f.delay_s for f in self._faults if isinstance(f, SlowSync)))
        genuine(descriptor)

    # --- the disk -----------------------------------------------------------------------------

    def _holds(self, path: Any) -> bool:
        if isinstance(path, int):
            return self._holds_descriptor(path)
        return Path(os.fsdecode(path)).absolute().is_relative_to(self._folder)

    def _holds_descriptor(self, descriptor: int) -> bool:
        try:
            target = Path(f"/proc/self/fd/{descriptor}").readlink()
        except OSError:
            return False
        return target.is_relative_to(self._folder)

    def _refuse_where_read_only(self, what: Any) -> None:
        for fault in self._faults:
            if isinstance(fault, SlowSync) or fault.kind != "read-only":
                continue
            if self._written >= fault.after_bytes:
                raise _error(fault, what)

    def _room(self, wanted: int, what: Any) -> int:
        """Return how many bytes of a write fit. Raises the error of the disk if none do."""
        room = wanted
        for fault in self._faults:
            if isinstance(fault, DiskFault):
                left = fault.after_bytes - self._written
                if left <= 0:
                    raise _error(fault, what)
                room = min(room, left)
        return room

    def _count(self, written: int) -> int:
        self._written += written
        return written


def _error(fault: DiskFault, what: Any) -> OSError:
    number = _ERRNO[fault.kind]
    where = None if isinstance(what, int) else os.fspath(what)
    return OSError(number, os.strerror(number), where)


def _shimmed(shim: Callable[..., Any], genuine: Callable[..., Any]) -> Callable[..., Any]:
    def call(*given: Any, **by: Any) -> Any:
        return shim(genuine, *given, **by)

    return call
