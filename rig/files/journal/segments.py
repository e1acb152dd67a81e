"""Group blocks into segments: gapless rows of one stream, in one attempt at a point.

A segment ends where the point ends, where the stream's scale, rate or range changes, and where
``first_index`` does not continue: across these, samples have no common clock. Bookkeeping over
records, without any file.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from rig.files.journal.format import Block, JournalRecord, PointBegin, PointDiscard, PointKeep
from rig.files.journal.values import End, RunHeader, StreamState

RECORDED_BEFORE = "recorded before"
"""Why a further record of a point that was kept is discarded."""


@dataclass(slots=True)
class Attempt:
    """One attempt at a point. `begin` and `result` are the JSON texts of its records."""

    id: str
    begin: str
    status: str = "unfinished"
    """kept, discarded or unfinished."""
    reason: str = ""
    result: str = ""


@dataclass(slots=True)
class Segment:
    """Gapless rows of one stream; ``attempt`` is an index into the attempts, None between points.

    ``state`` is how the counts read, None where the journal does not say.
    """

    stream: int
    attempt: int | None
    state: StreamState | None
    first_index: int
    host_time: float
    rows: int = 0


@dataclass(slots=True)
class Grouping:
    """Follows the records of a journal in order and groups them: attempts at points, segments of
    samples.
    """

    header: RunHeader
    attempts: list[Attempt] = field(default_factory=list)
    segments: list[Segment] = field(default_factory=list)
    kept: dict[str, int] = field(default_factory=dict)
    """Point id to the index of the attempt that was kept."""
    _states: dict[int, StreamState] = field(default_factory=dict)
    _open: dict[int, int] = field(default_factory=dict)
    _current: int | None = None

    def follow(self, record: JournalRecord) -> int | None:
        """Take the next record. Returns the index of the segment that a block belongs to, else
        None.
        """
        if isinstance(record, Block):
            return self._place(record)
        if isinstance(record, StreamState):
            self._states[record.stream] = record
            self._open.pop(record.stream, None)
        elif isinstance(record, PointBegin):
            self.attempts.append(Attempt(record.id, record.text))
            self._switch_to(len(self.attempts) - 1)
        elif isinstance(record, PointKeep):
            self._keep(record)
        elif isinstance(record, PointDiscard):
            self._finish(record.id, "discarded", record.reason, record.text)
        elif isinstance(record, End):
            self._switch_to(None)
        return None

    @property
    def open_point(self) -> str | None:
        """Id of the point that is open, or None."""
        return None if self._current is None else self.attempts[self._current].id

    def _place(self, block: Block) -> int:
        index = self._open.get(block.stream)
        rows = len(block.data) // self.header.streams[block.stream].row_bytes
        if index is not None:
            segment = self.segments[index]
            if segment.first_index + segment.rows == block.first_index:
                segment.rows += rows
                return index
        state = self._states.get(block.stream)
        self.segments.append(
            Segment(block.stream, self._current, state, block.first_index, block.host_time, rows)
        )
        self._open[block.stream] = len(self.segments) - 1
        return len(self.segments) - 1

    def _keep(self, record: PointKeep) -> None:
        if record.id in self.kept:
            self._finish(record.id, "discarded", RECORDED_BEFORE, record.text)
            return
        index = self._finish(record.id, "kept", "", record.text)
        self.kept[record.id] = index

    def _finish(self, point_id: str, status: str, reason: str, text: str) -> int:
        if self.open_point != point_id:
            self.attempts.append(Attempt(point_id, ""))
            self._current = len(self.attempts) - 1
        index = len(self.attempts) - 1 if self._current is None else self._current
        attempt = self.attempts[index]
        attempt.status, attempt.reason, attempt.result = status, reason, text
        self._switch_to(None)
        return index

    def _switch_to(self, attempt: int | None) -> None:
        self._current = attempt
        self._open.clear()
