"""One function for many files: here, by forked processes, or on a Dask cluster."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import platform
import queue
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import (
    BrokenExecutor,
    Future,
    ProcessPoolExecutor,
    as_completed,
    wait,
)
from typing import Any, TypeVar

from rig.core.errors import ConfigurationError, ExitCode, RigError
from rig.core.pool_workers import begin_worker, kill_workers

Item = TypeVar("Item")
Result = TypeVar("Result")

CONNECT_S = 10.0
"""Longest time in s that a cluster's scheduler may take to answer, and to come back."""
WORKERS_S = 30.0
"""Longest time in s that a cluster may be without any worker."""
LOOK_EVERY_S = 0.5
"""Time in s between two looks whether scheduler and workers of a cluster are alive."""
END_S = 3.0
"""Time in s in which processes may end what they do once the command is interrupted."""
CLOSE_S = 3.0
"""Longest time in s that cancelling the rest of a cluster's work may take."""


class WorkerDiedError(RigError):
    """Raised for an item whose process, or one beside it, has died."""

    code = ExitCode.INTERNAL


def processors() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0))


def completed(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    processes: int,
    scheduler: str | None = None,
    *,
    apart: bool = False,
) -> Iterator[tuple[int, Result | RigError]]:
    """Yield number and result of each item as they come; the result is a RigError where its process
    failed.

    Processes are forked, which is what makes them worth it: new ones would import for longer than
    they work. What the function needs is therefore best imported before. One process is not forked
    unless the function is to run `apart`, as it may end its process. With `scheduler` the cluster's
    workers call it: the same program has to be installed there, and the files have to have the same
    names. Raises ConfigurationError where the cluster cannot be reached, and yields a RigError for
    each item that is missing when its scheduler is gone or it has no worker any more.
    """
    processes = min(processes, len(items))
    if scheduler is None and processes <= 1 and not (apart and items):
        yield from enumerate(map(function, items))
        return
    if scheduler is not None:
        yield from _on_cluster(function, items, scheduler)
        return
    with _forked(processes) as executor:
        futures: dict[Future[Result], int] = {
            executor.submit(function, item): number for number, item in enumerate(items)
        }
        try:
            for future in as_completed(futures):
                outcome = _outcome(future)
                yield futures[future], outcome
        except BaseException:
            _end(executor, futures)
            raise


def _end(executor: ProcessPoolExecutor, futures: Iterable[Future[Any]]) -> None:
    """Give up what has not begun, and what does not end in time: a detector may never return, and
    its process does not hear Ctrl-C."""
    running = [future for future in futures if not future.cancel()]
    ended = False
    try:
        ended = not wait(running, END_S).not_done
    finally:  # by a second Ctrl-C as well: no one else would end them
        if not ended:
            kill_workers(executor)


def _outcome(future: Future[Result]) -> Result | RigError:
    try:
        return future.result()
    except BrokenExecutor:
        return WorkerDiedError(
            "the process that read it died",
            "of memory or of a damaged file; --jobs 1 reads one file after the other",
        )
    except Exception as error:  # noqa: BLE001 - one file's trouble, whatever it is, is not all's
        failure = RigError(f"{type(error).__name__}: {error}", code=ExitCode.INTERNAL)
        failure.__cause__ = error
        return failure


def _forked(processes: int) -> ProcessPoolExecutor:
    context = multiprocessing.get_context("fork")
    return ProcessPoolExecutor(processes, context, initializer=begin_worker)


def worker_name() -> str:
    """Return the Dask worker in which this is called, by address and computer; of any other process
    the computer alone."""
    try:
        from distributed import get_worker

        return f"worker {get_worker().address}, {platform.node()}"
    except (ImportError, ValueError):
        return platform.node()


def _on_cluster(
    function: Callable[[Item], Result], items: Sequence[Item], scheduler: str
) -> Iterator[tuple[int, Result | RigError]]:
    """Yield what the cluster's workers return, and a RigError for each item that is still missing
    when there is no one left to wait for."""
    done: queue.SimpleQueue[int] = queue.SimpleQueue()
    with _connected(scheduler) as client:
        alive = _Alive(client)
        futures = {}
        for number, item in enumerate(items):
            # Dask hands one future to all whose keys are alike: the same file may be named twice.
            future = client.submit(function, item, pure=False, retries=0)
            futures[number] = future
            future.add_done_callback(lambda _, number=number: done.put(number))
        while futures:
            try:
                number = done.get(timeout=LOOK_EVERY_S)
            except queue.Empty:
                if (gone := alive.why_gone()) is not None:
                    yield from ((number, gone) for number in futures)
                    return
                continue
            future = futures.pop(number)
            yield number, _of_worker(future)


def _of_worker(future: Any) -> Any:
    """Return the outcome of a Dask future that is done: a result, or a RigError."""
    from distributed import CancelledError
    from distributed.scheduler import KilledWorker

    try:
        return future.result(timeout=CONNECT_S)
    except KilledWorker:
        return WorkerDiedError(
            "the workers that read it died",
            "of memory or of a damaged file; without --scheduler it is read here",
        )
    except CancelledError:
        return RigError("the cluster gave it up", "see whether its scheduler and workers are alive")
    except Exception as error:  # noqa: BLE001 - one file's trouble, whatever it is, is not all's
        failure = RigError(f"{type(error).__name__}: {error}", code=ExitCode.INTERNAL)
        failure.__cause__ = error
        return failure


class _Alive:
    """Whether a cluster can still return results: it has a scheduler, which knows of a worker."""

    def __init__(self, client: Any):
        self._client = client
        self._scheduler_s = self._worker_s = time.monotonic()
        """When the scheduler was last connected, and when it last knew of a worker."""

    def why_gone(self) -> RigError | None:
        """Return why no further result will come, or None. Ask the scheduler for its workers."""
        with contextlib.suppress(Exception):  # one that does not answer is not alive
            client = self._client
            workers = client.sync(client.scheduler.ncores, callback_timeout=CONNECT_S)
            self._scheduler_s = time.monotonic()
            if workers:
                self._worker_s = self._scheduler_s
        now_s = time.monotonic()
        if now_s - self._scheduler_s > CONNECT_S:
            what = f"the cluster's scheduler has been unreachable for {CONNECT_S:g} s"
        elif now_s - self._worker_s > WORKERS_S:
            what = f"the cluster has had no worker for {WORKERS_S:g} s"
        else:
            return None
        return RigError(
            f"not processed: {what}",
            "start scheduler and workers again and repeat the command; saved results are reused",
        )


@contextlib.contextmanager
def _connected(scheduler: str) -> Iterator[Any]:
    """Yield a Dask client. It is left within a bound, whoever is still alive; what was submitted
    and has not begun is given up."""
    try:
        from distributed import Client
        from distributed.comm.addressing import get_address_host_port
    except ImportError as error:
        raise ConfigurationError(
            f"--scheduler {scheduler}: the package distributed is not installed",
            "install tactile-rig[cluster], or leave the option out",
        ) from error
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # failures come as results
    try:
        # A client that fails at the address leaves a half-made one, whose end waits and complains.
        get_address_host_port(scheduler)
        client = Client(scheduler, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        raise ConfigurationError(
            f"--scheduler {scheduler}: no Dask scheduler answers there: {error}",
            "an address is like tcp://127.0.0.1:8786",
        ) from error
    try:
        yield client
    finally:
        with contextlib.suppress(Exception):  # whoever it is that does not hear it is gone
            client.close(timeout=CLOSE_S)
