"""Work in a process of its own, which is given up if it takes too long.

For work on a disk that may not answer. Nothing can end a thread that waits for such a disk, and a
process with such a thread does not end either, whatever signal it gets. A process that is given up
here is killed, which takes effect once the disk answers again.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import select
import signal
import time
import traceback
from collections.abc import Callable
from typing import NoReturn, TypeVar, cast

from rig.core.errors import RigError

Result = TypeVar("Result")

ENDING_S = 1.0
"""Longest wait in s for the end of a process that has given its answer."""
CHECK_EVERY_S = 0.005
STANDARD_FILES = (0, 1, 2)
_DIED = ("the process that was to do this has died", "give the command again")


class GivenUpError(Exception):
    """Raised where the work was not done in time."""


def result_within(seconds: float, work: Callable[[], Result]) -> Result:
    """Return what `work` returns, or raise what it raises, with the traceback as a note.

    It is done in a copy of this process (fork), which must not have threads that `work` needs; what
    it prints is lost, and what it returns is pickled. Raises GivenUpError after `seconds`. Where
    no process can be made, the work is done in this one.
    """
    answer, sender = os.pipe()
    try:
        pid = os.fork()
    except OSError:
        os.close(answer)
        os.close(sender)
        return work()
    if pid == 0:
        _do(work, sender)
    os.close(sender)
    try:
        content = _all_of(answer, time.monotonic() + seconds)
        ended_s = time.monotonic() + ENDING_S
    except BaseException:
        ended_s = 0.0
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        raise
    finally:
        os.close(answer)
        with contextlib.suppress(ChildProcessError):  # whoever started this one ignores SIGCHLD
            while os.waitpid(pid, os.WNOHANG) == (0, 0) and time.monotonic() < ended_s:
                time.sleep(CHECK_EVERY_S)
    if not content:
        raise RigError(*_DIED)
    try:
        result, error = pickle.loads(content)
    except Exception as broken:
        raise RigError(*_DIED) from broken
    if error is not None:
        raise error
    return cast("Result", result)


def _do(work: Callable[[], object], sender: int) -> NoReturn:
    """Do the work in this process, send its result and end. None of the files that a reader of the
    command's output waits for stays open."""
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a Ctrl-C is the other process's
        nowhere = os.open(os.devnull, os.O_RDWR)
        for file in STANDARD_FILES:
            os.dup2(nowhere, file)
        try:
            answer: tuple[object, Exception | None] = work(), None
        except Exception as error:  # noqa: BLE001 - it is raised in the other process
            error.add_note(traceback.format_exc())
            answer = None, error
        try:
            content = pickle.dumps(answer)
            pickle.loads(content)
        except Exception as error:  # noqa: BLE001 - what cannot be sent is stated in words
            cannot = RigError(f"{type(answer[1] or error).__name__}: {answer[1] or error}")
            content = pickle.dumps((None, cannot))
        with open(sender, "wb") as pipe:
            pipe.write(content)
    finally:
        os._exit(0)


def _all_of(pipe: int, until_s: float) -> bytes:
    """Return what is written to a pipe until it is closed."""
    content = b""
    while select.select([pipe], [], [], max(0.0, until_s - time.monotonic()))[0]:
        if not (chunk := os.read(pipe, 1 << 16)):
            return content
        content += chunk
    raise GivenUpError
