"""The command line: parses, calls, prints; no logic of its own."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from types import FrameType

from rig.core.imports import importing

SIGINT_CODE, SIGTERM_CODE, SIGHUP_CODE = 130, 143, 129


def main() -> None:
    """Entry point of the command ``rig``."""
    signal.signal(signal.SIGTERM, _leave)
    signal.signal(signal.SIGHUP, _leave)
    # One thread of linear algebra: the products here are small, and a second thread would only
    # disturb the loop that holds a force.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        from rig.cli.streams import outlast_readers

        outlast_readers()
        with importing():
            from rig.cli.beginning import begin_bench

            begun = begin_bench(sys.argv[1:])  # it boots while this process imports
            from rig.cli.app import perform

        perform(sys.argv[1:], begun)
    except KeyboardInterrupt:
        sys.exit(SIGINT_CODE)
    finally:  # what Python still clears away would answer an exception with a complaint
        signal.signal(signal.SIGTERM, _leave_at_once)
        signal.signal(signal.SIGHUP, _leave_at_once)


def _leave(number: int, _: FrameType | None) -> None:
    """Before a run has begun there is nothing to make safe."""
    sys.exit(_code(number))


def _leave_at_once(number: int, _: FrameType | None) -> None:
    """Everything is done: what was printed is kept, and nothing else is left."""
    with contextlib.suppress(OSError, ValueError):
        sys.stdout.flush()
    os._exit(_code(number))


def _code(number: int) -> int:
    return SIGTERM_CODE if number == signal.SIGTERM else SIGHUP_CODE
