"""The strips' samples in a trial: read in the background, decimated, judged, and recorded.

A block is asked for as soon as it may be there, between the ticks of the servo as well, so that the
detector sees a slip at most a block after it. Where the ticks record, they record all that has come
since the tick before.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from procedures.pressed.record.trial_record import TrialRecord
from rig.analysis.trial.decimation import DECIMATED_Hz, Decimator
from rig.bench.settings import STRIPS
from rig.detector.notices import CutOff
from rig.instruments.roles import Record
from rig.run.streams.sample_stream import SampleStream

if TYPE_CHECKING:
    import numpy.typing as npt

    from procedures.pressed.links import TrialLinks
    from procedures.pressed.record.detection import LiveDetection
    from procedures.pressed.settings import PressedSettings
    from rig.run.context import Run

    Volts = npt.NDArray[np.float64]

UNIT_AHEAD = 1e-3
"""Far more than the clocks of DAQ and computer do: a block is asked for when it may be there."""
LINK_ROOM_S = 0.0002
"""Time after the instant at which a block may be there, at which it is asked for: the acquisition
began within the exchange that started it."""
BLOCKS_A_POLL = 4
"""Largest number of blocks that are read in a row when one is due: a loop that is late has the
force to handle too."""
CATCHING_UP = 2.0
"""Ratio of the blocks that are read at most in a poll interval to those that come in it, if blocks
are shorter."""


class StripRecorder:
    """An acquisition of the strips: its blocks are read on the DAQ's link and recorded by ticks."""

    def __init__(
        self,
        run: Run,
        record: TrialRecord,
        links: TrialLinks,
        detection: LiveDetection,
        block_s: float,
    ):
        """Read the strips in blocks of `block_s`."""
        self._run, self._record, self._links = run, record, links
        links.add("daq")
        self._settings: PressedSettings = run.settings
        self._samples = SampleStream(run.bench.daq, run.clock)
        self._decimator = Decimator(self._settings.rate_S_s, len(STRIPS))
        self._detection = detection
        self.block_s = block_s
        """Length in s of the blocks that are read."""
        self._block_samples = round(self._settings.rate_S_s * block_s)
        self._rows_read = self._blocks_read = 0
        self._reading_s = 0.0
        self._next_s = math.inf
        """Time on the run's clock at which the next block is asked for between ticks."""
        self._caught_up_s = -math.inf
        """Time on the run's clock at which the DAQ was last asked for a block that was not there
        yet."""
        self._blocks: deque[tuple[Record, Volts]] = deque()
        """Read and not recorded yet: raw, and decimated."""

    def start(self) -> None:
        """Begin to sample: the record's times are from here."""
        self._detection.begin()
        self._samples.start(replace(self._settings.acquisition, samples=self._block_samples))
        self._record.begun_s = self._run.clock.now()
        self._record.filter_delay_s = self._decimator.delay_s
        self._next_s = self._record.begun_s + self.block_s + LINK_ROOM_S

    @property
    def next_s(self) -> float:
        """Time on the run's clock at which `ask_block` is due; infinite where nothing is
        sampled."""
        return self._next_s

    @property
    def behind_s(self) -> float:
        """Time in s for which the oldest block that has not been read has been there; 0 where
        nothing is sampled.

        It is not longer than the time since the DAQ had no further block: a DAQ whose clock is slow
        is not read late.
        """
        if math.isinf(self._next_s):
            return 0.0
        now_s = self._run.clock.now()
        sampled_s = now_s - self._record.begun_s - self.block_s
        read_s = self._rows_read / self._settings.rate_S_s
        return max(0.0, min(sampled_s - read_s, now_s - self._caught_up_s))

    @property
    def mean_read_s(self) -> float:
        """Mean time in s that the DAQ's link has taken to transfer a block."""
        return self._reading_s / max(1, self._blocks_read)

    def ask_block(self) -> None:
        """Ask for the block that may be there, to be judged as soon as it is."""
        block_s = self.block_s
        late = max(0, math.floor((self._run.clock.now() - self._next_s) / block_s))  # blocks
        self._next_s += (1 + late) * block_s
        if self._block_due():
            self._links.ask("daq", "blocks", lambda: self._read_blocks(block_s))

    def collect(self, interval_s: float) -> None:
        """Ask for the blocks that may be there, and record those that have come. The next call is
        expected `interval_s` later."""
        if self._block_due():
            self._links.ask("daq", "blocks", lambda: self._read_blocks(interval_s))
        self._record_blocks()

    def collect_rest(self) -> None:
        """Collect every block that has been sampled until now; each is a sign of life."""
        sampled = self._rows_by_now()
        self._record_blocks()
        while self._rows_read < sampled and self._read_block():
            self._record_blocks()
            self._run.check_stop()
        self._detection.finish()
        self._record.notices = self._detection.notices

    def stop(self) -> None:
        """End the acquisition."""
        self._next_s = math.inf
        self._samples.stop()

    # --- on the link ----------------------------------------------------------------------------

    def _rows_by_now(self) -> float:
        """Return the largest number of rows that the DAQ may have sampled by now, since its clock
        may run ahead."""
        since_s = self._run.clock.now() - self._record.begun_s
        return since_s * self._settings.rate_S_s * (1 + UNIT_AHEAD)

    def _block_due(self) -> bool:
        return bool(self._rows_read + self._block_samples <= self._rows_by_now())

    def _read_block(self) -> bool:
        """Read one block; return whether the DAQ had it."""
        asked_s = self._run.clock.now()
        block = self._samples.read()
        if block is None:
            self._caught_up_s = asked_s
            return False
        self._reading_s += self._run.clock.now() - asked_s
        self._blocks_read += 1
        if (cut_off := self._cut_off(block)) is not None:
            self._detection.notice(cut_off)  # before the rows that it is about
        self._rows_read += len(block.counts)
        volts = self._decimator.add(np.stack([block.volts(name) for name in STRIPS], axis=1))
        # Judged first: what acts on a slip must not wait for anything that can come later.
        self._detection.judge(volts)
        self._blocks.append((block, volts))
        return True

    def _cut_off(self, block: Record) -> CutOff | None:
        """Return the decimated rows in which the next block shows a strip at an end of the DAQ's
        range, from the first to the last; None without any."""
        ends = np.logical_or(*(block.at_end_of_range(name) for name in STRIPS))
        at = np.flatnonzero(ends)
        if not at.size:
            return None
        factor = self._decimator.factor
        first, last = (math.ceil((self._rows_read + k) / factor) for k in at[[0, -1]])
        return CutOff(first, last + 1)

    def _read_blocks(self, interval_s: float) -> None:
        """Read the blocks that may be there, of many a few."""
        coming = interval_s / self.block_s
        for _ in range(max(BLOCKS_A_POLL, math.ceil(CATCHING_UP * coming))):
            if not (self._block_due() and self._read_block()):
                return

    # --- in the record --------------------------------------------------------------------------

    def _record_blocks(self) -> None:
        """Record what has been read, as one block where it is in one piece."""
        waiting = [self._blocks.popleft() for _ in range(len(self._blocks))]
        if not waiting:
            return
        for piece in _in_pieces([block for block, _ in waiting]):
            self._run.streams.record_raw("strips", piece)
            self._record.rows += len(piece.counts)
            for strip in STRIPS:
                self._record.clipped[strip] += piece.clipped(strip)
        self._record_signals(np.concatenate([volts for _, volts in waiting]))

    def _record_signals(self, volts: Volts) -> None:
        if not len(volts):
            return
        rows = np.column_stack([volts[:, 0] - volts[:, 1], volts])
        self._run.streams.record_rows(
            "signals", self._record.signal_rows, rows, DECIMATED_Hz, units="V"
        )
        self._record.signal_rows += len(rows)
        self._record.volts.append(volts)


def _in_pieces(blocks: list[Record]) -> list[Record]:
    """Return blocks with those joined that follow each other without a gap and are scaled alike."""
    pieces: list[list[Record]] = []
    for block in blocks:
        last = pieces[-1][-1] if pieces else None
        if (
            last is not None
            and last.scaling == block.scaling
            and last.first_index + len(last.counts) == block.first_index
        ):
            pieces[-1].append(block)
        else:
            pieces.append([block])
    return [
        Record(
            np.concatenate([one.counts for one in piece]), piece[0].scaling, piece[0].first_index
        )
        for piece in pieces
    ]
