"""The folder of a batch: where its queue, its runs and its records are."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from rig.core.errors import ConfigurationError
from rig.core.text import in_shell
from rig.files.errors import LOCKS_NEEDED
from rig.files.naming import JOURNAL_SUFFIX, RUN_SUFFIX
from rig.run.locks.lock_holder import holder_of, lives, locked_inodes

QUEUE = "queue.sqlite"


@dataclass(frozen=True)
class BatchFolder:
    """The places in a batch's folder."""

    path: Path

    @property
    def resume_command(self) -> str:
        """The command that continues the batch, as a person enters it."""
        return f"rig batch resume {in_shell(self.path)}"

    @property
    def queue(self) -> Path:
        """See `rig.batch.queue`."""
        return self.path / QUEUE

    @property
    def batch_file(self) -> Path:
        """The batch file as it was when the batch began."""
        return self.path / "batch.toml"

    @property
    def terms(self) -> Path:
        """Copy of the batch's terms beside the queue, which may be damaged."""
        return self.path / "terms.json"

    @property
    def heartbeat(self) -> Path:
        """See `rig.batch.report.heartbeat`."""
        return self.path / "heartbeat.json"

    @property
    def log(self) -> Path:
        """File with the standard error of the batch's processes, tracebacks included."""
        return self.path / "batch.log"

    @property
    def supervisor_lock(self) -> Path:
        """The file that the supervisor locks; see `held_by`."""
        return self.path / "supervisor.lock"

    @property
    def worker_lock(self) -> Path:
        """The file that the worker locks; see `held_by`."""
        return self.path / "worker.lock"

    def journal(self, number: int, procedure: str) -> Path:
        """Return the path of a run's journal, the same for all attempts."""
        return self.path / "runs" / f"r{number:05d}_{procedure}{JOURNAL_SUFFIX}"

    def run_file(self, number: int, procedure: str) -> Path:
        """Return the run file that this journal is compiled to."""
        return self.journal(number, procedure).with_suffix(RUN_SUFFIX)

    def not_compiled(self, runs: Iterable[tuple[int, str]]) -> int:
        """Return how many of these runs, by number and procedure, are without their run file."""
        return sum(not self.run_file(*run).exists() for run in runs)

    def world_log(self, number: int) -> Path:
        """Return a simulated bench's own log of a run, of all its attempts."""
        return self.path / "runs" / f"r{number:05d}.world.jsonl"

    @contextlib.contextmanager
    def held_by(
        self, who: str, patience_s: float, check: Callable[[], object] = lambda: None
    ) -> Iterator[int]:
        """Hold the lock of a batch's "worker", "supervisor" or "postprocess", which only one
        process can hold at a time.

        Gives the descriptor of the lock, for child processes that have to hold it as well. Raises
        ConfigurationError if another process holds it for longer than `patience_s`, and what
        `check` raises, which is called while it waits.
        """
        path = self.path / f"{who}.lock"
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            give_up = time.monotonic() + patience_s
            while not _locked(file, path):
                if time.monotonic() > give_up:
                    pid = os.pread(file, 20, 0).decode("ascii", "replace").strip() or "?"
                    raise ConfigurationError(
                        f"{self.path}: {_in_the_way(who, pid)}",
                        f"see: rig batch status {in_shell(self.path)}",
                    )
                check()
                time.sleep(0.05)
            with contextlib.suppress(OSError):  # a full disk: who holds it is for people only
                os.pwrite(file, f"{os.getpid()}\n".encode(), 0)
                os.ftruncate(file, len(f"{os.getpid()}\n"))
            yield file
        finally:
            os.close(file)

    def is_held(self, who: str) -> bool:
        """Return whether a process is the batch's `who` now; see `held_by`."""
        path = self.path / f"{who}.lock"
        try:
            file = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        except PermissionError:  # another user's: the kernel knows who holds it
            return holder_of(path) is not None
        except OSError:
            return False
        try:
            return not _locked(file, path)
        finally:
            os.close(file)


