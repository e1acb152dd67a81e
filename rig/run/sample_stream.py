"""A running acquisition and the watch on it: a converter that falls silent is noticed.

The procedure's thread reads, a block a tick or so; the unit's buffer bridges what that is late. A
unit that is asked and has nothing, for longer than a block and a stall of the computer explain, has
stopped: nothing it would send later could be put in its place.
"""

from __future__ import annotations

from rig.core.clock import Clock
from rig.core.errors import InstrumentError
from rig.instruments.roles import Acquisition, DataAcquisition, Record, Scaling

SILENT_S = 0.5
"""No block for so much longer than one takes ends the run."""


class SampleStream:
    """Reads a DAQ block by block and watches that blocks come."""

    def __init__(self, daq: DataAcquisition, clock: Clock):
        self._daq, self._clock = daq, clock
        self._block_s = 0.0
        self._latest_s = 0.0
        """When the latest block came, or the acquisition began."""

    def start(self, acquisition: Acquisition) -> Scaling:
        """Begin sampling without end in blocks of `acquisition.samples` rows."""
        scaling = self._daq.start(acquisition)
        self._block_s = acquisition.samples / scaling.rate_S_s
        self._latest_s = self._clock.now()
        return scaling

    def read(self) -> Record | None:
        """The next block, or None where none is complete yet; InstrumentError where one has been
        due for longer than `SILENT_S`."""
        record = self._daq.read()
        now_s = self._clock.now()
        if record is not None:
            self._latest_s = now_s
        elif (silent_s := now_s - self._latest_s) > self._block_s + SILENT_S:
            raise InstrumentError(
                "daq",
                "stream",
                f"no block for {silent_s:.2g} s; one takes {self._block_s:.2g} s",
                "check that nothing else talks to the unit, and its cable",
            )
        return record

    def stop(self) -> None:
        """End the acquisition."""
        self._daq.stop()
