"""Locks that allow one program at a time on an instrument and end with the program.

Two runs on one bench would stop each other's stages merely by connecting. Therefore every
instrument's address has a lock file in the computer's temporary folder, where all users find the
same one, and a program locks those of its bench from before it connects until it is done. The locks
belong to the kernel (``flock``): they end with the processes that hold them, however those end; the
files stay. A run's guard holds the locks as well, and acts under them when the run has died.

The address is what the bench file says; one instrument under two names is not recognised.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import json
import os
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from rig.core.errors import ConfigurationError

if TYPE_CHECKING:
    from rig.bench.plan import BenchPlan, Restable

ADDRESS = ("resource", "host", "port", "unit_id")
"""Settings of a driver that form the address of an instrument."""
EVERYBODY = 0o666
ENTRY_BYTES = 4096
GUARD_S = 10.0
"""How long a new run waits for the guard of a dead one."""
LOOK_EVERY_S = 0.1


class BenchLock:
    """The locks on all instruments of a bench; a context manager that releases them at its end.

    Raises ConfigurationError if another program holds one of them, or if a lock file cannot be
    made.
    """

    def __init__(self, plan: BenchPlan):
        self._entry = {
            "bench": plan.settings.name,
            "pid": os.getpid(),
            "since": time.strftime("%Y-%m-%d %H:%M:%S"),
        }
        self._files: list[int] = []
        try:
            for path in lock_files(plan):
                self._files.append(_open(path))
                _take(self._files[-1], path)
        except BaseException:
            self.release()
            raise
        self._write()

    @property
    def files(self) -> tuple[int, ...]:
        """File descriptors of the locks, for a process that shall hold them as well."""
        return tuple(self._files)

    def note_run(self, journal: Path) -> None:
        """Write the run's journal into the lock files, for the message of a program that finds them
        locked."""
        self._entry["file"] = str(journal.resolve())
        self._write()

    def release(self) -> None:
        """Release all locks."""
        while self._files:
            os.close(self._files.pop())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def _write(self) -> None:
        text = json.dumps(self._entry).encode()
        for file in self._files:
            with contextlib.suppress(OSError):  # On a full disk the lock works without its text.
                os.ftruncate(file, 0)
                os.pwrite(file, text, 0)


def in_use(plan: BenchPlan | Restable) -> str | None:
    """Return which program uses an instrument of this bench, in words; None if none does."""
    for path in lock_files(plan):
        file = _open(path)
        try:
            if not _locked(file):
                return _in_use(_entry_of(file), path).message
        finally:
            os.close(file)
    return None


def lock_files(plan: BenchPlan | Restable) -> tuple[Path, ...]:
    """Return the lock file of every address of a bench, each once, in one order for all
    programs."""
    addresses = {address_of(part.settings.model_dump()) for part in plan.instruments}
    digests = sorted(hashlib.sha256(address.encode()).hexdigest()[:16] for address in addresses)
    return tuple(Path(tempfile.gettempdir()) / f"tactile-rig-{digest}.lock" for digest in digests)


def address_of(settings: dict[str, Any]) -> str:
    """Return the address of the link of an instrument, from its driver's settings."""
    # A link has one user, whichever instrument on it is addressed.
    if isinstance(line := settings.get("port"), str):
        return line.upper()
    return " ".join(str(settings[name]).upper() for name in ADDRESS if name in settings)


def _open(path: Path) -> int:
    """Open the lock file, and create it if there is none; another user may have created it."""
    try:
        while True:
            with contextlib.suppress(FileNotFoundError):
                return os.open(path, os.O_RDWR | os.O_NOFOLLOW)
            with contextlib.suppress(FileExistsError):
                file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW)
                os.fchmod(file, EVERYBODY)
                return file
    except OSError as error:
        raise ConfigurationError(
            f"the lock {path} of an instrument cannot be opened: {error.strerror}",
            "free the disk, or have its owner remove it",
        ) from error


def _take(file: int, path: Path) -> None:
    """Acquire the lock. After a program has died, its guard holds it for as long as it acts."""
    give_up = time.monotonic() + GUARD_S
    while not _locked(file):
        entry = _entry_of(file)
        if time.monotonic() > give_up or _runs(entry.get("pid")):
            raise _in_use(entry, path)
        time.sleep(LOOK_EVERY_S)


def _locked(file: int) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EAGAIN, errno.EACCES):
            return False
        raise
    return True


def _entry_of(file: int) -> dict[str, Any]:
    try:
        entry = json.loads(os.pread(file, ENTRY_BYTES, 0))
    except (OSError, ValueError):
        return {}
    return entry if isinstance(entry, dict) else {}


def _in_use(entry: dict[str, Any], path: Path) -> ConfigurationError:
    bench, pid, since = (entry.get(name, "?") for name in ("bench", "pid", "since"))
    run = f" (run {entry['file']})" if "file" in entry else ""
    if _runs(pid):
        return ConfigurationError(
            f"the bench {bench} is in use by pid {pid} since {since}{run}",
            "wait until it has ended, or end it with Ctrl-C",
        )
    return ConfigurationError(
        f"the bench {bench} was in use by pid {pid}, which has died{run}; its guard has been "
        f"making it safe for {GUARD_S:g} s (lock {path})",
        "check the bench, then start again",
    )


def _runs(pid: object) -> bool:
    """Return whether the process runs; False if `pid` is not a process id."""
    if not isinstance(pid, int):
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # another user's
        pass
    return True