def new_folder(results: Path, name: str, today: datetime) -> BatchFolder:
    """Make the folder of a new batch: ``2026-11-21_friction``, with ``-2`` if that is taken.

    Raises ConfigurationError if the folder cannot be made, or after 999 batches of one name in a
    day.
    """
    for number in range(1, 1000):
        more = f"-{number}" if number > 1 else ""
        path = results / f"{today:%Y-%m-%d}_{name}{more}"
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise ConfigurationError(
                f"{path}: the batch's folder cannot be made: {error.strerror or error}",
                "free some disk space, or choose another folder for results"
                if error.errno == errno.ENOSPC
                else "choose another folder for results",
            ) from error
        (path / "runs").mkdir()
        return BatchFolder(path)
    raise ConfigurationError(
        f"{results}: there are 999 batches of the name {name} of today", "choose another name"
    )


def find_folder(given: Path | None, results: Path) -> BatchFolder:
    """Return the batch that a command means: the folder it names, or else the one in the results
    that runs, or else the latest there.

    Raises ConfigurationError if the results contain no batch, or several that run.
    """
    if given is not None:
        return _named(given)
    folders, running = _batches_in(results)
    if len(running) > 1:
        names = ", ".join(str(one.path) for one in running)
        raise ConfigurationError(f"{len(running)} batches run: {names}", "name the folder of one")
    return running[0] if running else folders[-1]


def folder_to_resume(given: Path | None, results: Path) -> BatchFolder:
    """Return the batch that is to be resumed: the folder that is named, or else the latest in the
    results.

    Raises ConfigurationError if the results contain no batch, several that run, or one that runs
    and a later one: the first may be paused, the other interrupted.
    """
    found = find_folder(given, results)
    if given is None and found != (latest := _batches_in(results)[0][-1]):
        raise ConfigurationError(
            f"two batches could be meant: {found.path} runs, {latest.path} is the latest",
            f"name one: {found.resume_command}, or {latest.resume_command}",
        )
    return found


def folder_to_rebuild(given: Path | None, results: Path) -> BatchFolder:
    """Return the batch whose queue is to be rebuilt: the folder that is named, or else the latest
    in the results that does not run.

    Raises ConfigurationError if the results contain none.
    """
    if given is not None:
        return _named(given)
    folders, running = _batches_in(results)
    resting = [one for one in folders if one not in running]
    if not resting:
        raise ConfigurationError(
            f"every batch in {results} is running", "stop one first: rig batch stop"
        )
    return resting[-1]


def _named(given: Path) -> BatchFolder:
    return BatchFolder(given.parent if given.name == QUEUE else given)


def _batches_in(results: Path) -> tuple[list[BatchFolder], list[BatchFolder]]:
    """Return the batches in a folder of results, latest last, and those of them that run. Raises
    ConfigurationError if there is none."""
    found = sorted(results.glob(f"*/{QUEUE}"), key=lambda queue: queue.stat().st_ctime)
    if not found:
        raise ConfigurationError(
            f"{results} contains no batch", "name its folder, or begin one: rig batch run FILE"
        )
    folders = [BatchFolder(queue.parent) for queue in found]
    locked = locked_inodes()
    return folders, [one for one in folders if holder_of(one.supervisor_lock, locked) is not None]


def _in_the_way(who: str, pid: str) -> str:
    """Say what holds a lock that process `pid` took: what it has started, such as the guard of its
    bench, may hold the lock longer than itself."""
    if not pid.isdecimal() or lives(int(pid)):
        return f"the batch has a {who} already (process {pid})"
    return (
        f"the {who} before (process {pid}) has died, and a process that it started, such as the "
        "guard of its bench, still acts"
    )


def _locked(file: int, path: Path) -> bool:
    """Lock a file and return True, or return False where another process has locked it. Raises
    ConfigurationError where its file system locks nothing."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        raise ConfigurationError(
            f"{path} cannot be locked: {error.strerror}", LOCKS_NEEDED
        ) from error
    return True
