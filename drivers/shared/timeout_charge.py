"""The wall time that a time-out has taken, as it passes on the bench's clock."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from rig.core.errors import InstrumentError

if TYPE_CHECKING:
    from rig.core.clock import Clock


class TimeoutCharge:
    """Lets bench time pass for a link's time-outs, which take wall time."""

    def __init__(self, clock: Clock, timeout_s: float):
        self._clock, self._timeout_s = clock, timeout_s
        self.under_way = False
        """True while bench time passes for a time-out. What is asked of the link meanwhile may time
        out as well, and no time is added for that."""

    def __call__(self) -> None:
        """Let bench time pass for one time-out. Raises no InstrumentError: the time-out itself is
        what has to be reported."""
        if self.under_way:
            return
        self.under_way = True
        try:
            with contextlib.suppress(InstrumentError):
                self._clock.charge(self._timeout_s)
        finally:
            self.under_way = False
