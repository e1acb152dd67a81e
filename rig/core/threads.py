"""Start a thread, or report why the computer cannot start one."""

from __future__ import annotations

import threading

from rig.core.errors import RigError


def start_thread(thread: threading.Thread) -> None:
    """Start `thread`. Raises RigError if the computer has reached its limit of threads."""
    try:
        thread.start()
    except RuntimeError as error:
        raise RigError(
            f"the thread {thread.name!r} cannot be started: {error}; the limit on processes or "
            "memory is reached",
            "end other programs, or raise the limit (ulimit -u), and start again",
        ) from error
