"""A worker as its supervisor sees it: the process, the lines it sends, the commands it gets."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import selectors
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path
from typing import IO, Self

from rig.core.errors import LONGEST_REASON, shortened

BEAT, BEAT_EVERY_S = "beat", 1.0
"""Word that informs the worker that the supervisor is alive, and the interval in s."""


class WorkerProcess:
    """A worker of the batch in `folder`; what it prints on its standard error goes to `log`. With
    `waits_because`, a reason, it begins no run before a person has resumed the batch.

    As a context manager it ends when the worker has ended.
    """

    def __init__(self, folder: Path, log: IO[bytes], waits_because: str = ""):
        # As JSON: no argument holds a character 0, which a driver's text may have, or 128 KiB.
        reason = json.dumps(shortened(waits_because, LONGEST_REASON))
        paused = [f"--paused={reason}"] if waits_because else []
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "rig.batch.execute.worker", *paused, "--", str(folder)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            start_new_session=True,  # a terminal's Ctrl-C is the supervisor's to pass on
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._commands, self._events = self._process.stdin, self._process.stdout
        os.set_blocking(self._events.fileno(), False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._events, selectors.EVENT_READ)
        self._buffer = b""
        self._beaten_s = 0.0
        self.pid = self._process.pid

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Close both pipes, from which the worker learns that it has to end, and wait for that."""
        self._selector.close()
        with contextlib.suppress(OSError):  # it has died with a command unread
            self._commands.close()
        self._events.close()
        self._process.wait()

    @property
    def exit_code(self) -> int:
        """Exit code of a worker that has ended, negative for a signal."""
        return self._process.returncode

    def lines(self, within_s: float) -> list[bytes] | None:
        """Return the lines that have arrived, after at most `within_s`; None once the worker has
        closed its output, which it does by ending."""
        if not self._selector.select(within_s):
            return []
        chunk = self._events.read(65536)
        if chunk == b"":
            return None
        *lines, self._buffer = (self._buffer + (chunk or b"")).split(b"\n")
        return lines

    def send(self, command: str) -> None:
        """Send a command. Nothing happens where the worker has died: its output shows that."""
        with contextlib.suppress(OSError):
            self._commands.write(command.encode() + b"\n")
            self._commands.flush()

    def beat(self) -> None:
        """Send a sign of life, if the latest is older than `BEAT_EVERY_S`."""
        if time.monotonic() - self._beaten_s >= BEAT_EVERY_S:
            self._beaten_s = time.monotonic()
            send_beat(self._commands.fileno())

    def kill(self) -> None:
        """End the worker at once; its guard makes the bench safe."""
        self._process.kill()


def send_beat(pipe: int) -> None:
    """Send a sign of life to a worker, unless it has left an earlier one unread: a write to a full
    pipe would wait for a worker that is stopped."""
    with contextlib.suppress(OSError):  # it has died, which is seen at its other end
        unread = struct.unpack("i", fcntl.ioctl(pipe, termios.FIONREAD, struct.pack("i", 0)))[0]
        if unread == 0:
            os.write(pipe, BEAT.encode() + b"\n")
