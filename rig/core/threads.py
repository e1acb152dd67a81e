"""Start a thread, or report why it cannot be; wait for threads of packages, but not for ever."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable

from rig.core.errors import RigError

SOON_S, PATIENCE_S = 0.5, 10.0
"""Times in s after which a thread that still runs is named, and after which the wait ends."""


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


def thread_remains(say: Callable[[str], object], patience_s: float = PATIENCE_S) -> bool:
    """Wait for threads that packages have left running; return whether one still runs after
    `patience_s`. `say` takes a warning that names it.

    Python would wait for such a thread for ever. Threads of this program are daemons, for which it
    does not wait. Those of a ThreadPoolExecutor end when Python asks them to, at its end.
    """
    begun_s = time.monotonic()
    pools = getattr(sys.modules.get("concurrent.futures.thread"), "_threads_queues", {})
    not_left = (threading.current_thread(), threading.main_thread(), *pools)
    left = [one for one in threading.enumerate() if one not in not_left and not one.daemon]
    for until_s in (SOON_S, patience_s):
        for thread in left:
            thread.join(max(0.0, begun_s + until_s - time.monotonic()))
        left = [thread for thread in left if thread.is_alive()]
        if not left:
            return False
        if until_s == SOON_S:
            names = ", ".join(repr(thread.name) for thread in left)
            say(
                f"warning: a package has left a thread running ({names}); it is waited for at most "
                f"{patience_s:g} s, then the program ends without it"
            )
    return True
