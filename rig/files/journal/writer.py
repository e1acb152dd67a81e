"""Writing a journal: the run as it happens, append only, each record with its checksum.

What ``sync`` has returned for is *acknowledged*: it survives a kill and a power cut. The file is
opened without buffers and locked for as long as it is written, so that no other process compiles a
run that still writes. What is written is never changed; only a torn end is cut off by ``reopen``.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from pydantic import ValidationError

from rig.core.atomic import sync_folder
from rig.core.errors import ConfigurationError, ExitCode, RigError
from rig.files.errors import (
    LOCKS_NEEDED,
    NO_LOCKS,
    TOO_MANY_OPEN,
    JournalError,
    JournalMovedError,
    RecordingError,
    room_for,
)
from rig.files.journal.format import (
    BLOCK_HEAD,
    MAGIC,
    MAX_PAYLOAD,
    RecordKind,
    block_record,
    json_record,
)
from rig.files.journal.reader import JournalContents, KeptPoint, read_journal
from rig.files.journal.values import End, JournalEvent, Results, RunHeader, StreamState
from rig.files.naming import journal_path, next_run_path

__all__ = [
    "JournalContents",
    "JournalEncoder",
    "JournalError",
    "JournalWriter",
    "KeptPoint",
    "read_journal",
]

_IOV_MAX = 1024
_NAME_TRIES = 20
_COPY_BYTES = 1 << 20
_AND_THEN = "then `rig recover` the journal or resume the run"
_NOTHING_YET = "or choose another folder for results; nothing was recorded"


class JournalEncoder:
    """Turns values into records; refuses those that contradict the header or earlier records.

    It has no file and stores no bytes. A point is begun, then kept or discarded; a kept point is
    never begun again. ValueError and TypeError mean that the caller's values cannot be recorded.
    """

    def __init__(self, header: RunHeader, kept: Sequence[str] = ()) -> None:
        self.header = header
        self._kept = set(kept)
        self._open: str | None = None

    def block(self, stream: int, first_index: int, host_time: float, data: object) -> list[bytes]:
        """Return records of rows: bytes, or an array of the stream's dtype, shape (n, channels) or
        (n,). Several records if the rows exceed one.
        """
        rows = _row_bytes(data, self.header, stream)
        self.header.check_block(stream, len(rows), first_index, host_time)
        row = self.header.streams[stream].row_bytes
        most = (MAX_PAYLOAD - BLOCK_HEAD.size) // row * row
        return [
            block_record(stream, first_index + at // row, host_time, rows[at : at + most])
            for at in range(0, len(rows), most)
        ]

    def event(self, fields: Mapping[str, Any] | JournalEvent) -> bytes:
        """Return a record of an event: time (s since the run's start), level, code, message."""
        return json_record(RecordKind.EVENT, JournalEvent.model_validate(fields))

    def stream(self, fields: Mapping[str, Any] | StreamState) -> bytes:
        """Return a record of how a stream's counts read from here on."""
        state = StreamState.model_validate(fields)
        self.header.check_state(state)
        return json_record(RecordKind.STREAM, state)

    def point_begin(self, point_id: str, fields: Mapping[str, Any]) -> bytes:
        """Return a record that a point begins; ``time`` in the fields is in s since the run's
        start.

        Raises ValueError if a point is open, or for an id that was recorded already or is not 1 to
        256 characters long.
        """
        if self._open is not None:
            raise ValueError(f"point {point_id}: point {self._open} is still open")
        if point_id in self._kept:
            raise ValueError(f"point {point_id}: recorded already")
        if not 0 < len(point_id) <= 256:
            raise ValueError(f"point {point_id[:40]!r}: an id has 1 to 256 characters")
        record = json_record(RecordKind.POINT_BEGIN, {"id": point_id, "point": dict(fields)})
        self._open = point_id
        return record

    def point_keep(self, point_id: str, reading: Mapping[str, Any]) -> bytes:
        """Return a record that the open point is valid, with its reading."""
        self._check_open(point_id)
        record = json_record(RecordKind.POINT_KEEP, {"id": point_id, "reading": dict(reading)})
        self._kept.add(point_id)
        self._open = None
        return record

    def point_discard(self, point_id: str, reason: str) -> bytes:
        """Return a record that the open point is not valid, and why."""
        self._check_open(point_id)
        record = json_record(RecordKind.POINT_DISCARD, {"id": point_id, "reason": reason})
        self._open = None
        return record

    def end(self, fields: Mapping[str, Any] | End) -> bytes:
        """Return a record of how the run ended."""
        return json_record(RecordKind.END, End.model_validate(fields))

    def results(self, fields: Mapping[str, Any] | Results) -> bytes:
        """Return a record of what was computed from all readings, behind the END."""
        return json_record(RecordKind.RESULTS, Results.model_validate(fields))

    def _check_open(self, point_id: str) -> None:
        if self._open != point_id:
            raise ValueError(f"point {point_id}: not the open point, which is {self._open}")


def _row_bytes(data: object, header: RunHeader, stream: int) -> memoryview:
    """Return the rows' bytes. Raises ValueError for an array of another type or shape than the
    stream's."""
    dtype = getattr(data, "dtype", None)
    if dtype is not None and 0 <= stream < len(header.streams):
        expected, shape = header.streams[stream], getattr(data, "shape", ())
        if dtype != expected.dtype or shape[1:] not in (expected.row_shape, ()):
            raise ValueError(
                f"stream {expected.name}: an array of {dtype} {shape}, expected rows of "
                f"{expected.dtype} {expected.row_shape}"
            )
        if shape[1:] == () and expected.row_shape != (1,):
            raise ValueError(f"stream {expected.name}: rows need {expected.row_shape[0]} channels")
    view = memoryview(data)  # type: ignore[arg-type]
    return memoryview(view.tobytes()) if not view.c_contiguous else view.cast("B")


class JournalWriter:
    """A journal that is open for writing, by one thread.

    Raises JournalError for a file that is not a journal, and RecordingError with path, cause and
    remedy for a full disk and the like. After a failed write every call raises that error again.
    """

    def __init__(self, path: Path, descriptor: int, encoder: JournalEncoder, size: int) -> None:
        self.path = path
        self.encoder = encoder
        self._descriptor = descriptor
        self._size = size
        self._acknowledged = 0
        self._failure: RecordingError | None = None

    @classmethod
    def create(cls, path: Path | str, header: RunHeader | Mapping[str, Any]) -> JournalWriter:
        """Create a journal, put its header on the disk, and return its writer. Raises
        FileExistsError if the file exists, and RecordingError where it cannot be created, locked or
        written; it is then removed again if the disk allows that."""
        path = Path(path)
        header = _validated(path, header)
        record = json_record(RecordKind.HEADER, header)
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o644)
        except FileExistsError:
            raise
        except OSError as error:
            hint = f"{room_for(error)}, {_NOTHING_YET}"
            raise RecordingError(path, error.strerror or str(error), hint) from error
        writer = cls(path, descriptor, JournalEncoder(header), 0)
        try:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                cause, hint = f"it cannot be locked: {error.strerror}", LOCKS_NEEDED
                if error.errno not in NO_LOCKS:
                    cause = "another process is using this journal"
                    hint = "find out which program opens new files in that folder"
                raise RecordingError(path, cause, f"{hint}, {_NOTHING_YET}") from error
            writer.append([MAGIC, record])
            writer.sync()
            sync_folder(path.parent)
        except BaseException as error:
            writer.close()
            with contextlib.suppress(OSError):  # a disk that has become read-only keeps it
                path.unlink()
            if isinstance(error, RecordingError):
                cause = error.message.removeprefix(f"{path}: ")
                hint = (error.hint or "").replace(_AND_THEN, _NOTHING_YET)
                raise RecordingError(path, cause, hint) from error
            raise
        return writer

    @classmethod
    def reopen(cls, path: Path | str) -> JournalWriter:
        """Open a journal to continue it: cut off a torn end, discard a point that was left open.

        Raises JournalError for a file that is not a journal, is damaged before its end, or is being
        written.
        """
        path = Path(path)
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_APPEND)
        except OSError as error:
            raise JournalError(path, None, error.strerror or str(error)) from error
        try:
            lock_journal(path, descriptor)
            contents = read_journal(path)
            contents.require_continuable()
            os.ftruncate(descriptor, contents.end_offset)
            encoder = JournalEncoder(contents.header, contents.kept_ids())
            writer = cls(path, descriptor, encoder, contents.end_offset)
            writer._close_open_point(contents.grouping.open_point)
            writer.sync()
        except BaseException:
            os.close(descriptor)
            raise
        return writer

    def _close_open_point(self, point_id: str | None) -> None:
        if point_id is not None:
            fields = {"id": point_id, "reason": "the run was interrupted"}
            self.append([json_record(RecordKind.POINT_DISCARD, fields)])

    @property
    def header(self) -> RunHeader:
        """The run's header."""
        return self.encoder.header

    @property
    def size(self) -> int:
        """Number of bytes written."""
        return self._size

    @property
    def acknowledged_bytes(self) -> int:
        """Bytes that are known to be on the disk."""
        return self._acknowledged

    def block(self, stream: int, first_index: int, host_time: float, data: object) -> None:
        """Write rows of a stream: `first_index` counts its rows, `host_time` is in s since the
        start.
        """
        self._record(lambda: self.encoder.block(stream, first_index, host_time, data))

    def event(self, fields: Mapping[str, Any] | JournalEvent) -> None:
        """Write an event: time (s since the run's start), level, code, message."""
        self._record(lambda: [self.encoder.event(fields)])

    def stream(self, fields: Mapping[str, Any] | StreamState) -> None:
        """Write how a stream's counts read from here on."""
        self._record(lambda: [self.encoder.stream(fields)])

    def point_begin(self, point_id: str, fields: Mapping[str, Any]) -> None:
        """Write that a point begins."""
        self._record(lambda: [self.encoder.point_begin(point_id, fields)])

    def point_keep(self, point_id: str, reading: Mapping[str, Any]) -> None:
        """Write that the open point is valid, with its reading."""
        self._record(lambda: [self.encoder.point_keep(point_id, reading)])

    def point_discard(self, point_id: str, reason: str) -> None:
        """Write that the open point is not valid, and why."""
        self._record(lambda: [self.encoder.point_discard(point_id, reason)])

    def end(self, fields: Mapping[str, Any] | End) -> None:
        """Write how the run, or this attempt at it, ended."""
        self._record(lambda: [self.encoder.end(fields)])

    def results(self, fields: Mapping[str, Any] | Results) -> None:
        """Write what was computed from all readings, behind the END."""
        self._record(lambda: [self.encoder.results(fields)])

    def _record(self, encode: Any) -> None:
        self.append(encode_or_raise(self.path, encode))

    def append(self, records: Sequence[bytes]) -> None:
        """Write whole records, in one system call where the kernel takes them in one.

        Raises RecordingError if the system refuses the bytes.
        """
        self._check()
        begin = self._size
        try:
            for at in range(0, len(records), _IOV_MAX):
                _write_all(self._descriptor, records[at : at + _IOV_MAX])
            self._size = begin + sum(map(len, records))
        except OSError as error:
            raise self._fail("write", error) from error

    def sync(self) -> None:
        """Block until everything written is on the disk (fdatasync), which acknowledges it.

        Raises JournalMovedError, once, if the file has lost its name: it was deleted or moved, or
        its disk was unmounted. The journal then continues at another path.
        """
        self._check()
        try:
            os.fdatasync(self._descriptor)
        except OSError as error:
            # The kernel has dropped what it could not write and marked it clean: a second fdatasync
            # would succeed without anything being on the disk.
            raise self._fail("sync", error) from error
        self._acknowledged = self._size
        if (cause := self._lost_name()) is not None:
            self._move_on(cause)

    def close(self) -> None:
        """Close the file, without another sync. A second close does nothing."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _lost_name(self) -> str | None:
        """Return why no one would find the file under its path any more; None if all is well."""
        mine = os.fstat(self._descriptor)
        try:
            found = self.path.stat()
        except OSError as error:
            if mine.st_nlink == 0:
                return "was deleted"
            return f"was moved, or its disk was unmounted ({error.strerror})"
        if (found.st_dev, found.st_ino) != (mine.st_dev, mine.st_ino):
            return "was replaced by another file, or another disk was mounted over it"
        return None

    def _move_on(self, cause: str) -> None:
        """Copy the file, which is still open, to a place where it has a name; continue there."""
        lost, failures = self.path, []
        for folder in _refuges(lost):
            new = folder / f"{lost.stem}_rescued{lost.suffix}"
            try:
                folder.mkdir(parents=True, exist_ok=True)
                descriptor = _copy(self._descriptor, self._size, new)
            except OSError as error:
                failures.append(f"{new}: {error.strerror or error}")
                continue
            os.close(self._descriptor)
            self._descriptor, self.path = descriptor, new
            raise JournalMovedError(lost, cause, new)
        self._failure = RecordingError(lost, f"{cause}; no copy of it could be made: {failures}")
        raise self._failure

    def _check(self) -> None:
        if self._failure is not None:
            raise self._failure
        if self._descriptor < 0:
            raise RecordingError(self.path, "the journal is closed")

    def _fail(self, act: str, error: OSError) -> RecordingError:
        cause = f"{act} failed: {error.strerror or error}"
        self._failure = RecordingError(self.path, cause, f"{room_for(error)}, {_AND_THEN}")
        return self._failure


def begin_journal(
    results: Path, procedure: str, header: RunHeader | Mapping[str, Any]
) -> JournalWriter:
    """Create a journal in today's folder under the next number. Raises RecordingError if that
    fails."""
    now = datetime.now().astimezone()
    with _beginning(results):
        for _ in range(_NAME_TRIES):
            with contextlib.suppress(FileExistsError):  # another run took the number
                path = next_run_path(results, procedure, now)
                return JournalWriter.create(journal_path(path), header)
    raise RecordingError(
        results, "other runs took every file name that was tried; start the run again"
    )


def begin_journal_at(path: Path, header: RunHeader | Mapping[str, Any]) -> JournalWriter:
    """Create a journal at this path, and its folder. Raises RecordingError if that fails or the
    file exists.
    """
    with _beginning(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        return JournalWriter.create(path, header)


@contextlib.contextmanager
def _beginning(place: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        hint = (
            f"{'free space on this disk, or ' if full else ''}choose another folder with --results"
        )
        if error.errno in TOO_MANY_OPEN:  # no other folder would help
            hint = room_for(error)
        raise RecordingError(
            place, f"no run can be recorded here: {error.strerror or error}", hint
        ) from error


class UnrecordableError(RigError):
    """Values that cannot be recorded. Nothing was written then, and the journal can still be
    used."""

    def __init__(self, path: Path, reason: str):
        super().__init__(f"{path}: cannot be recorded: {reason}", code=ExitCode.INTERNAL)
        self.reason = reason
        """What is wrong with the values, without the name of the file."""


def encode_or_raise(path: Path, encode: Any) -> Any:
    """Return ``encode()``. Its ValueError or TypeError, for values that cannot be recorded, becomes
    an UnrecordableError."""
    try:
        return encode()
    except ValidationError as error:
        reason = ConfigurationError.from_validation(error, "record").message
        raise UnrecordableError(path, reason) from error
    except (ValueError, TypeError) as error:
        raise UnrecordableError(path, str(error)) from error


def lock_journal(path: Path, descriptor: int, *, shared: bool = False) -> None:
    """Lock the journal until the descriptor is closed. Raises JournalError if a run is writing it,
    or its file system does not lock files."""
    try:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in NO_LOCKS:
            cause = f"it cannot be locked: {error.strerror}"
            raise JournalError(path, None, cause, LOCKS_NEEDED) from error
        raise JournalError(
            path, None, "another process is using this journal", "wait for its run to end"
        ) from error


def _validated(path: Path, header: RunHeader | Mapping[str, Any]) -> RunHeader:
    if isinstance(header, RunHeader):
        return header
    try:
        return RunHeader.model_validate(dict(header))
    except ValidationError as error:
        raise JournalError(
            path, None, ConfigurationError.from_validation(error, "header").message
        ) from error


def _refuges(lost: Path) -> list[Path]:
    """Return the folders, in order, in which a journal that has lost its name may continue."""
    folders = [lost.parent]
    with contextlib.suppress(RuntimeError):  # a service's user may have no home
        folders.append(Path.home())
    return [*folders, Path(tempfile.gettempdir())]


def _copy(source: int, size: int, target: Path) -> int:
    """Copy the first `size` bytes of an open file to a new one; return that, open for appending,
    locked and on the disk. Raises OSError, FileExistsError included, and then leaves no file."""
    descriptor = os.open(target, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        at = 0
        while at < size:
            piece = os.pread(source, _COPY_BYTES, at)[: size - at]
            if not piece:
                raise OSError(errno.EIO, "it is shorter than what was written")
            _write_all(descriptor, [piece])
            at += len(piece)
        os.fsync(descriptor)
        sync_folder(target.parent)
    except BaseException:
        os.close(descriptor)
        with contextlib.suppress(OSError):
            target.unlink()
        raise
    return descriptor


def _write_all(descriptor: int, buffers: Sequence[bytes]) -> None:
    left: list[bytes | memoryview] = list(buffers)
    while left:
        written = os.writev(descriptor, left)
        while left and written >= len(left[0]):
            written -= len(left.pop(0))
        if left and written:
            left[0] = memoryview(left[0])[written:]
