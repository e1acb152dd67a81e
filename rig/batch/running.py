"""Batches that run now, as the kernel knows their supervisors, and requests to them."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from rig.batch.folder import BatchFolder
from rig.core.errors import ConfigurationError
from rig.run.locks.lock_holder import holder_of


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
