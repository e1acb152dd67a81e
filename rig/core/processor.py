"""One processor for two processes that take turns.

In slaved time a command and its simulated bench never work at once: each waits for the other's
answer, some six thousand times a sweep. On two processors every turn has to wake a processor up,
which on a virtual machine may cost more than the turn itself; on one it is a switch. A claim on the
processor keeps two such pairs from sharing one: whoever finds none free goes without. Elsewhere
than on Linux all of this does nothing.
"""

from __future__ import annotations

import contextlib
import os
import socket
import sys

CLAIM = "\0tactile-rig: processor {}"
"""Name of a socket outside the file system: it is free again when its holder has died."""


def _given() -> frozenset[int]:
    if sys.platform != "linux":
        return frozenset()
    return frozenset(os.sched_getaffinity(0))


GIVEN = _given()
"""The processors that this process was started with."""


class Turns:
    """This thread and another process on one processor, until closed."""

    def __init__(self, pid: int):
        self._claim: socket.socket | None = None
        if len(GIVEN) < 2:
            return
        for processor in sorted(GIVEN, reverse=True):  # the first ones have interrupts to serve
            claim = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            try:
                claim.bind(CLAIM.format(processor))
            except OSError:  # another pair has it
                claim.close()
                continue
            self._claim = claim
            place(0, {processor})
            place(pid, {processor})
            return

    def close(self) -> None:
        """This thread may run anywhere again; the other process is left where it is."""
        if self._claim is not None:
            place(0, GIVEN)
            self._claim.close()
            self._claim = None


def let_run_anywhere(pid: int) -> None:
    """Of a child that would otherwise stay where its parent takes turns."""
    if len(GIVEN) > 1:
        place(pid, GIVEN)


def two_places() -> tuple[frozenset[int], frozenset[int]] | None:
    """The processors in two parts, for two threads that are not to share one; None where there is
    but one, or where nobody can be placed."""
    if len(GIVEN) < 2:
        return None
    last = max(GIVEN)
    return GIVEN - {last}, frozenset({last})


def place(pid: int, processors: set[int] | frozenset[int]) -> None:
    """Have a process run on these alone; 0 is the calling thread."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError):  # it has ended, or may not be placed
            os.sched_setaffinity(pid, processors)
