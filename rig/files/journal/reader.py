"""Reading a journal: what is in it, as far as it is sound, and where it stops being so.

Never writes. Everything after the header is read tolerantly: the first bad record ends the journal
and is reported, since a killed run leaves a torn one. A journal without a usable header is a
JournalError. Memory holds the points and events, never the samples.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, BinaryIO

from rig.files.errors import JournalError
from rig.files.journal.format import (
    MAGIC,
    MAX_PAYLOAD,
    PREFIX,
    BadRecord,
    Block,
    JournalRecord,
    PointBegin,
    RecordKind,
    decode,
    from_json,
)
from rig.files.journal.segments import Attempt, Grouping, Segment
from rig.files.journal.values import LONGEST_S, End, JournalEvent, Results, RunHeader

MAX_REMEMBERED = 64 << 20
"""Bytes of points and events a journal may have; a real night has a twentieth of it. They grow some
thirty times when they are remembered."""

_SEARCH_BYTES = 64 << 20
_SEARCH_CRC_BYTES = 1 << 30


@dataclass(frozen=True, slots=True)
class KeptPoint:
    """A valid point with its reading, as the procedure gave it."""

    id: str
    reading: dict[str, Any]


@dataclass
class JournalContents:
    """The content of the sound part of a journal, without the samples: ``records()`` reads those
    from the file again, one record at a time."""

    path: Path
    header: RunHeader
    grouping: Grouping
    events: list[JournalEvent] = field(default_factory=list)
    ends: list[End] = field(default_factory=list)
    results: Results | None = None
    """The results of the attempt that ended last; None where none were recorded behind its END."""
    last_is_end: bool = False
    last_time: float = 0.0
    """Latest time in the journal, in s since the run's start."""
    end_offset: int = 0
    """Bytes of the sound part."""
    problem: str | None = None
    """None, or 'bad record at byte N: reason'."""
    torn: bool = False
    """The problem is a torn end, as a kill or a power cut leaves it: nothing was acknowledged
    behind it."""

    @property
    def attempts(self) -> list[Attempt]:
        """All attempts at points, in the order they began."""
        return self.grouping.attempts

    @property
    def segments(self) -> list[Segment]:
        """All segments of samples, in the order they began."""
        return self.grouping.segments

    @property
    def end(self) -> End | None:
        """The END that closed the journal. None if it was never closed, or was reopened since."""
        return self.ends[-1] if self.last_is_end and self.ends else None

    @property
    def complete(self) -> bool:
        """True if the run finished and the journal is sound to its last byte."""
        return self.problem is None and self.end is not None and self.end.status == "complete"

    def require_continuable(self) -> None:
        """Raise JournalError if sound records follow damage: then nothing may be added to the
        journal.
        """
        if self.problem and not self.torn:
            raise JournalError(
                self.path,
                None,
                f"{self.problem}; sound records follow it",
                "the file was damaged: copy it, `rig recover` it, start a new run",
            )

    def kept_ids(self) -> list[str]:
        """Return the ids of the kept points, in the order in which they were kept, each once."""
        return list(self.grouping.kept)

    def kept(self) -> list[KeptPoint]:
        """Return the kept points with their readings, in the order in which they were kept."""
        return [KeptPoint(i, self.reading(n)) for i, n in self.grouping.kept.items()]

    def reading(self, attempt: int) -> dict[str, Any]:
        """Return the reading of a kept attempt, by its index."""
        reading: dict[str, Any] = from_json(self.attempts[attempt].result)["reading"]
        return reading

    def sampling(self) -> dict[str, tuple[float | None, str]]:
        """Return for each recorded stream its rate in Hz, None where rows are not evenly spaced,
        and the unit of its values."""
        found: dict[str, tuple[float | None, str]] = {}
        for segment in self.segments:
            stream, state = self.header.streams[segment.stream], segment.state
            known = (None, stream.units) if state is None else (state.rate_Hz, state.units)
            found.setdefault(stream.name, known)
        return found

    def records(self) -> Iterator[JournalRecord]:
        """Read every record behind the header, in order, one at a time. Raises JournalError if the
        file changed since it was first read.
        """
        with self.path.open("rb") as file:
            file.seek(len(MAGIC))
            reader = _Reader(file)
            payloads = reader.payloads()
            try:
                next(payloads)
                while reader.offset < self.end_offset:
                    yield decode(next(payloads), self.header)
            except (BadRecord, StopIteration) as error:
                reason = f"the journal changed while it was read: {error}"
                raise JournalError(self.path, reader.offset, reason) from None


NEVER_CLOSED = "the run ended without closing its journal"
DAMAGED = "the journal is damaged"


def ending(contents: JournalContents) -> End:
    """Return how the run ended; of a journal that was never closed, what its records show."""
    warnings = [contents.problem] if contents.problem else []
    if contents.end is not None:
        end = contents.end
        if not warnings:
            return end
        return end.model_copy(update={"warnings": (*end.warnings, *warnings)})
    lasted = timedelta(seconds=max(contents.last_time, 0.0))
    start = contents.header.start_time
    end_time = None if start is None else (datetime.fromisoformat(start) + lasted).isoformat()
    damaged = contents.problem and not contents.torn
    return End(
        status="failed",
        reason=f"{DAMAGED}: {contents.problem}" if damaged else NEVER_CLOSED,
        attempt=len(contents.ends) + 1,
        end_time=end_time,
        duration_s=lasted.total_seconds(),
        points_done=len(contents.grouping.kept),
        warnings=("end_time is the time of the last record", *warnings),
        exit=1,
    )


