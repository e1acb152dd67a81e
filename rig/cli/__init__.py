"""The command line: parses, calls, prints; no logic of its own."""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType

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
        from rig.cli.app import perform

        perform(sys.argv[1:])
    except KeyboardInterrupt:
        sys.exit(SIGINT_CODE)


def _leave(number: int, _: FrameType | None) -> None:
    """Before a run has begun there is nothing to make safe."""
    sys.exit(SIGTERM_CODE if number == signal.SIGTERM else SIGHUP_CODE)
