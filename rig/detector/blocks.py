"""Giving a recording to a detector as a running trial does: rows in blocks of 2 ms, and what the
bench knew before the block in which it takes effect.

The events of a detector of this project do not depend on how the rows are cut, so that it gets the
whole recording at once. One of another package might use later rows than a trial would have shown
it, and date its events by them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rig.detector.notices import CutOff, HeldForce, Notice, XMove

if TYPE_CHECKING:
    from rig.detector.contract import Detector
    from rig.detector.events import SlipEvent
    from rig.detector.registered import ChosenDetector

BLOCK_S = 0.002
"""Length in s of the blocks in which a trial hands rows to a detector."""


class BlockFeed:
    """A detector for one recording, and the notices that it has not been given yet."""

    def __init__(self, chosen: ChosenDetector, rate_Hz: float, notices: Iterable[Notice] = ()):
        """Make the detector for rows at a rate. Raises ValueError for a rate that it refuses."""
        self.detector: Detector = chosen.make(rate_Hz)
        self._rows = None if chosen.is_own else max(1, round(BLOCK_S * rate_Hz))
        known = list(notices)
        self._waiting = [
            _due([one for one in known if isinstance(one, kind)])
            for kind in (XMove, HeldForce, CutOff)
        ]

    def add(self, volts: NDArray[np.float64], first_sample: int) -> list[SlipEvent]:
        """Return the events in further rows (n, 2) in V, the first of which has this index. Raises
        ValueError as `Detector.add` does."""
        events: list[SlipEvent] = []
        rows = self._rows or max(1, len(volts))
        for begin in range(0, max(1, len(volts)), rows):
            part = volts[begin : begin + rows]
            first = first_sample + begin
            self._give_notices(first + len(part))
            events += self.detector.add(part, first_sample=first)
        return events

    def finish(self) -> list[SlipEvent]:
        """Return the events due at the end of the recording."""
        return self.detector.finish()

    def _give_notices(self, before_row: int) -> None:
        for queue in self._waiting:
            while queue and queue[0][0] < before_row:
                self.detector.notice(queue.popleft()[1])


def _due(notices: list[Notice]) -> deque[tuple[int, Notice]]:
    """Return notices of one kind in their order, each with the row before which it is given: a
    later one may take the place of one that has not taken effect."""
    due = deque[tuple[int, Notice]]()
    for one in reversed(notices):
        due.appendleft((min(one.sample, due[0][0]) if due else one.sample, one))
    return due