def read_journal(path: Path | str) -> JournalContents:
    """Return what a journal holds. Reads the file once and checks every checksum.

    Raises JournalError if it is not a journal or its header is unusable. Later damage is reported
    in ``problem``, and what precedes it is returned.
    """
    path = Path(path)
    try:
        if path.exists() and not path.is_file():  # a pipe would never end
            raise JournalError(path, None, "not a regular file")
        with path.open("rb") as file:
            return _read(file, path)
    except OSError as error:
        raise JournalError(path, None, error.strerror or str(error)) from error


def _read(file: BinaryIO, path: Path) -> JournalContents:
    magic = file.read(len(MAGIC))
    if magic != MAGIC:
        if MAGIC.startswith(magic):
            raise JournalError(path, 0, "empty: the run ended before it recorded anything")
        raise JournalError(path, None, f"not a journal: it does not begin with {MAGIC.decode()}")
    reader = _Reader(file)
    header = _header(reader, path)
    contents = JournalContents(path, header, Grouping(header), end_offset=reader.offset)
    remembered = 0
    try:
        for payload in reader.payloads():
            remembered += 0 if payload[0] == RecordKind.BLOCK else len(payload)
            if remembered > MAX_REMEMBERED:
                raise BadRecord(f"more than {MAX_REMEMBERED} bytes of points and events")
            _take(contents, decode(payload, header))
            contents.end_offset = reader.offset
    except BadRecord as error:
        contents.problem = f"bad record at byte {contents.end_offset}: {error}"
        contents.torn = _is_torn(file, contents.end_offset)
    return contents


def _header(reader: _Reader, path: Path) -> RunHeader:
    try:
        payload = next(reader.payloads(), None)
        if payload is None:
            raise BadRecord("empty: the run ended before it recorded anything")
        header = decode(payload, None)
    except BadRecord as error:
        raise JournalError(path, len(MAGIC), f"no usable header: {error}") from None
    assert isinstance(header, RunHeader)
    return header


def _take(contents: JournalContents, record: JournalRecord) -> None:
    contents.grouping.follow(record)
    # Results belong to the END before them; those of an earlier attempt lack its later points.
    contents.results = record if isinstance(record, Results) else None
    contents.last_is_end = isinstance(record, End) or (
        contents.last_is_end and isinstance(record, Results)
    )
    if isinstance(record, Block):
        contents.last_time = max(contents.last_time, record.host_time)
    elif isinstance(record, JournalEvent):
        contents.events.append(record)
        contents.last_time = max(contents.last_time, record.time)
    elif isinstance(record, End):
        contents.ends.append(record)
        contents.last_time = max(contents.last_time, record.duration_s)
    elif isinstance(record, PointBegin):
        time = record.fields.get("time")
        if isinstance(time, (int, float)) and 0 <= time <= LONGEST_S:
            contents.last_time = max(contents.last_time, float(time))


class _Reader:
    """Payloads with a right checksum, one after the other; ``offset`` is behind the last."""

    def __init__(self, file: BinaryIO) -> None:
        self.file = file
        self.offset = len(MAGIC)

    def payloads(self) -> Iterator[bytes]:
        """Yield the next payloads until the end of the file. BadRecord if one is damaged."""
        while prefix := self.file.read(PREFIX.size):
            if len(prefix) < PREFIX.size:
                raise BadRecord(f"torn: {len(prefix)} of {PREFIX.size} bytes of its prefix")
            length, checksum = PREFIX.unpack(prefix)
            if not 0 < length <= MAX_PAYLOAD:
                raise BadRecord(f"length {length} is not in 1 to {MAX_PAYLOAD}")
            payload = self.file.read(length)
            if len(payload) < length:
                raise BadRecord(f"torn: {len(payload)} of {length} bytes")
            if zlib.crc32(payload) != checksum:
                raise BadRecord("its checksum is wrong")
            self.offset += PREFIX.size + length
            yield payload


def _is_torn(file: BinaryIO, offset: int) -> bool:
    """Return whether nothing sound follows a bad record: then it is a torn end, not damage inside.

    Looks for a whole record with a right checksum in what follows; when in doubt (a lot follows) it
    returns False, since a resumed run cuts a torn end off.
    """
    import numpy as np

    file.seek(0, 2)
    size = file.tell()
    if size - offset > _SEARCH_BYTES:
        return False
    file.seek(offset)
    tail = file.read(size - offset)
    budget = _SEARCH_CRC_BYTES
    for start in range(0, max(len(tail) - PREFIX.size, 0), 1 << 20):
        window = np.frombuffer(tail[start : start + (1 << 20) + PREFIX.size], np.uint8)
        places = len(window) - PREFIX.size
        length = sum(window[k : k + places].astype(np.uint32) << (8 * k) for k in range(4))
        kind = window[PREFIX.size :]
        fits = length + np.arange(start, start + places) + PREFIX.size <= len(tail)
        likely = (
            (length > 0) & (length <= MAX_PAYLOAD) & (kind > 0) & (kind <= max(RecordKind)) & fits
        )
        for place in np.flatnonzero(likely) + start:
            begin = int(place) + PREFIX.size
            size_here, checksum = PREFIX.unpack_from(tail, int(place))
            budget -= size_here
            if budget < 0 or zlib.crc32(tail[begin : begin + size_here]) == checksum:
                return False
    return True
