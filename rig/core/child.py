"""Running one of our modules in a child process, with bounds on what it may use.

For work that may crash or never return inside a library's C code, where no thread and no signal
handler of the calling process can stop it: reading a damaged HDF5 or MATLAB file. The child is
``python -P -m MODULE``: it reads its input from stdin and writes its answer to stdout.
"""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence

MAX_MEMORY_BYTES = 8 << 30
"""Limit on a child's address space: several times the largest dataset that is read in one piece."""
MAX_ANSWER_BYTES = 1 << 30
"""Limit on what a child may write to stdout."""


class ChildError(Exception):
    """The child gave no answer. The message is the reason, in words that can end a sentence.

    `timed_out` is true if it was killed because its time was over.
    """

    def __init__(self, reason: str, *, timed_out: bool = False) -> None:
        super().__init__(reason)
        self.reason = reason
        self.timed_out = timed_out


def run_module(
    module: str,
    arguments: Sequence[str] = (),
    *,
    given: bytes = b"",
    timeout_s: float,
    max_memory_bytes: int = MAX_MEMORY_BYTES,
    max_answer_bytes: int = MAX_ANSWER_BYTES,
) -> bytes:
    """Run ``python -m module arguments``, give it `given` on stdin, and return its stdout.

    Blocks for at most `timeout_s`. The child is killed when its time is over and when this call is
    left by an exception such as KeyboardInterrupt; nothing of it stays behind.

    Raises ChildError if the child did not finish in time, was ended by a signal (a crash, or more
    memory, output or processor time than allowed), or ended with an exit code other than 0; the
    last line that it wrote to stderr is then part of the reason.
    """
    # -P keeps the current folder out of sys.path: a file there named like a module of the standard
    # library would otherwise be imported in its place.
    command = [sys.executable, "-P", "-m", module, *arguments]
    with _memory_file() as answer, _memory_file() as complaint:
        with subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=answer, stderr=complaint
        ) as process:
            try:
                _limit(process.pid, timeout_s, max_memory_bytes, max_answer_bytes)
                process.communicate(given, timeout=timeout_s)
            except subprocess.TimeoutExpired:
                process.kill()
                reason = f"it did not finish within {timeout_s:.0f} s"
                raise ChildError(reason, timed_out=True) from None
            except BaseException:
                process.kill()
                raise
        if process.returncode != 0:
            raise ChildError(_why(process.returncode, _content(complaint)))
        return _content(answer)


@contextlib.contextmanager
def _memory_file() -> Iterator[int]:
    # A file in memory, not a pipe: its size can be limited for the child, and no thread of ours has
    # to empty it while the child runs.
    descriptor = os.memfd_create("child")
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def _limit(pid: int, timeout_s: float, memory_bytes: int, answer_bytes: int) -> None:
    """Limit a child that has just been started and is still loading Python."""
    # If this process is killed, no process is left to kill the child when its time is over. The
    # limit
    # of processor time then ends a child that is caught in an endless loop.
    processor_s = int(2 * timeout_s) + 1
    with contextlib.suppress(ProcessLookupError):  # it has ended already
        for limit, value in (
            (resource.RLIMIT_AS, memory_bytes),
            (resource.RLIMIT_FSIZE, answer_bytes),
            (resource.RLIMIT_CPU, processor_s),
        ):
            resource.prlimit(pid, limit, (value, value))


def _content(descriptor: int) -> bytes:
    size = os.fstat(descriptor).st_size
    content = bytearray()
    while len(content) < size and (read := os.pread(descriptor, 1 << 24, len(content))):
        content += read
    return bytes(content)


def _why(returncode: int, complaint: bytes) -> str:
    lines = complaint.decode(errors="replace").strip().splitlines()
    ended = "error"
    if returncode < 0:
        ended = signal.Signals(-returncode).name
    return ": ".join([ended, *lines[-1:]])
