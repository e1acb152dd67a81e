"""Read a running acquisition, and notice a converter that falls silent.

A block is asked for when it is due; the unit's buffer bridges late reads. A unit that has no data
for longer than a block and a stall of the computer can explain has stopped, and data that it sent
later could not be placed in time. A link that transfers less than is sampled is noticed as well,
before the contact has to wait for the rest of the data.
"""

from __future__ import annotations

from rig.core.clock import Clock
from rig.core.errors import InstrumentError
from rig.instruments.roles import Acquisition, DataAcquisition, Record, Scaling

SILENT_S = 0.5
"""Delay of a block, beyond the time that one takes, that ends the run."""
BEHIND_S = 2.0
"""Accumulated excess of reading time over sampling time that ends the run: the link transfers less
than is sampled, and the contact would have to wait for the rest."""
LONGEST_READ_S = 0.5
"""Largest contribution of one read to that excess: one stall of the computer is not a slow link."""


class SlowStreamError(InstrumentError):
    """Raised when the blocks of an acquisition take longer to be read than to be sampled."""


class SampleStream:
    """Reads a DAQ block by block and checks that blocks come in time."""

    def __init__(self, daq: DataAcquisition, clock: Clock):
        self._daq, self._clock = daq, clock
        self._block_s = 0.0
        self._latest_s = 0.0
        """Time of the latest block, or of the beginning of the acquisition."""
        self._behind_s = 0.0
        """Excess of reading time over sampling time of the latest reads."""

    def start(self, acquisition: Acquisition) -> Scaling:
        """Begin sampling until stopped, in blocks of `acquisition.samples` rows."""
        scaling = self._daq.start(acquisition)
        self._block_s = acquisition.samples / scaling.rate_S_s
        self._latest_s, self._behind_s = self._clock.now(), 0.0
        return scaling

    def read(self) -> Record | None:
        """Return the next block, or None if none is complete yet. Raises InstrumentError if one has
        been due for longer than `SILENT_S`, and SlowStreamError if reading blocks takes longer than
        sampling them.
        """
        asked_s = self._clock.now()
        record = self._daq.read()
        now_s = self._clock.now()
        if record is not None:
            self._latest_s = now_s
            self._refuse_slow(now_s - asked_s)
        elif (silent_s := now_s - self._latest_s) > self._block_s + SILENT_S:
            raise InstrumentError(
                "daq",
                "stream",
                f"no block for {silent_s:.2g} s; one takes {self._block_s:.2g} s",
                "check that nothing else talks to the unit, and its cable",
            )
        return record

    def _refuse_slow(self, took_s: float) -> None:
        lost_s = min(took_s, LONGEST_READ_S) - self._block_s
        self._behind_s = max(0.0, self._behind_s + lost_s)
        if self._behind_s > BEHIND_S:
            raise SlowStreamError(
                "daq",
                "stream",
                f"its blocks of {self._block_s:.2g} s take longer than that to be read, the latest "
                f"{took_s:.2g} s: the link transfers less than is sampled",
                "check the link and what else the computer does; ask for longer blocks or a lower "
                "rate",
            )

    def stop(self) -> None:
        """End the acquisition; does nothing if none runs."""
        self._daq.stop()
