"""Which process holds a lock, as the kernel says, and how that process is asked to stop.

Nothing here takes a lock, not even for a moment: a run that wants it would be refused. The kernel's
table (``/proc/locks``) names the process that took a lock; that process is believed only if one of
its own descriptors is that file and carries the lock (``/proc/PID/fdinfo``). A number in a file is
never believed: it may be that of a process that took the number over.

A signal goes through a descriptor of the process (pidfd). It is opened first, and the lock is
looked at again afterwards: so the process that gets the signal is the one that holds the lock.
"""

from __future__ import annotations

import contextlib
import os
import signal
from dataclasses import dataclass
from pathlib import Path

from rig.core.errors import ExitCode, RigError
from rig.run.locks.shared_folder import user_name

LOCKS = Path("/proc/locks")
PROC = Path("/proc")
FEWEST_FIELDS = 8


class NotStoppedError(RigError):
    """Raised where the process could not be asked to stop; nothing was sent."""

    code = ExitCode.USAGE


@dataclass(frozen=True)
class LockHolder:
    """A process that holds the lock of a file."""

    pid: int
    user: str
    own: bool
    """True if this program may look into the process, and has seen the lock there."""


def locked_inodes() -> dict[int, list[int]]:
    """Return the inode numbers that carry an exclusive ``flock``, with the processes that took it.
    The dict is empty where the kernel has no such table."""
    found: dict[int, list[int]] = {}
    try:
        lines = LOCKS.read_text().splitlines()
    except OSError:
        return found
    for line in lines:
        fields = line.replace("-> ", "").split()
        if len(fields) < FEWEST_FIELDS or fields[1] != "FLOCK" or fields[3] != "WRITE":
            continue
        if "->" in line:  # it waits for the lock
            continue
        # The table has the device as well, but the file system's: that of a file differs from it in
        # a subvolume of btrfs and in an overlay.
        with contextlib.suppress(ValueError):
            inode = int(fields[5].rpartition(":")[2])
            found.setdefault(inode, []).append(int(fields[4]))
    return found


def holder_of(path: Path, locked: dict[int, list[int]] | None = None) -> LockHolder | None:
    """Return the living process that holds the lock of a file, None if there is none; of several
    candidates, one in which this program has seen the lock.

    `locked` is an answer of `locked_inodes` for several files. A lock whose process has died, but
    which its guard holds as well, has no holder here.
    """
    try:
        status = path.stat()
    except OSError:
        return None
    pids = (locked_inodes() if locked is None else locked).get(status.st_ino, ())
    found = [holder for pid in pids if (holder := _holder(pid, status)) is not None]
    return max(found, key=lambda holder: holder.own, default=None)


def _holder(pid: int, status: os.stat_result) -> LockHolder | None:
    try:
        user = user_name((PROC / str(pid)).stat().st_uid)
    except OSError:
        return None
    try:
        own = _carries(pid, status)
    except PermissionError:
        return LockHolder(pid, user, False)
    except OSError:
        return None
    return LockHolder(pid, user, True) if own else None


def _carries(pid: int, status: os.stat_result) -> bool:
    """Return whether a descriptor of the process is this file, locked. Raises OSError."""
    for entry in os.scandir(PROC / str(pid) / "fd"):
        with contextlib.suppress(FileNotFoundError):  # it was closed meanwhile
            if os.path.samestat(Path(entry.path).stat(), status) and _locks(pid, entry.name):
                return True
    return False


def _locks(pid: int, descriptor: str) -> bool:
    """Return whether a descriptor of the process carries a lock. Raises OSError."""
    text = (PROC / str(pid) / "fdinfo" / descriptor).read_text()
    return any(
        line.startswith("lock:") and "FLOCK" in line and "WRITE" in line
        for line in text.splitlines()
    )


