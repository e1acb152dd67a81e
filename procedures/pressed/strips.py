"""The strips' samples in a trial: read beside its ticks, recorded raw and at 1 kHz."""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING

import numpy as np

from procedures.pressed.reading import DECIMATED_Hz, Taken
from rig.analysis.trial.decimation import Decimator
from rig.bench.bench import STRIPS
from rig.run.sample_stream import SampleStream

if TYPE_CHECKING:
    import numpy.typing as npt

    from procedures.pressed.settings import PressedSettings
    from rig.instruments.roles import Record
    from rig.run.context import Run

CLOCKS_DIFFER = 1e-3
"""Far more than the clocks of DAQ and computer do: a block is asked for when it may be there."""
BLOCKS_A_LOOK = 4
"""Of the DAQ at most, one being due: a loop that is late has the force to look at as well."""
CATCHING_UP = 2.0
"""Where blocks are shorter: of those that come from one look to the next, so many times as many."""


class StripRecord:
    """An acquisition of the strips and its record. What it takes is told in `taken`."""

    def __init__(self, run: Run, taken: Taken):
        self._run, self._taken = run, taken
        self._settings: PressedSettings = run.settings
        self.link = run.bench.links["daq"]
        self._samples = SampleStream(run.bench.daq, run.clock)
        self._decimator = Decimator(self._settings.rate_S_s, len(STRIPS))
        self._rows_read = 0
        self._blocks: deque[Record] = deque()
        """Read, and not recorded yet."""

    def start(self) -> None:
        """Begin to sample: the record's times are from here."""
        self._samples.start(self._settings.acquisition)
        self._taken.begun_s = self._run.clock.now()
        self._taken.filter_delay_s = self._decimator.delay_s

    def collect(self, look_s: float) -> None:
        """Ask for what may be there, and record what has come; the next time is `look_s` later."""
        if self._block_due():
            self.link.ask("blocks", lambda: self._read_blocks(look_s))
        self._keep_blocks()

    def collect_rest(self) -> None:
        """Every block of what has been sampled until now, each a sign of life."""
        sampled = self._rows_by_now()
        self._keep_blocks()
        while self._rows_read < sampled and self._read_block():
            self._keep_blocks()
            self._run.check_stop()

    def stop(self) -> None:
        """End the acquisition."""
        self._samples.stop()

    # --- on the link ----------------------------------------------------------------------------

    def _rows_by_now(self) -> float:
        """How many rows the DAQ may have sampled, its clock running ahead of ours perhaps."""
        since_s = self._run.clock.now() - self._taken.begun_s
        return since_s * self._settings.rate_S_s * (1 + CLOCKS_DIFFER)

    def _block_due(self) -> bool:
        return self._rows_read + self._settings.block_samples <= self._rows_by_now()

    def _read_block(self) -> bool:
        """Read one; whether the DAQ had it."""
        block = self._samples.read()
        if block is None:
            return False
        self._rows_read += len(block.counts)
        self._blocks.append(block)
        return True

    def _read_blocks(self, look_s: float) -> None:
        """Read those that may be there, of many a few."""
        coming = look_s / self._settings.block_s
        for _ in range(max(BLOCKS_A_LOOK, math.ceil(CATCHING_UP * coming))):
            if not (self._block_due() and self._read_block()):
                return

    # --- in the record --------------------------------------------------------------------------

    def _keep_blocks(self) -> None:
        while self._blocks:
            block = self._blocks.popleft()
            self._run.emit("strips", block)
            self._taken.rows += len(block.counts)
            volts = np.stack([block.volts(name) for name in STRIPS], axis=1)
            self._keep_signals(self._decimator.add(volts))

    def _keep_signals(self, volts: npt.NDArray[np.float64]) -> None:
        if not len(volts):
            return
        rows = np.column_stack([volts[:, 0] - volts[:, 1], volts])
        self._run.put("signals", self._taken.signal_rows, rows, DECIMATED_Hz, units="V")
        self._taken.signal_rows += len(rows)
        self._taken.volts.append(volts)
