"""Output streams that outlast whoever reads them.

A run writes to a terminal or a pipe that may be gone at any moment. What cannot be shown is lost;
the run goes on and ends in order.
"""

from __future__ import annotations

import contextlib
import io
import locale
import os
import sys

STANDARD_FILES = (0, 1, 2)


class LastingStream(io.TextIOWrapper):
    """Text to a file descriptor; from its first failure on, to nowhere."""

    def __init__(self, file: int):
        super().__init__(
            io.BufferedWriter(io.FileIO(file, "w", closefd=False)),
            encoding=locale.getencoding(),
            errors="backslashreplace",
            line_buffering=True,
        )

    def write(self, text: str) -> int:
        """Write what can be written."""
        try:
            return super().write(text)
        except OSError:
            self._lose()
            return len(text)

    def flush(self) -> None:
        """Flush what can be flushed."""
        try:
            super().flush()
        except OSError:
            self._lose()

    def _lose(self) -> None:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self.fileno())
        os.close(nowhere)


def outlast_readers() -> None:
    """Make stdout and stderr lasting; those that were closed from the start go nowhere, so that no
    file of the run takes their place."""
    for file in STANDARD_FILES:
        try:
            os.fstat(file)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest number that is free: this one
    sys.stdout, sys.stderr = LastingStream(1), LastingStream(2)


def say_at_once(text: str) -> None:
    """A line on stderr from a signal's handler, which may have interrupted another line."""
    with contextlib.suppress(OSError):
        os.write(2, f"\r{text}\n".encode() if os.isatty(2) else f"{text}\n".encode())
