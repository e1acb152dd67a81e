"""Processes that work for a command on a share of its files or trials."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from concurrent.futures import ProcessPoolExecutor


def begin_worker() -> None:
    r"""Leave Ctrl-C and Ctrl-\ to the command, and end with it; called first in each worker."""
    leave_signals_to_the_command()
    threading.Thread(target=_end_with_the_command, daemon=True).start()


def leave_signals_to_the_command() -> None:
    r"""Ignore Ctrl-C and Ctrl-\, which the terminal sends to the command as well; any other signal
    that asks a process to end ends this one."""
    for number in (signal.SIGINT, signal.SIGQUIT):
        signal.signal(number, signal.SIG_IGN)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def kill_workers(pool: ProcessPoolExecutor) -> None:
    """Kill the processes of a pool: what they are asked to do may never return, and they do not
    hear Ctrl-C. The pool has a call for it from Python 3.14 on only."""
    for process in list((pool._processes or {}).values()):
        process.kill()


def _end_with_the_command() -> None:
    command = multiprocessing.parent_process()
    assert command is not None
    command.join()
    os._exit(1)
