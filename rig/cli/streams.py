"""Output streams that work on after their reader has closed them.

A run writes to a terminal or a pipe that may close at any moment. Output is then lost; the run
continues and ends in order.
"""

from __future__ import annotations

import contextlib
import io
import locale
import logging
import os
import queue
import select
import sys
import threading
from collections.abc import Callable
from typing import NoReturn, Self

from rig.core.threads import start_thread

STANDARD_FILES = (0, 1, 2)
LAST_LINES_S = 2.0
"""Longest time in s that is waited for the last lines: a reader that works has them by then."""
ERASE_LINE = "\x1b[2K"
"""What erases a terminal's line."""


class LastingStream(io.TextIOWrapper):
    """Text stream to a file descriptor that drops everything after its first failure."""

    def __init__(self, file: int):
        super().__init__(
            io.BufferedWriter(io.FileIO(file, "w", closefd=False)),
            encoding=locale.getencoding(),
            errors="backslashreplace",
            line_buffering=True,
        )
        self.failure: OSError | None = None
        """Reason why output was lost first; None if nothing was lost."""

    def write(self, text: str) -> int:
        """Write the text if the descriptor still works."""
        try:
            return super().write(text)
        except OSError as error:
            self._lose(error)
            return len(text)

    def flush(self) -> None:
        """Flush the text if the descriptor still works."""
        try:
            super().flush()
        except OSError as error:
            self._lose(error)

    def _lose(self, error: OSError) -> None:
        self.failure = self.failure or error
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self.fileno())
        os.close(nowhere)


def outlast_readers() -> None:
    """Install safe stdout and stderr. Standard files that were closed from the start are
    /dev/null, so that no file of the run gets their descriptor; a stdin that was closed is one that
    has ended."""
    for file in STANDARD_FILES:
        try:
            os.fstat(file)
        except OSError:
            os.open(
                os.devnull, os.O_RDWR
            )  # open() returns the lowest free descriptor, which is this one.
    if sys.stdin is None:  # closed before Python started
        sys.stdin = open(0, closefd=False, encoding=locale.getencoding())  # noqa: SIM115
    sys.stdout, sys.stderr = LastingStream(1), LastingStream(2)


def code_after_output(code: str | int | None) -> str | int | None:
    """Return the exit code of a command once everything is printed: 1 instead of 0, with a line
    on stderr, where stdout could not be written.

    A reader that has closed the pipe, such as ``head``, has what it wanted: that is no failure.
    """
    assert isinstance(sys.stdout, LastingStream)
    sys.stdout.flush()
    failure = sys.stdout.failure
    if failure is None or isinstance(failure, BrokenPipeError):
        return code
    say_at_once(
        f"error: the output could not be written to stdout: {failure.strerror}; what the command "
        "has saved is complete, only the printed output is lost"
    )
    return code or 1


class LinesInTurn:
    """Prints lines for a person in a thread of its own and in their order, so that a terminal that
    is held (Ctrl-S) or a full pipe keeps no one waiting. A context manager; at its end the lines
    that are left are waited for, at most `LAST_LINES_S`."""

    def __init__(self, show: Callable[[str], None]):
        """`show` prints one line. Raises RigError if no thread can be started."""
        self._show = show
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="lines", daemon=True)
        start_thread(self._thread)

    def say(self, text: str) -> None:
        """Print a line after the earlier ones; returns at once."""
        self._lines.put(text)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._lines.put(None)
        self._thread.join(LAST_LINES_S)

    def _run(self) -> None:
        while (text := self._lines.get()) is not None:
            with contextlib.suppress(Exception):  # the lines that follow are still wanted
                self._show(text)


def leave_at_once(code: int) -> NoReturn:
    """End the process with an exit code although threads of packages run; what was printed and
    logged is complete."""
    code = int(code_after_output(code) or 0)
    sys.stderr.flush()
    logging.shutdown()
    os._exit(code)


def say_at_once(text: str) -> None:
    """Write a line to stderr from a signal's handler, which may have interrupted another line; on a
    terminal a progress bar, which is erased.

    A terminal that is held (Ctrl-S) and a full pipe do not get the line: a handler that waited for
    them would keep the run from ending.
    """
    with contextlib.suppress(OSError):
        if not select.select((), (2,), (), 0.0)[1]:
            return
        erased = f"\r{ERASE_LINE}" if os.isatty(2) else ""
        os.write(2, f"{erased}{text}\n".encode())
