"""Follow a journal while a run writes it: its records in order, as soon as they are whole.

A follower only reads. It takes no lock, not even for a moment, so that it can neither delay nor
refuse a run. What it yields is what `read_journal` would read of the same bytes: of any prefix of
a journal, a prefix of its records.

    the last record is half written     it is waited for
    the record after that is not sound  `problem` names it; it is read again when the file changes
    the file was cut, or replaced       JournalError: what was yielded is no longer what it holds
    the file was deleted                it is still read to its end, through the open descriptor
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Self

from rig.files.errors import JournalError
from rig.files.journal.format import (
    MAGIC,
    MAX_PAYLOAD,
    PREFIX,
    BadRecord,
    JournalRecord,
    decode,
)
from rig.files.journal.values import End, Results, RunHeader

READ_BYTES = 1 << 20
"""Bytes that are read at a time; a longer record is read whole."""

UNSOUND = "bad record"
"""How `JournalTail.problem` begins where the bytes can never become a record."""


def follow(path: Path | str, go_on: Callable[[], bool]) -> Iterator[JournalRecord]:
    """Yield the records of a journal, its header first, those that are still to come included.

    `go_on` is called whenever there is nothing new: it waits as long as the caller likes (a sleep)
    and returns False to end the iteration, for instance because the run's process has ended. The
    journal need not exist yet. Raises JournalError for a file that is no journal, that was cut, or
    whose name belongs to another file now.
    """
    with JournalTail(path) as tail:
        while True:
            records = tail.poll()
            yield from records
            if not records and not go_on():
                return


class JournalTail:
    """The records of a growing journal since the last `poll`; a context manager that closes it."""

    def __init__(self, path: Path | str):
        self.path = Path(path)
        self.header: RunHeader | None = None
        self.problem: str | None = None
        """None, or why the bytes behind the last record are not one yet. A run that died leaves
        such a torn end; a run that is resumed cuts it off."""
        self.ended = False
        """True if the last record is an END. A resumed run adds records behind it."""
        self.deleted = False
        """True if the file has lost its name: nothing more will come."""
        self._file = -1
        self._offset = 0
        """Bytes of the records that were returned."""
        self._seen: tuple[int, int] | None = None
        """Size and time of the file when a record was not sound."""

    def poll(self, most_bytes: int = 8 << 20) -> list[JournalRecord]:
        """Return the records that have become whole, about `most_bytes` of them at most, so that
        a long journal is taken in several calls. Never waits.

        Raises JournalError as `follow` does; OSError becomes one.
        """
        try:
            return self._poll(most_bytes)
        except OSError as error:
            raise JournalError(self.path, None, error.strerror or str(error)) from error

    def _poll(self, most_bytes: int) -> list[JournalRecord]:
        if self._file < 0 and not self._open():
            return []
        status = os.fstat(self._file)
        if status.st_size < self._offset:
            raise JournalError(
                self.path,
                status.st_size,
                f"the journal was cut to {status.st_size} bytes; {self._offset} had been read",
                "read it from its start",
            )
        self.deleted = status.st_nlink == 0
        now = (status.st_size, status.st_mtime_ns)
        if self._seen == now:
            return []
        self._seen = None
        if status.st_size == self._offset:
            self._check_name(status)
            self.problem = None
            return []
        return self._whole_records(most_bytes, now)

    def _open(self) -> bool:
        try:
            file = os.open(self.path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
        except FileNotFoundError:
            return False
        if not os.path.isfile(f"/proc/self/fd/{file}"):  # noqa: PTH113 - a pipe would never end
            os.close(file)
            raise JournalError(self.path, None, "not a regular file")
        self._file = file
        return True

    def _check_name(self, status: os.stat_result) -> None:
        """Raise JournalError if the name belongs to another file now, as after a restored copy."""
        try:
            named = self.path.stat()
        except FileNotFoundError:
            return
        if not os.path.samestat(named, status):
            raise JournalError(
                self.path, self._offset, "the journal was replaced", "read it from its start"
            )

    def _whole_records(self, most_bytes: int, now: tuple[int, int]) -> list[JournalRecord]:
        records: list[JournalRecord] = []
        stop = self._offset + most_bytes
        self.problem = None
        try:
            if self._offset == 0 and not self._skip_magic():
                return []
            buffer, at = memoryview(b""), self._offset
            while not records or self._offset < stop:
                begin = self._offset - at
                need = _record_bytes(buffer[begin:])
                if need is None or begin + need > len(buffer):
                    at, begin = self._offset, 0
                    wanted = READ_BYTES if need is None else max(READ_BYTES, need)
                    buffer = memoryview(os.pread(self._file, wanted, at))
                    need = _record_bytes(buffer)
                if need is None or begin + need > len(buffer):
                    if len(buffer):
                        self.problem = f"half a record at byte {self._offset}"
                    return records
                record = self._decode(buffer[begin : begin + need])
                records.append(record)
                self._offset += need
                self.ended = isinstance(record, End) or (self.ended and isinstance(record, Results))
        except BadRecord as error:
            self.problem = f"{UNSOUND} at byte {self._offset}: {error}"
            self._seen = now
        return records

    def _skip_magic(self) -> bool:
        magic = os.pread(self._file, len(MAGIC), 0)
        if magic != MAGIC:
            if MAGIC.startswith(magic):
                return False
            raise JournalError(
                self.path, None, f"not a journal: it does not begin with {MAGIC.decode()}"
            )
        self._offset = len(MAGIC)
        return True

    def _decode(self, record: memoryview) -> JournalRecord:
        _, checksum = PREFIX.unpack_from(record)
        payload = bytes(record[PREFIX.size :])
        if zlib.crc32(payload) != checksum:
            raise BadRecord("its checksum is wrong")
        decoded = decode(payload, self.header)
        if isinstance(decoded, RunHeader):
            self.header = decoded
        return decoded

    def close(self) -> None:
        """Close the file."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def _record_bytes(buffer: memoryview) -> int | None:
    """Return the length of the record that begins here; None if not even that is there yet."""
    if len(buffer) < PREFIX.size:
        return None
    length, _ = PREFIX.unpack_from(buffer)
    if not 0 < length <= MAX_PAYLOAD:
        raise BadRecord(f"length {length} is not in 1 to {MAX_PAYLOAD}")
    return PREFIX.size + int(length)
