"""Starting a thread, or saying why the computer has none to give."""

from __future__ import annotations

import threading

from rig.core.errors import RigError


def start_thread(thread: threading.Thread) -> None:
    """Start `thread`; RigError where the computer gives this program no further thread."""
    try:
        thread.start()
    except RuntimeError as error:
        raise RigError(
            f"the thread {thread.name!r} cannot be started: {error}; the limit on processes or "
            "memory is reached",
            "end other programs, or raise the limit (ulimit -u), and start again",
        ) from error
