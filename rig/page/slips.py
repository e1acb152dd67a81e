"""Slips in a run under way that records none, as `rig detect` finds them in its file afterwards.

A run with a detector records what it finds, and the page shows that (`rig.page.view`). For a run
without one, and for recordings of earlier versions, the page's own process has the detector of
files judge the rows of v_1 and v_2 in the journal, each attempt at a trial by itself, in a thread
that keeps neither the state of the bench nor STOP waiting. The events of the detector depend on the
rows alone, so those of a recorded trial are the ones that `rig detect` finds in the run file.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rig.detector import DEFAULT_DETECTOR
from rig.detector.events import SHOWN_AS
from rig.files.errors import JournalError
from rig.files.journal.detections import NO_DETECTOR
from rig.files.journal.follow import JournalTail
from rig.files.journal.format import Block, JournalRecord, PointBegin, PointDiscard, PointKeep
from rig.files.journal.strips import STRIPS, stream_of_strips
from rig.files.journal.values import RunHeader, Stream, StreamState
from rig.page.watch import BenchWatch

if TYPE_CHECKING:
    from rig.detector.contract import Detector

log = logging.getLogger("rig")

SHOWN = {
    kind: SHOWN_AS[kind]
    for kind in ("predictive", "incipient slip", "cannot judge", "judges again")
}
"""Kinds of events that are shown, and what they are called. Rejections and rolls are in the
processed file."""
MOST_BYTES_A_LOOK = 4 << 20


@dataclass(frozen=True)
class FoundSlip:
    """A slip, or another event that is shown."""

    time_s: float
    """Time in s since the run's start."""
    what: str
    """What it is called, of `SHOWN`."""
    point: str
    in_record_s: float
    """Time in s since the first row of its attempt, as in processed files."""
    confidence: float

    def in_words(self) -> str:
        """Return what an event says of it."""
        return (
            f"{self.point}: at {self.in_record_s:.3f} s of its record, confidence "
            f"{self.confidence:.2f} ({DEFAULT_DETECTOR})"
        )


class SlipSearch:
    """The detector over the trials of one journal: its records in order, slips out."""

    def __init__(self) -> None:
        self._streams: tuple[Stream, ...] = ()
        self._strips = -1
        """Number of the stream with v_1 and v_2, -1 for none."""
        self._states: dict[int, StreamState] = {}
        self._point = ""
        self._first_index = 0
        """Index of the first row of the attempt, from which the detector counts."""
        self._detector: Detector | None = None

    def take(self, record: JournalRecord) -> list[FoundSlip]:
        """Take the next record, and return what the detector finds in it.

        Raises ValueError for strips that the detector cannot judge: their rate is unsuitable, or
        they are not in volts.
        """
        if isinstance(record, RunHeader):
            name = stream_of_strips(record.layout)
            self._streams = record.streams
            names = [stream.name for stream in record.streams]
            self._strips = names.index(name) if name in names else -1
            if record.settings.get("detector", NO_DETECTOR) != NO_DETECTOR:
                self._strips = -1  # the run records what its own detector finds
        elif isinstance(record, StreamState):
            self._states[record.stream] = record
        elif isinstance(record, PointBegin):
            self._point, self._detector = record.id, None
        elif isinstance(record, (PointKeep, PointDiscard)):
            self._point, self._detector = "", None
        elif isinstance(record, Block) and self._point and record.stream == self._strips:
            return self._judge(record)
        return []

    def _judge(self, block: Block) -> list[FoundSlip]:
        state = self._states.get(block.stream)
        if state is None or not state.rate_Hz:
            raise ValueError("the journal gives no sampling rate of v_1 and v_2")
        if state.units != "V":
            raise ValueError(f"v_1 and v_2 are in {state.units!r}, not in V")
        if self._detector is None:
            self._detector = _detector(state.rate_Hz)
            self._first_index = block.first_index
        volts = _volts(block, self._streams[block.stream], state)
        first = block.first_index - self._first_index
        # The last of its rows came when the block was recorded.
        begun_s = block.host_time - (len(volts) - 1) / state.rate_Hz
        return [
            FoundSlip(
                begun_s + (event.sample - first) / state.rate_Hz,
                SHOWN[event.kind],
                self._point,
                event.time_s,
                event.confidence,
            )
            for event in self._detector.add(volts, first_sample=first)
            if event.kind in SHOWN
        ]


class SlipFollower:
    """Looks for slips in the journal that a watch shows, and adds them to what is shown."""

    def __init__(self, watch: BenchWatch):
        self._watch = watch
        self._generation = -1
        self._tail: JournalTail | None = None
        self._search = SlipSearch()

    def look(self) -> bool:
        """Judge what has come; return whether more is there already. Never raises for a journal
        that cannot be judged: what is shown of the run then says so."""
        watch = self._watch
        with watch.lock:
            generation, path, behind = watch.generation, watch.path, watch.behind
        if generation != self._generation:
            self.close()
            self._generation, self._search = generation, SlipSearch()
            self._tail = None if path is None else JournalTail(path)
        if self._tail is None or behind:  # the state of the bench comes first
            return False
        try:
            records = self._tail.poll(MOST_BYTES_A_LOOK)
            found = [slip for record in records for slip in self._search.take(record)]
        except JournalError:
            return False  # the watch says so, or begins again with a journal that was cut
        except Exception as error:
            log.exception("no slips are looked for in %s", path)
            self.close()
            with watch.lock:
                if watch.generation == generation:
                    watch.view.note("warning", "page", f"no slips are looked for: {error}")
            return False
        with watch.lock:
            if watch.generation == generation:
                for slip in found:
                    watch.view.note_slip(slip.time_s, slip.what, slip.in_words())
        return bool(records)

    def close(self) -> None:
        """Close the journal."""
        if self._tail is not None:
            self._tail.close()
            self._tail = None


def _volts(block: Block, stream: Stream, state: StreamState) -> NDArray[np.float64]:
    """Return v_1 and v_2 of a block in V, (n, 2), as a reader of the run file computes them."""
    columns = [stream.channels.index(name) for name in STRIPS]
    rows = np.frombuffer(block.data, stream.dtype).reshape(-1, len(stream.channels))
    scale, offset = np.array(state.scale)[columns], np.array(state.offset)[columns]
    volts: NDArray[np.float64] = rows[:, columns].astype(np.float64) * scale + offset
    return volts


def _detector(rate_Hz: float) -> Detector:
    """Return the default detector. Raises ValueError for a rate that it cannot judge."""
    # Imported where the first strips come: the kernel costs a sweep's page 0.5 s and its memory.
    from rig.detector.registered import chosen_detector

    return chosen_detector(DEFAULT_DETECTOR).make(rate_Hz)
