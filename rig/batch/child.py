"""A program that works in the background of a batch, within a time limit.

The batch never waits for it: it asks `TimedChild.poll` now and then. Whatever the program does
(hang, die, write without end), the batch loses at most the work that it was given.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import IO, Literal

OUTPUT_BYTES = 1 << 16
"""How much is read of a child's output at each poll, and how much of its end is returned. A child
that writes faster waits for its pipe and meets its time limit."""
KILLED_S = 5.0
"""How long a killed process may take to disappear before it is left to the system."""


@dataclass(frozen=True)
class ChildResult:
    """How a child ended."""

    failure: str
    """Empty where its exit code was 0; else the exit code, the signal or the time limit."""
    output: str
    """The end of what it wrote to the pipe that is read."""


class TimedChild:
    """A child process in a session of its own: no Ctrl-C of the terminal reaches it, and it can be
    killed together with everything that it has started."""

    def __init__(
        self,
        program: Sequence[str],
        longest_s: float,
        *,
        given: str = "",
        read: Literal["stdout", "stderr"] = "stdout",
        other: int | IO[bytes] = subprocess.DEVNULL,
        environment: Mapping[str, str] | None = None,
        inherited: Sequence[int] = (),
    ):
        """Start `program` with the text `given` on its standard input. `read` names the output that
        is read, `other` is where the other one goes; `inherited` are file descriptors that stay
        open in it. OSError where it cannot be started."""
        with tempfile.TemporaryFile() as text:  # a pipe could fill up while the program hangs
            text.write(given.encode(errors="replace"))
            text.seek(0)
            self._process = subprocess.Popen(
                program,
                stdin=text,
                stdout=subprocess.PIPE if read == "stdout" else other,
                stderr=subprocess.PIPE if read == "stderr" else other,
                env=None if environment is None else {**os.environ, **environment},
                pass_fds=inherited,
                start_new_session=True,
            )
        pipe = self._process.stdout if read == "stdout" else self._process.stderr
        assert pipe is not None
        os.set_blocking(pipe.fileno(), False)
        self._pipe = pipe
        self._output = b""
        self._longest_s = longest_s
        self._deadline_s = time.monotonic() + longest_s

    @property
    def pid(self) -> int:
        """The process id, which is that of its session, too."""
        return self._process.pid

    def poll(self) -> ChildResult | None:
        """How it ended, or None while it is at work. At its time limit it is killed. After a result
        there is nothing more to ask."""
        code = self._process.poll()
        self._read()
        if code is not None:
            self._read()  # what came between the last look and its end
            failure = f"signal {-code}" if code < 0 else f"exit code {code}" if code else ""
        elif time.monotonic() >= self._deadline_s:
            self.kill()
            failure = f"no end after {self._longest_s:g} s, killed"
        else:
            return None
        self._pipe.close()
        return ChildResult(failure, self._output.decode(errors="replace"))

    def kill(self) -> None:
        """End it and all processes of its session at once."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(KILLED_S)

    def _read(self) -> None:
        with contextlib.suppress(BlockingIOError):
            chunk = os.read(self._pipe.fileno(), OUTPUT_BYTES)
            self._output = (self._output + chunk)[-OUTPUT_BYTES:]
