"""What code of another package prints must not mix with the data that a command prints."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
from collections.abc import Iterator

_C = ctypes.CDLL(None)


@contextlib.contextmanager
def quiet_stdout() -> Iterator[None]:
    """Send to stderr what code of another package prints or writes to descriptor 1: stdout carries
    the command's data."""
    with contextlib.redirect_stdout(sys.stderr):
        try:
            # One terminal, or nowhere, as beside a trial: nothing has to be kept apart.
            stdout = None if os.path.sameopenfile(1, 2) else os.dup(1)
        except OSError:  # one of them is closed
            stdout = None
        if stdout is None:
            yield
            return
        try:
            os.dup2(2, 1)
            try:
                yield
            finally:
                _C.fflush(None)  # what C has not written yet would follow on stdout
        finally:
            os.dup2(stdout, 1)
            os.close(stdout)
