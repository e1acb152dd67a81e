"""Child processes with bounds on what they may use.

For work that may crash, never return or write without end: reading a damaged HDF5 or MATLAB file,
where no thread and no signal handler of the calling process can interrupt a library's C code, or a
program that the user has named. `run_module` waits for one of our modules; a `Child` is polled.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import IO

MAX_MEMORY_BYTES = 8 << 30
"""Limit on a child's address space: several times the largest dataset that is read in one piece."""
MAX_ANSWER_BYTES = 1 << 30
"""Limit on the answer of a child that is waited for."""
TAIL_BYTES = 1 << 16
"""Number of bytes of the end of an output that are returned by default; the others are dropped."""
PIPE_BYTES = 1 << 20
"""Size of a pipe: what a child can write between two polls. It then waits for its pipe."""
WAS_FULL_BYTES = 1 << 16
"""A pipe from which so much is read at once may have been full: the system may allow no larger."""
CHUNK_BYTES = 2 * PIPE_BYTES
"""More than a pipe holds: one read empties it."""
READ_S = 0.02
"""Longest time in s for which one poll reads what a child continues to write."""
CLOSED_WAIT_S = 0.01
"""Interval at which a child is checked that has closed its outputs."""
CHECK_EVERY_S = 0.1
"""Interval in s at which a child is checked that has closed its outputs or handed them on."""
KILLED_S = 5.0
"""Longest time in s in which a killed process may disappear; then it is left to the system."""


@dataclass(frozen=True)
class ChildResult:
    """The result of a child process."""

    failure: str
    """Empty where its exit code was 0; else the exit code, the signal or the time limit."""
    output: bytes
    """The end of what it wrote to stdout."""
    complaint: str = ""
    """The end of what it wrote to stderr, if that was read."""
    timed_out: bool = False
    """True if it was killed because its time was over."""

    @property
    def reason(self) -> str:
        """Return the reason of the failure, with the last line that the child has written."""
        return ": ".join([self.failure, *self.complaint.strip().splitlines()[-1:]])


class ChildError(Exception):
    """The child gave no answer. The message is the reason, in words that can end a sentence.

    `timed_out` is true if it was killed because its time was over.
    """

    def __init__(self, reason: str, *, timed_out: bool = False) -> None:
        super().__init__(reason)
        self.reason = reason
        self.timed_out = timed_out


