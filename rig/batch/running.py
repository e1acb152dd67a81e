"""Batches that run now, as the kernel knows their supervisors, and requests to them."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from rig.batch.folder import BatchFolder
from rig.batch.queue_file import QueueWriteError
from rig.core.apart import GivenUpError, result_within
from rig.core.errors import ConfigurationError
from rig.run.locks.lock_holder import (
    LockHolder,
    NotStoppedError,
    ask_to_stop,
    holder_of,
    holders_by_path,
    is_stopped,
)

LINKS_S = 2.0
"""Longest time in s for resolving the links in the path of a folder."""
REQUEST_S = 2.0
"""Longest time in s that a request may take where a stop must not wait for the disk."""


def batch_of(journal: Path) -> BatchFolder | None:
    """Return the batch that runs now and takes the run of this journal; None if there is none."""
    folder = BatchFolder(journal.parent.parent)
    return folder if folder.queue.exists() and is_running(folder) else None


def is_running(folder: BatchFolder) -> bool:
    """Return whether the kernel knows a supervisor of the batch; no lock is taken for it."""
    return holder_of(folder.supervisor_lock) is not None


def require_own(folder: BatchFolder) -> None:
    """Raise ConfigurationError if the batch runs and is another user's, also where its folder may
    be written by all."""
    # Some systems hide a process's descriptors from its own user: the lock file shows whose it is.
    with contextlib.suppress(OSError):
        if folder.supervisor_lock.stat().st_uid == os.geteuid():
            return
    holder = holder_of(folder.supervisor_lock)
    if holder is not None and not holder.own:
        raise ConfigurationError(
            f"the batch {folder.path.name} belongs to {holder.user} (process {holder.pid})",
            f"only {holder.user} and an administrator can stop, pause or resume it",
        )


def ask_batch(folder: BatchFolder, request: str) -> str:
    """Leave a request for the supervisor of a batch; return the batch's name. Raises
    ConfigurationError if it does not run, or is another user's."""
    from rig.batch.queue import Queue

    if not is_running(folder):
        raise ConfigurationError(f"the batch {folder.path.name} is not running", "stop the run")
    require_own(folder)
    with Queue.open(folder.queue) as queue:
        queue.add_request(request)
        return queue.meta("name")


def stop_batch_of(journal: Path) -> None:
    """Stop the batch at once that takes the run of this journal, if one does, also where the disk
    does not answer or takes no request. Raises RigError if it could not be asked. `journal` is the
    path without links."""
    try:
        result_within(REQUEST_S, lambda: _ask_batch_of(journal))
    except (GivenUpError, OSError, QueueWriteError):
        batch = BatchFolder(journal.parent.parent)
        locks = holders_by_path(batch.supervisor_lock.name)
        if batch.supervisor_lock in locks:  # else the run, which is asked itself, is of no batch
            _signal(batch, locks[batch.supervisor_lock])


def _ask_batch_of(journal: Path) -> None:
    if (batch := batch_of(journal)) is not None:
        ask_batch(batch, "stop-now")


def stop_without_the_disk(place: Path) -> BatchFolder:
    """Stop the batch at once that runs in a folder, or in a folder of results, whose disk does not
    answer; return it.

    Raises NotStoppedError if no batch of this user is known to run there, or several are.
    """
    place = Path(os.path.abspath(place))  # noqa: PTH100 - `resolve` asks the disk
    with contextlib.suppress(GivenUpError):  # on the disk itself there may be links as well
        place = result_within(LINKS_S, place.resolve)
    locks = holders_by_path(BatchFolder(place).supervisor_lock.name)
    running = [lock.parent for lock in locks if place in (lock.parent, lock.parent.parent)]
    if len(running) > 1:
        raise NotStoppedError(
            f"{len(running)} batches run there: {', '.join(map(str, running))}",
            "name the folder of one",
        )
    if not running:
        raise NotStoppedError(
            f"no process of yours on this computer is known to run a batch in {place}",
            "press Ctrl-C in the terminal of the batch, or run: rig make-safe",
        )
    batch = BatchFolder(running[0])
    _signal(batch, locks[batch.supervisor_lock])
    return batch


def _signal(batch: BatchFolder, supervisor: LockHolder) -> None:
    """Send the signal that stops a batch at once to the process that can act on it."""
    # One that was stopped passes nothing on; its worker still takes the run under way.
    lock = batch.worker_lock if is_stopped(supervisor.pid) else batch.supervisor_lock
    ask_to_stop(lock, by_path=True)
