"""Locks that allow one program at a time on an instrument and end with the program.

Two runs on one bench would stop each other's stages merely by connecting. Therefore every
instrument's address has a lock file in the folder that all users of the computer share
(`rig.run.locks.shared_folder`), and a program locks those of its bench from before it connects
until it is done. The locks belong to the kernel (``flock``): they end with the processes that hold
them, however those end; the files stay. A run's guard holds the locks as well, and acts under them
when the run has died.

A lock on a file that was removed is worth nothing, since the next program locks another file of the
same name. So the file is compared with its name after it was locked, and again before a run
connects (`BenchLock.check`); and a mark whose run lives (`rig.run.locks.bench_mark`) refuses the
bench as a lock does.

An instrument has a lock under each of its addresses (`rig.bench.addresses`), so that it is
found locked under every name for it.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from rig.bench.addresses import addresses_of
from rig.core.errors import ConfigurationError
from rig.run.locks.bench_mark import BenchMark, read_marks
from rig.run.locks.shared_folder import SharedFolder, user_name

if TYPE_CHECKING:
    from rig.bench.plan import BenchPlan, Restable

SUFFIX = ".lock"
ENTRY_BYTES = 4096
GUARD_S = 10.0
"""Longest time in s that a program waits for the guard of a run that died, without a message."""
SAY_AFTER_S, SAY_EVERY_S = 1.0, 60.0
"""Time in s after which a message says what is waited for, and the interval of later messages."""
LOOK_EVERY_S = 0.1


@dataclass(frozen=True)
class GuardWait:
    """A wait for the guard of a run that died, for as long as that guard acts."""

    say: Callable[[str], None]
    """Function that shows a line to a person."""
    check: Callable[[], None] = lambda: None
    """Function that raises what ends the wait."""


class BenchInUseError(ConfigurationError):
    """Raised where another program uses an instrument of the bench."""


class BenchLock:
    """The locks on all instruments of a bench; a context manager that releases them at its end.

    `only_reads` says that the program sets nothing on the bench: `rig make-safe` ends it. Raises
    BenchInUseError if another program holds one of the locks, or runs on the bench although its
    lock file was removed, and ConfigurationError if a lock file cannot be made. Where a run has
    died its guard holds them while it makes the bench safe: with `wait` that is waited for,
    whatever it takes, else for `GUARD_S`.
    """

    def __init__(self, plan: BenchPlan, only_reads: bool = False, wait: GuardWait | None = None):
        self._entry = {
            "bench": plan.settings.name,
            "pid": os.getpid(),
            "user": user_name(os.geteuid()),
            "since": time.strftime("%Y-%m-%d %H:%M:%S"),
            "only_reads": only_reads,
        }
        self.names = address_names(plan)
        """Names of the instruments' addresses, as the shared folder has them."""
        self._files: dict[str, int] = {}
        try:
            with SharedFolder() as folder:
                for name in self.names:
                    self._files[name] = _take(folder, name + SUFFIX, wait)
            if (user := _living(read_marks(self.names))) is not None:
                raise BenchInUseError(*user)
        except BaseException:
            self.release()
            raise
        self._write()

    @property
    def files(self) -> tuple[int, ...]:
        """File descriptors of the locks, for a process that shall hold them as well."""
        return tuple(self._files.values())

    def check(self) -> None:
        """Raise ConfigurationError if a lock file was removed since it was locked: another program
        may have locked its successor."""
        with SharedFolder() as folder:
            for name, file in self._files.items():
                if not folder.holds(name + SUFFIX, file):
                    raise ConfigurationError(
                        f"the lock {folder.path / (name + SUFFIX)} of the bench "
                        f"{self._entry['bench']} was removed, and another program may use the "
                        "bench",
                        "end whatever is running on the bench, then start again",
                    )

    def note_run(self, journal: Path) -> None:
        """Write the run's journal into the lock files, for the message of a program that finds them
        locked."""
        self._entry["file"] = str(journal.resolve())
        self._write()

    def release(self) -> None:
        """Release all locks."""
        while self._files:
            os.close(self._files.popitem()[1])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def _write(self) -> None:
        text = json.dumps(self._entry).encode()
        for file in self._files.values():
            with contextlib.suppress(OSError):  # On a full disk the lock works without its text.
                os.ftruncate(file, 0)
                os.pwrite(file, text, 0)


def in_use(plan: BenchPlan | Restable) -> str | None:
    """Return which program uses an instrument of this bench, in words; None if none does."""
    return names_in_use(address_names(plan))


