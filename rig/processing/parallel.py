"""One function for many files: here, by forked processes, or on a Dask cluster."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import (
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    as_completed,
)
from typing import TypeVar

from rig.core.errors import ConfigurationError, ExitCode, RigError

Item = TypeVar("Item")
Result = TypeVar("Result")

CONNECT_S = 10.0
"""Longest time in s that a cluster's scheduler may take to answer."""


def processors() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0))


def completed(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    processes: int,
    scheduler: str | None = None,
) -> Iterator[tuple[int, Result | RigError]]:
    """Yield number and result of each item as they come; a RigError where its process failed.

    Processes are forked, which is what makes them worth it: new ones would import for longer than
    they work. What the function needs is therefore best imported before. With `scheduler` the
    cluster's workers call it: the same program has to be installed there, and the files have to
    have the same names. ConfigurationError where the cluster cannot be reached.
    """
    processes = min(processes, len(items))
    if scheduler is None and processes <= 1:
        yield from enumerate(map(function, items))
        return
    with _forked(processes) if scheduler is None else _cluster(scheduler) as executor:
        futures: dict[Future[Result], int] = {
            executor.submit(function, item): number for number, item in enumerate(items)
        }
        try:
            for future in as_completed(futures):
                outcome = _outcome(future)
                yield futures[future], outcome
        finally:
            for future in futures:
                future.cancel()


def _outcome(future: Future[Result]) -> Result | RigError:
    try:
        return future.result()
    except BrokenExecutor:
        return RigError(
            "the process that read it died",
            "of memory or of a damaged file; --jobs 1 reads one file after the other",
            ExitCode.INTERNAL,
        )
    except CancelledError:
        return RigError("the cluster gave it up", "see whether its scheduler and workers are alive")
    except Exception as error:  # noqa: BLE001 - one file's trouble, whatever it is, is not all's
        failure = RigError(f"{type(error).__name__}: {error}", code=ExitCode.INTERNAL)
        failure.__cause__ = error
        return failure


def _forked(processes: int) -> Executor:
    context = multiprocessing.get_context("fork")
    return ProcessPoolExecutor(processes, context, initializer=_serve)


def _serve() -> None:
    """A worker leaves Ctrl-C and Ctrl-\\ to the command, and does not outlive it."""
    for number in (signal.SIGINT, signal.SIGQUIT):  # the terminal sends them to both
        signal.signal(number, signal.SIG_IGN)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    threading.Thread(target=_end_with_the_command, daemon=True).start()


def _end_with_the_command() -> None:
    command = multiprocessing.parent_process()
    assert command is not None
    command.join()
    os._exit(1)


@contextlib.contextmanager
def _cluster(scheduler: str) -> Iterator[Executor]:
    try:
        from distributed import Client
    except ImportError as error:
        raise ConfigurationError(
            f"--scheduler {scheduler}: the package distributed is not installed",
            "install tactile-rig[cluster], or leave the option out",
        ) from error
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # failures come as results
    try:
        client = Client(scheduler, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise ConfigurationError(
            f"--scheduler {scheduler}: no Dask scheduler answers there: {error}",
            "an address is like tcp://127.0.0.1:8786",
        ) from error
    with client, client.get_executor(pure=False, retries=0) as executor:
        yield executor