def holders_by_path(name: str) -> dict[Path, LockHolder]:
    """Return the locked files of this name, by their absolute paths without links, with the
    processes that hold the locks.

    The kernel alone is asked, so it also works where the disk of these files does not answer. Left
    out are processes that this program may not look into, and those that see other file systems (in
    a container): with them the same path may be a different file.
    """
    found: dict[Path, LockHolder] = {}
    for pid in {pid for pids in locked_inodes().values() for pid in pids}:
        process = PROC / str(pid)
        with contextlib.suppress(OSError):
            if (process / "ns/mnt").readlink() != (PROC / "self/ns/mnt").readlink():
                continue
            uid = process.stat().st_uid
            for entry in os.scandir(process / "fd"):
                with contextlib.suppress(FileNotFoundError):  # it was closed meanwhile
                    path = Path(entry.path).readlink()
                    if path.name == name and _locks(pid, entry.name):
                        # The name of a user may be asked of a server: for a holder only.
                        found[path] = LockHolder(pid, user_name(uid), True)
    return found


def holder_by_path(path: Path) -> LockHolder | None:
    """Return the process that holds the lock of a file, as `holder_of` does, without the disk."""
    return holders_by_path(path.name).get(path)


def ask_to_stop(
    path: Path, number: signal.Signals = signal.SIGTERM, *, by_path: bool = False
) -> LockHolder:
    """Send a signal to the process that holds the lock of a file, and to no other; return it.

    With `by_path` the disk of the file is not asked. Raises NotStoppedError if no living process
    holds it, if it is another user's, or if it let the lock go before the signal was sent.
    """
    find = holder_by_path if by_path else holder_of
    holder = find(path)
    if holder is None:
        raise NotStoppedError(f"no process holds {path}: the run has ended or died")
    if not holder.own:
        raise NotStoppedError(
            f"the run belongs to {holder.user} (process {holder.pid})",
            f"only {holder.user} and an administrator can end it",
        )
    try:
        process = os.pidfd_open(holder.pid)
    except OSError as error:
        raise NotStoppedError(f"process {holder.pid} has ended: {error.strerror}") from error
    try:
        # Only now is the number bound to a process: what held the lock a moment ago may be gone.
        if find(path) != holder:
            raise NotStoppedError(f"process {holder.pid} does not hold {path} any more")
        signal.pidfd_send_signal(process, number)
    except ProcessLookupError as error:
        raise NotStoppedError(f"process {holder.pid} has ended") from error
    except PermissionError as error:
        raise NotStoppedError(
            f"process {holder.pid} is {holder.user}'s: {error.strerror}"
        ) from error
    finally:
        os.close(process)
    return holder


def lives(pid: int) -> bool:
    """Return whether a process runs; one that has ended and was not asked for yet does not."""
    try:
        # A long name of a process may end within a character.
        status = (PROC / str(pid) / "stat").read_text(errors="replace")
    except OSError:
        return False
    return status.rpartition(")")[2].split()[0] not in "ZX"


def is_stopped(pid: int) -> bool:
    """Return whether a process was stopped, by Ctrl-Z for instance: it handles no signal."""
    with contextlib.suppress(OSError):
        status = (PROC / str(pid) / "stat").read_text(errors="replace")
        return status.rpartition(")")[2].split()[0] in "Tt"
    return False


def guard_of(pid: int) -> int | None:
    """Return the process id of a run's guard, None if it has none that can be seen."""
    children: list[int] = []
    with contextlib.suppress(OSError, ValueError):
        for task in os.scandir(PROC / str(pid) / "task"):
            children += map(int, (Path(task.path) / "children").read_text().split())
    for child in children:
        with contextlib.suppress(OSError):
            if b"rig.run.making_safe.guard" in (
                PROC / str(child) / "cmdline"
            ).read_bytes() and lives(child):
                return child
    return None


def lock_file(name: str) -> Path:
    """Return the lock file of an instrument's address (`rig.run.locks.lock.address_names`). Raises
    ConfigurationError if there is no folder for locks that can be trusted."""
    from rig.run.locks.lock import SUFFIX
    from rig.run.locks.shared_folder import SharedFolder

    with SharedFolder() as folder:
        return folder.path / (name + SUFFIX)
