"""A time limit for code of another package, which may never return."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections.abc import Iterator
from types import FrameType

from rig.core.errors import RigError

AGAIN_EVERY_S = 5.0
"""Interval in s at which code is interrupted again that has caught the first interruption."""
SHORTEST_S = 0.001
"""Time left to an outer timer that ran out meanwhile, in s."""


class TimeLimitError(RigError):
    """Raised in the middle of code whose time is over."""


@contextlib.contextmanager
def time_limit(limit_s: float) -> Iterator[None]:
    """Raise TimeLimitError in the block when `limit_s` (above 0) are over.

    It comes from a timer's signal, so a library that is busy in C is interrupted when it returns
    to Python, and a thread other than the main one has no limit.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    over: list[bool] = []

    def end(number: int, frame: FrameType | None) -> None:
        if not over:  # it comes also between the end of the block and that of the timer
            raise TimeLimitError(f"it took longer than {limit_s:.3g} s")

    before = signal.signal(signal.SIGALRM, end)
    begun_s = time.monotonic()
    outer_s, outer_again_s = signal.setitimer(signal.ITIMER_REAL, limit_s, AGAIN_EVERY_S)
    try:
        yield
    finally:
        over.append(True)
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
        if outer_s:
            left_s = max(outer_s - (time.monotonic() - begun_s), SHORTEST_S)
            signal.setitimer(signal.ITIMER_REAL, left_s, outer_again_s)
