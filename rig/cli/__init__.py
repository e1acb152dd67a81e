"""The command line: parses options, calls the library, prints results; it has no further logic."""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import sys
from types import FrameType

SIGNALS_THAT_END = (signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
"""Signals that end a command, in addition to SIGINT, which Python turns into KeyboardInterrupt."""


def main() -> None:
    """Run the command ``rig`` with the arguments of this process, and end it with an exit code."""
    atexit.register(_ignore_signals)  # Registered first, so it is called last.
    for number in _signals_that_end():
        signal.signal(number, _leave)
    # One thread of linear algebra: the products here are small, and a second thread would only
    # disturb the loop that holds a force.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        try:
            from rig.cli.streams import code_after_output, outlast_readers

            outlast_readers()
            from rig.cli.app import perform

            try:
                perform(sys.argv[1:])
            except SystemExit as ended:
                ended.code = code_after_output(ended.code)
                raise
        finally:  # An exception while Python shuts down would print a traceback.
            for number in (signal.SIGINT, *_signals_that_end()):
                signal.signal(number, _leave_at_once)
    except KeyboardInterrupt:  # It may also come within the lines of `finally`.
        sys.exit(_code(signal.SIGINT))


def _signals_that_end() -> list[signal.Signals]:
    """Return `SIGNALS_THAT_END`, without SIGHUP where ``nohup`` has had it ignored."""
    ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    return [one for one in SIGNALS_THAT_END if not (ignored and one == signal.SIGHUP)]


def _leave(number: int, _: FrameType | None) -> None:
    """Leave before a run has begun, when there is nothing to make safe."""
    sys.exit(_code(number))


def _leave_at_once(number: int, _: FrameType | None) -> None:
    """Leave at once after everything is done; output that was printed is flushed."""
    with contextlib.suppress(OSError, ValueError):
        sys.stdout.flush()
    os._exit(_code(number))


def _ignore_signals() -> None:
    """Ignore further signals. Python restores their default action as the last thing it does, and a
    run that was made safe and saved would then end as if it had been killed."""
    for number in (signal.SIGINT, *SIGNALS_THAT_END):
        signal.signal(number, signal.SIG_IGN)


def _code(number: int) -> int:
    """Return the exit code of a command that a signal has ended, as a shell reports it."""
    return 128 + number
