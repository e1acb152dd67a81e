"""A running acquisition and the watch on it: a converter that falls silent is noticed.

The procedure's thread reads, a block a tick or so; the unit's buffer bridges what that is late. A
unit that is asked and has nothing, for longer than a block and a stall of the computer explain, has
stopped: nothing it would send later could be put in its place. A link that brings less than is
sampled is noticed as well, before what is pressed has to wait until all of it has come.
"""

from __future__ import annotations

from rig.core.clock import Clock
from rig.core.errors import InstrumentError
from rig.instruments.roles import Acquisition, DataAcquisition, Record, Scaling

SILENT_S = 0.5
"""No block for so much longer than one takes ends the run."""
BEHIND_S = 2.0
"""Once reading blocks has taken so much longer than sampling them, the run ends: the link brings
less than is sampled, and what is pressed would have to wait for the rest."""
LONGEST_READ_S = 0.5
"""What one read adds to that at most: a computer that stalls once is not a slow link."""


class SampleStream:
    """Reads a DAQ block by block and watches that blocks come."""

    def __init__(self, daq: DataAcquisition, clock: Clock):
        self._daq, self._clock = daq, clock
        self._block_s = 0.0
        self._latest_s = 0.0
        """When the latest block came, or the acquisition began."""
        self._behind_s = 0.0
        """How much longer the latest reads have taken than what they have brought."""

    def start(self, acquisition: Acquisition) -> Scaling:
        """Begin sampling without end in blocks of `acquisition.samples` rows."""
        scaling = self._daq.start(acquisition)
        self._block_s = acquisition.samples / scaling.rate_S_s
        self._latest_s, self._behind_s = self._clock.now(), 0.0
        return scaling

    def read(self) -> Record | None:
        """The next block, or None where none is complete yet; InstrumentError where one has been
        due for longer than `SILENT_S`, or where reading them takes longer than sampling them."""
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
            raise InstrumentError(
                "daq",
                "stream",
                f"its blocks of {self._block_s:.2g} s take longer than that to be read, the latest "
                f"{took_s:.2g} s: the link brings less than is sampled",
                "check the link and what else the computer does; ask for longer blocks or a lower "
                "rate",
            )

    def stop(self) -> None:
        """End the acquisition."""
        self._daq.stop()
