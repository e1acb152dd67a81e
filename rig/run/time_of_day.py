"""Local time of a run: the computer's clock at its start, continued by the monotonic clock.

The computer's clock can be set while a run is under way, by a person or after the network is back.
A run's durations and the order of what it records never depend on it; a jump is noticed and
recorded, and the end of a run stays after its start.
"""

from __future__ import annotations

import time
from datetime import datetime, timedelta

from rig.core.clock import suspended_s

SMALLEST_JUMP_S = 1.0
"""A smaller change is a correction of the rate, as time services make them all the time."""


class TimeOfDay:
    """Gives local time, and notices when the computer's clock is set or the computer suspended."""

    def __init__(self, no_earlier_than: datetime | None = None) -> None:
        """Begin with the computer's clock, or with a later time that is known to have passed: the
        latest time in the journal of a run that is resumed."""
        now = datetime.fromtimestamp(time.time()).astimezone()
        self._start = now if no_earlier_than is None else max(now, no_earlier_than)
        self._suspended_s = suspended_s()
        self._start_s = _passed_s()
        self._offset_s = time.time() - self._start_s

    def now_iso(self) -> str:
        """Return local time with its offset from UTC, ISO 8601."""
        passed = timedelta(seconds=_passed_s() - self._start_s)
        return (self._start + passed).isoformat(timespec="milliseconds")

    def jump_s(self) -> float:
        """Return how many seconds the computer's clock was set forward, or (negative) back, since
        the last call; 0 if it was not."""
        offset_s = time.time() - _passed_s()
        jump_s = offset_s - self._offset_s
        if abs(jump_s) < SMALLEST_JUMP_S:
            return 0.0
        self._offset_s = offset_s
        return jump_s

    def sleep_s(self) -> float:
        """Return for how many seconds the computer was suspended since the last call; 0 if it was
        not."""
        now_s = suspended_s()
        slept_s = now_s - self._suspended_s
        if slept_s < SMALLEST_JUMP_S:
            return 0.0
        self._suspended_s = now_s
        return slept_s


def _passed_s() -> float:
    """Return the time since the computer was started, in s; time in which it was suspended is
    included."""
    return time.monotonic() + suspended_s()


def jump_in_words(jump_s: float) -> str:
    """Return a jump as a warning."""
    way = "forward" if jump_s > 0 else "back"
    return (
        f"the computer's clock was set {way} by {abs(jump_s):.0f} s during the run; durations and "
        "the order of the data do not depend on it, times of day continue from the run's start"
    )


def sleep_in_words(slept_s: float) -> str:
    """Return the time for which the computer was suspended as a warning."""
    return (
        f"the computer was suspended for {slept_s:.0f} s during the run; the durations and the "
        "times of the data do not include it: a computer at a bench must never sleep"
    )