def names_in_use(names: Sequence[str]) -> str | None:
    """Return which program uses an instrument with one of these addresses, in words; None if none
    does."""
    with SharedFolder() as folder:
        for name in names:
            try:
                file = folder.open_file(name + SUFFIX, create=False)
            except OSError:
                continue
            try:
                if not try_lock(file):
                    return _in_use(_entry_of(file), folder.path / (name + SUFFIX))[0]
            finally:
                os.close(file)
    user = _living(read_marks(names))
    return None if user is None else user[0]


def run_named_in(name: str) -> Path | None:
    """Return the journal of the latest run of the program that has locked an address; None where it
    has begun no run yet, or makes none."""
    with SharedFolder() as folder, contextlib.suppress(OSError):
        file = folder.open_file(name + SUFFIX, create=False)
        try:
            journal = _entry_of(file).get("file")
        finally:
            os.close(file)
        return Path(journal) if isinstance(journal, str) else None
    return None


def is_only_read(name: str) -> bool:
    """Return whether the lock of an address is held by a program that only reads."""
    with SharedFolder() as folder:
        try:
            file = folder.open_file(name + SUFFIX, create=False)
        except OSError:
            return False
        try:
            return bool(_entry_of(file).get("only_reads")) and not try_lock(file)
        finally:
            os.close(file)


def address_names(plan: BenchPlan | Restable) -> tuple[str, ...]:
    """Return the names under which the shared folder has each instrument's addresses, each once,
    in one order for all programs."""
    addresses = {address for part in plan.instruments for address in addresses_of(part.settings)}
    return tuple(sorted(hashlib.sha256(one.encode()).hexdigest()[:16] for one in addresses))


def _take(folder: SharedFolder, name: str, wait: GuardWait | None) -> int:
    """Lock the file and return its descriptor. After a program has died, its guard holds the lock
    for as long as it acts."""
    path = folder.path / name
    begun_s = time.monotonic()
    say_s = begun_s + SAY_AFTER_S
    while True:
        try:
            file = folder.open_file(name, create=True)
        except OSError as error:
            raise ConfigurationError(
                f"the lock {path} of an instrument cannot be opened: {error.strerror}",
                "free some disk space, or have its owner remove it",
            ) from error
        try:
            locked = try_lock(file)
            if locked and folder.holds(name, file):
                file, taken = -1, file
                return taken
            if locked:
                continue  # it was removed in between: the file of that name is a new one
            entry = _entry_of(file)
            over = wait is None and time.monotonic() > begun_s + GUARD_S
            if over or _runs(entry.get("pid")):
                raise BenchInUseError(*_in_use(entry, path, time.monotonic() - begun_s))
        finally:
            if file >= 0:
                os.close(file)
        if wait is not None:
            wait.check()
            if time.monotonic() > say_s:
                say_s = time.monotonic() + SAY_EVERY_S
                why, _ = _in_use(entry, path, time.monotonic() - begun_s)
                wait.say(f"waiting: {why}; Ctrl-C ends the wait")
        time.sleep(LOOK_EVERY_S)


def try_lock(file: int) -> bool:
    """Lock a file and return True, or return False where another program has locked it."""
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


def _in_use(entry: dict[str, Any], path: Path, waited_s: float | None = None) -> tuple[str, str]:
    """Return who uses the bench, and what can be done about it. `waited_s` is for how long a dead
    run's guard has been waited for."""
    bench, pid, since = (entry.get(name, "?") for name in ("bench", "pid", "since"))
    who = f"pid {pid} ({entry.get('user', '?')})"
    run = f" (run {entry['file']})" if "file" in entry else ""
    if _runs(pid):
        return (
            f"the bench {bench} is in use by {who} since {since}{run}",
            "wait until it has ended, or end it with Ctrl-C",
        )
    return (
        f"the bench {bench} was in use by {who}, which has died{run}; its guard is making it safe"
        + (f" and has been waited for {waited_s:.0f} s" if waited_s is not None else "")
        + f" (lock {path})",
        "check the bench, then start again",
    )


def _living(marks: list[BenchMark]) -> tuple[str, str] | None:
    """Return, as `_in_use` does, whose run is at work although its lock file was removed."""
    for mark in marks:
        if mark.lives and mark.run is not None:
            run = f" (run {mark.journal})" if mark.journal else ""
            who = f"pid {mark.run.pid} ({mark.user})"
            return (
                f"the bench {mark.bench} is in use by {who} since {mark.time}{run}, although its "
                "lock file was removed",
                "wait until it has ended, or end it with Ctrl-C",
            )
    return None


def _runs(pid: object) -> bool:
    """Return whether the process runs; False if `pid` is not a process id."""
    if not isinstance(pid, int):
        return False
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):  # the latter: a damaged entry
        return False
    except PermissionError:  # another user's
        pass
    return True
