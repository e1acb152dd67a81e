"""One pass over the samples of a journal: blocks in, pieces of whole chunks out.

The journal has blocks as they came from the instruments, often a few rows long. The run file has
chunks of `CHUNK_ROWS` rows, each compressed once. `SampleWalk.pieces` joins the one into the other,
so that memory holds at most one chunk a stream; on its way it notes what a run file must hold in
the end: the place of every block in time, and a digest of every piece.
"""

from __future__ import annotations

import hashlib
from array import array
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

from rig.files.hdf5.nexus import CHUNK_ROWS
from rig.files.journal.format import Block
from rig.files.journal.reader import JournalContents
from rig.files.journal.segments import Grouping
from rig.files.journal.values import RunHeader

if TYPE_CHECKING:
    from numpy.typing import NDArray


class Piece(NamedTuple):
    """Consecutive rows of one segment: a whole chunk, or what is left at the segment's end."""

    segment: int
    """Index into the journal's segments."""
    first: int
    """Index of the first row in its segment, a multiple of CHUNK_ROWS."""
    rows: NDArray[Any]
    """Raw counts, shape (n, channels), n at most CHUNK_ROWS."""


class SampleWalk:
    """Reads all samples of a journal once. Use `pieces` first, then `blocks` and `digests`."""

    def __init__(self, contents: JournalContents) -> None:
        self.contents = contents
        self.blocks = BlockTable(len(contents.header.streams))
        """Position of each block in its segment and in time."""
        self.digests: list[list[list[bytes]]] = [[] for _ in contents.segments]
        """Digest of every channel, for each piece of each segment."""

    def pieces(self) -> Iterator[Piece]:
        """Read the journal and yield its samples, the pieces of each segment in order.

        Pieces of different streams alternate as their blocks do in the journal. Raises
        JournalError if the journal changed since its contents were read.
        """
        for piece in self._joined():
            self.digests[piece.segment].append(channel_digests(piece.rows))
            yield piece

    def exhaust(self) -> SampleWalk:
        """Read the journal for `blocks` and `digests` alone; returns this walk."""
        for _ in self.pieces():
            pass
        return self

    def _joined(self) -> Iterator[Piece]:
        grouping = Grouping(self.contents.header)
        filling: dict[int, _Chunk] = {}
        """The chunk of each stream that is not full yet."""
        for record in self.contents.records():
            segment = grouping.follow(record)
            if segment is None or not isinstance(record, Block):
                continue
            chunk = filling.get(record.stream)
            if chunk is None or chunk.segment != segment:
                if chunk is not None:
                    yield from chunk.rest()
                chunk = filling[record.stream] = _Chunk(segment)
            rows = _rows_of(record, self.contents.header)
            self.blocks.add(record, segment, len(rows))
            yield from chunk.add(rows)
        for chunk in filling.values():
            yield from chunk.rest()


def channel_digests(rows: NDArray[Any]) -> list[bytes]:
    """Return the SHA-256 of each channel's bytes; `rows` has the shape (n, channels)."""
    import numpy as np

    columns = (np.ascontiguousarray(rows[:, k]) for k in range(rows.shape[1]))
    return [hashlib.sha256(column.data).digest() for column in columns]


class BlockTable:
    """One row for each block of each stream: segment, first index, host time, rows."""

    def __init__(self, streams: int) -> None:
        self.columns = [
            {"segment": array("q"), "first_index": array("q"), "rows": array("q")}
            for _ in range(streams)
        ]
        self.host_times = [array("d") for _ in range(streams)]

    def add(self, block: Block, segment: int, rows: int) -> None:
        """Append the next block of its stream."""
        columns = self.columns[block.stream]
        columns["segment"].append(segment)
        columns["first_index"].append(block.first_index)
        columns["rows"].append(rows)
        self.host_times[block.stream].append(block.host_time)

    def arrays(self, stream: int) -> dict[str, NDArray[Any]]:
        """Return a stream's columns, shape (blocks,): int64, and ``host_time`` as float64 in s
        since the run's start."""
        import numpy as np

        arrays = {name: np.array(v, np.int64) for name, v in self.columns[stream].items()}
        return arrays | {"host_time": np.array(self.host_times[stream], np.float64)}


class _Chunk:
    """Rows of one segment, until they are CHUNK_ROWS."""

    def __init__(self, segment: int) -> None:
        self.segment = segment
        self._parts: list[NDArray[Any]] = []
        self._length = 0
        self._first = 0

    def add(self, rows: NDArray[Any]) -> Iterator[Piece]:
        """Take rows; yields a piece each time that the chunk is full."""
        while self._length + len(rows) >= CHUNK_ROWS:
            fitting = CHUNK_ROWS - self._length
            self._append(rows[:fitting])
            yield from self.rest()
            rows = rows[fitting:]
        if len(rows):
            self._append(rows)

    def rest(self) -> Iterator[Piece]:
        """Yield what is there, full or not, and begin the next chunk."""
        import numpy as np

        if self._length:
            rows = self._parts[0] if len(self._parts) == 1 else np.concatenate(self._parts)
            yield Piece(self.segment, self._first, rows)
            self._first += self._length
            self._parts, self._length = [], 0

    def _append(self, rows: NDArray[Any]) -> None:
        self._parts.append(rows)
        self._length += len(rows)


def _rows_of(block: Block, header: RunHeader) -> NDArray[Any]:
    """Return a block's rows, shape (n, channels); a view of its bytes."""
    import numpy as np

    stream = header.streams[block.stream]
    return np.frombuffer(block.data, stream.dtype).reshape(-1, len(stream.channels))
