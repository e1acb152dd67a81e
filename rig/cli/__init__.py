"""The command line: parses, calls, prints; no logic of its own."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from types import FrameType

SIGNALS_THAT_END = (signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
"""Beside SIGINT, which Python turns into KeyboardInterrupt."""


def main() -> None:
    """Entry point of the command ``rig``."""
    for number in SIGNALS_THAT_END:
        signal.signal(number, _leave)
    # One thread of linear algebra: the products here are small, and a second thread would only
    # disturb the loop that holds a force.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        from rig.cli.streams import outlast_readers

        outlast_readers()
        from rig.cli.app import perform

        perform(sys.argv[1:])
    except KeyboardInterrupt:
        sys.exit(_code(signal.SIGINT))
    finally:  # what Python still clears away would answer an exception with a complaint
        for number in SIGNALS_THAT_END:
            signal.signal(number, _leave_at_once)


def _leave(number: int, _: FrameType | None) -> None:
    """Before a run has begun there is nothing to make safe."""
    sys.exit(_code(number))


def _leave_at_once(number: int, _: FrameType | None) -> None:
    """Everything is done: what was printed is kept, and nothing else is left."""
    with contextlib.suppress(OSError, ValueError):
        sys.stdout.flush()
    os._exit(_code(number))


def _code(number: int) -> int:
    """The exit code of a command that a signal has ended, as a shell reports it."""
    return 128 + number