class Child:
    """A child process in a session of its own: no Ctrl-C of the terminal reaches it, and it can be
    killed together with everything that it has started."""

    def __init__(
        self,
        program: Sequence[str],
        timeout_s: float,
        *,
        given: bytes = b"",
        longest_output: int = TAIL_BYTES,
        stderr: int | IO[bytes] = subprocess.PIPE,
        environment: Mapping[str, str] | None = None,
        inherited: Sequence[int] = (),
    ):
        """Start `program` with `given` on its standard input.

        `longest_output` is how many bytes of stdout are returned, the last ones; `stderr` is where
        that goes if it is not to be read; `environment` is added to this process's; `inherited` are
        file descriptors that stay open in it. Raises OSError where it cannot be started.
        """
        stdin = os.memfd_create("given")  # a pipe could fill up while the program hangs
        try:
            _write_all(stdin, given)
            self._process = subprocess.Popen(
                program,
                stdin=stdin,
                stdout=subprocess.PIPE,
                stderr=stderr,
                env=None if environment is None else {**os.environ, **environment},
                pass_fds=inherited,
                start_new_session=True,
            )
        finally:
            os.close(stdin)
        self._output = _Output(self._process.stdout, longest_output)
        self._complaint = _Output(self._process.stderr, TAIL_BYTES)
        self._timeout_s = timeout_s
        self._deadline_s = time.monotonic() + timeout_s

    @property
    def pid(self) -> int:
        """The process id, which is that of its session, too."""
        return self._process.pid

    @property
    def output_bytes(self) -> int:
        """Return the number of bytes written to stdout so far."""
        return self._output.bytes

    def poll(self) -> ChildResult | None:
        """Return how it ended, or None while it is at work; returns at once, or after `READ_S` for
        each output that it fills. At its time limit it is killed. What it has started and left
        behind in its session is ended with it. After a result there is nothing more to ask."""
        code, timed_out = self._exit_code(), False  # First: what it has written is then there.
        self._output.read()
        self._complaint.read()
        if code is not None:
            failure = _why(code)
        elif time.monotonic() >= self._deadline_s:
            self.kill()
            failure, timed_out = f"it did not finish within {self._timeout_s:g} s", True
        else:
            return None
        self._output.close()
        self._complaint.close()
        complaint = self._complaint.end.decode(errors="replace")
        return ChildResult(failure, self._output.end, complaint, timed_out)

    def wait(self, at_most_s: float) -> None:
        """Wait until it writes something, or may have ended, no longer than this."""
        pipes = [output.pipe for output in (self._output, self._complaint) if output.pipe]
        if pipes:
            select.select(pipes, [], [], at_most_s)
        else:
            time.sleep(min(at_most_s, CLOSED_WAIT_S))

    def _exit_code(self) -> int | None:
        """Return its exit code once it has ended, with all processes of its session."""
        if self._process.returncode is None:
            ended = os.WEXITED | os.WNOHANG | os.WNOWAIT
            if os.waitid(os.P_PID, self.pid, ended) is None:
                return None
            # No one has asked for its exit code yet, so its number still is that of its session.
            os.killpg(self.pid, signal.SIGKILL)
        return self._process.poll()

    def kill(self) -> None:
        """End it and all processes of its session at once."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(KILLED_S)


def run_module(
    module: str,
    arguments: Sequence[str] = (),
    *,
    given: bytes = b"",
    timeout_s: float,
    max_memory_bytes: int = MAX_MEMORY_BYTES,
    max_answer_bytes: int = MAX_ANSWER_BYTES,
) -> bytes:
    """Run ``python -P -m module arguments``, give it `given` on stdin, and return its stdout.

    Blocks for at most `timeout_s`. The child is killed when its time is over and when this call is
    left by an exception such as KeyboardInterrupt; nothing of it stays behind.

    Raises ChildError if the child could not be started, did not finish in time, wrote more than
    `max_answer_bytes`, was ended by a signal (a crash, or more memory or processor time than
    allowed), or ended with an exit code other than 0; the last line that it wrote to stderr is then
    part of the reason.
    """
    # -P keeps the current folder out of sys.path: a file there named like a module of the standard
    # library would otherwise be imported in its place.
    program = [sys.executable, "-P", "-m", module, *arguments]
    try:
        child = Child(
            _limited(program, timeout_s, max_memory_bytes),
            timeout_s,
            given=given,
            longest_output=max_answer_bytes,
        )
    except OSError as error:
        raise ChildError(f"it could not be started: {error}") from None
    ended = None
    try:
        while ended is None and child.output_bytes <= max_answer_bytes:
            child.wait(CHECK_EVERY_S)
            ended = child.poll()
    finally:
        if ended is None:
            child.kill()
    if ended is None or child.output_bytes > max_answer_bytes:
        raise ChildError(f"its answer is longer than {max_answer_bytes} bytes")
    if ended.failure:
        raise ChildError(ended.reason, timed_out=ended.timed_out)
    return ended.output


class _Output:
    """The end of what a child writes to a pipe."""

    def __init__(self, pipe: IO[bytes] | None, longest: int):
        self.pipe, self._longest = pipe, longest
        """None where it is not read, and after its end."""
        self._content = bytearray()
        self.bytes = 0
        if pipe is not None:
            os.set_blocking(pipe.fileno(), False)
            with contextlib.suppress(OSError):  # the user's limit is reached: it stays smaller
                fcntl.fcntl(pipe.fileno(), fcntl.F_SETPIPE_SZ, PIPE_BYTES)

    @property
    def end(self) -> bytes:
        """The last bytes of it."""
        return bytes(self._content)

    def read(self) -> None:
        """Read what is there; from a child that had to wait for its pipe, also what it writes
        within `READ_S`."""
        until_s, taken = time.monotonic() + READ_S, 0
        while self.pipe is not None:
            try:
                chunk = os.read(self.pipe.fileno(), CHUNK_BYTES)
            except BlockingIOError:
                left_s = max(0.0, until_s - time.monotonic())
                if taken < WAS_FULL_BYTES or not select.select([self.pipe], [], [], left_s)[0]:
                    return
                continue
            if not chunk:
                self.close()
                return
            taken += len(chunk)
            self.bytes += len(chunk)
            self._content += chunk
            del self._content[: -self._longest]
            if time.monotonic() > until_s:
                return

    def close(self) -> None:
        """Close the pipe."""
        if self.pipe is not None:
            self.pipe.close()
            self.pipe = None


def _write_all(descriptor: int, content: bytes) -> None:
    view = memoryview(content)
    while view:
        view = view[os.write(descriptor, view) :]
    os.lseek(descriptor, 0, os.SEEK_SET)


def _limited(program: Sequence[str], timeout_s: float, memory_bytes: int) -> list[str]:
    """Return the command that runs a program with bounds on its memory and its processor time."""
    # If this process is killed, no process is left to kill the child when its time is over. The
    # limit of processor time then ends a child that is caught in an endless loop. The shell sets
    # both before Python is loaded: set from here, they might come late on a busy computer. A lower
    # limit that holds already stays.
    processor_s = int(2 * timeout_s) + 1
    limits = f"ulimit -v {memory_bytes // 1024}; ulimit -t {processor_s}"
    return ["/bin/sh", "-c", f'{{ {limits}; }} 2>/dev/null; exec "$0" "$@"', *program]


def _why(code: int) -> str:
    """Return an exit code in words; empty for 0."""
    if code < 0:
        return signal.Signals(-code).name
    return f"exit code {code}" if code else ""
