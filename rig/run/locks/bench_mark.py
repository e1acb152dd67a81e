"""The mark of a bench on which something moves, or that was not left safe.

A run writes the mark of every instrument's address into the shared folder before anything is
switched on or moves, and removes it when the bench is safe. So whatever becomes of the run, of its
guard and of the folder of results, the next program that wants one of these instruments finds out:

    running    written by the run. If neither run nor guard lives any more, both were killed
    unsafe     written by the run or its guard, which could not make the bench safe
    stopped    written by the guard that made the bench safe, or by a run that ended with something
               still pressed: it is reported once and refuses nothing

The first two refuse the bench until ``rig make-safe`` has succeeded. That removes the marks, and
leaves a note of its time beside them, for who shows the state of the bench; a run removes the note
when it begins.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from rig.core.errors import ExitCode, RigError, UnsafeError
from rig.core.text import in_shell, printable
from rig.run.locks.shared_folder import SharedFolder, user_name

SUFFIX = ".mark"
MADE_SAFE_SUFFIX = ".made-safe"
MarkState = Literal["running", "unsafe", "stopped"]
Shown = Annotated[str, AfterValidator(printable)]
"""Text for a person. Names of files may hold bytes that no encoding of a mark has: a mark that is
refused for them would be missing when it is needed."""
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


class ProcessStamp(BaseModel):
    """A process, so that no later one with the same number is taken for it."""

    model_config = ConfigDict(frozen=True)

    pid: int
    started: str
    """Start of the process, by the kernel's count since the computer's start."""
    boot: str
    """The computer's start."""

    @classmethod
    def of(cls, pid: int) -> ProcessStamp:
        """Return the stamp of a process, which never lives if there is none of that number."""
        return cls(pid=pid, started=_started(pid), boot=_boot())

    @property
    def lives(self) -> bool:
        """Return whether it is still there; a process that is stopped is."""
        return self.started != "" and self == ProcessStamp.of(self.pid)


class BenchMark(BaseModel):
    """Record of a bench that was not left safe, or is not yet."""

    model_config = ConfigDict(frozen=True)

    state: MarkState
    bench: str
    """Name of the bench."""
    time: str
    """Time at which the mark was written, local time."""
    user: str
    run: ProcessStamp | None = None
    guard: ProcessStamp | None = None
    journal: Shown | None = None
    """Journal of the run; None if nothing was recorded."""
    failures: Mapping[str, Shown] = Field(default_factory=dict)
    """Reasons why the bench could not be made safe, by role."""
    names: tuple[str, ...] = ()
    """All names under which it was written: those of the bench's addresses at that time."""
    report: Shown = ""
    """Report on what was done and what is known, as a sentence."""
    released: bool = False
    """True if z was seen clear of contact, with nothing pressed."""

    @property
    def lives(self) -> bool:
        """Return whether the run that wrote it, or its guard, is still at work."""
        return self.state == "running" and any(
            process is not None and process.lives for process in (self.run, self.guard)
        )

    @property
    def refuses(self) -> bool:
        """Return whether nothing may be switched on before ``rig make-safe`` has succeeded."""
        return self.state != "stopped" and not self.lives

    def in_words(self) -> str:
        """Return what a person has to know, as a sentence."""
        journal = f" (run {self.journal})" if self.journal else ""
        if self.state == "stopped":
            return f"the bench {self.bench}, {self.time}: {self.report}"
        if self.state == "running":
            pid = "?" if self.run is None else self.run.pid
            return (
                f"the bench {self.bench} was left unsafe: the run of {self.user} that began at "
                f"{self.time} (pid {pid}) was killed together with its guard{journal}; motion and "
                "outputs may be on, and something may be pressed"
            )
        troubles = "; ".join(f"{name}: {why}" for name, why in self.failures.items())
        return f"the bench {self.bench} was left unsafe at {self.time}{journal}: {troubles}"


class BenchMarks:
    """The marks of one bench, as a run and its guard write and remove them."""

    def __init__(self, names: Sequence[str], bench: str, journal: Path | str | None):
        """`names` are those of the bench's addresses; none for a simulated bench that belongs to
        the run alone, of which nothing is written. `journal` is the run's."""
        self._names, self._bench = tuple(names), bench
        self._journal = None if journal is None else str(journal)

    def running(self, guard_pid: int) -> None:
        """Note that this run is about to move something. Raises RigError if that cannot be
        written: the run has to be refused."""
        self._write("running", guard=ProcessStamp.of(guard_pid))

    def unsafe(self, failures: Mapping[str, str]) -> None:
        """Note why the bench could not be made safe, by what is not safe. Raises RigError."""
        self._write("unsafe", failures=failures)

    def stopped(self, report: str, released: bool = False) -> None:
        """Note what the next command has to report of a bench that was made safe, and whether z was
        seen clear of contact, with nothing pressed. Raises RigError."""
        self._write("stopped", report=report, released=released)

    def clear(self) -> None:
        """Note that the bench is safe. Raises RigError."""
        clear_marks(self._names)

    def _write(
        self,
        state: MarkState,
        *,
        failures: Mapping[str, str] | None = None,
        report: str = "",
        released: bool = False,
        guard: ProcessStamp | None = None,
    ) -> None:
        if not self._names:
            return
        mark = BenchMark(
            state=state,
            bench=self._bench,
            time=time.strftime("%Y-%m-%d %H:%M:%S"),
            user=user_name(os.geteuid()),
            run=ProcessStamp.of(os.getpid()),
            guard=guard,
            journal=self._journal,
            failures=failures or {},
            names=self._names,
            report=report,
            released=released,
        )
        write_marks(self._names, mark)


def write_marks(names: Sequence[str], mark: BenchMark) -> None:
    """Write a mark for every address in `names`; they are on the disk when this returns. Raises
    RigError (exit code 3) if one cannot be written."""
    if not names:
        return
    text = mark.model_dump_json(indent=1) + "\n"
    with SharedFolder() as folder:
        for name in names:
            try:
                folder.write(name + SUFFIX, text)
            except OSError as error:
                raise RigError(
                    f"the mark that the bench {mark.bench} is in use cannot be written to "
                    f"{folder.path / (name + SUFFIX)}: {error.strerror}; without it a later "
                    "run would not know that this one and its guard were killed",
                    "free some disk space, or have the folder's owner correct it; then start again",
                    ExitCode.INSTRUMENT,
                ) from error


def read_marks(names: Sequence[str]) -> list[BenchMark]:
    """Return the marks of these addresses, each once. One that cannot be understood is returned as
    the mark of an unsafe bench."""
    if not names:
        return []
    found: list[BenchMark] = []
    with SharedFolder() as folder:
        for name in names:
            try:
                text = folder.read(name + SUFFIX)
                mark = None if text is None else BenchMark.model_validate_json(text)
            except (OSError, ValueError):
                why = {"mark": f"{folder.path / (name + SUFFIX)} cannot be read"}
                mark = BenchMark(state="unsafe", bench="?", time="?", user="?", failures=why)
            if mark is not None and mark not in found:
                found.append(mark)
    return found


def clear_marks(names: Sequence[str]) -> None:
    """Remove the marks of these addresses, and the notes that they were made safe. Raises RigError
    if one cannot be removed."""
    if not names:
        return
    with SharedFolder() as folder:
        for file in [name + suffix for name in names for suffix in (MADE_SAFE_SUFFIX, SUFFIX)]:
            try:
                folder.remove(file)
            except OSError as error:
                raise RigError(
                    f"the mark {folder.path / file} of a bench that is safe again "
                    f"cannot be removed: {error.strerror}",
                    "have the folder's owner remove it",
                ) from error


def note_made_safe(names: Sequence[str]) -> None:
    """Note that ``rig make-safe`` has succeeded now on these addresses. Raises RigError or
    OSError."""
    with SharedFolder() as folder:
        for name in names:
            folder.write(name + MADE_SAFE_SUFFIX, str(time.time_ns()))


def made_safe_ns(names: Sequence[str]) -> int | None:
    """Return the time, in ns since 1970, since which all of these addresses have been made safe by
    ``rig make-safe`` and no run has begun on one of them; None if that is not known. Raises
    RigError."""
    noted: list[int] = []
    with SharedFolder() as folder:
        for name in names:
            try:
                noted.append(int(folder.read(name + MADE_SAFE_SUFFIX) or ""))
            except (OSError, ValueError):
                return None
    return min(noted, default=None)


def refuse_unsafe(marks: Sequence[BenchMark], bench_file: str) -> None:
    """Raise UnsafeError if one of the marks refuses the bench."""
    for mark in marks:
        if mark.refuses:
            raise UnsafeError(
                mark.in_words(),
                f"check the bench, then run: rig make-safe --bench {in_shell(bench_file)}",
            )


def _started(pid: int) -> str:
    """Return the 22nd field of the process's status; empty if there is no such process. A process
    that has ended and that its parent has not asked for yet is gone."""
    try:
        # A long name of a process may end within a character.
        status = Path(f"/proc/{pid}/stat").read_text(errors="replace")
    except OSError:
        return ""
    fields = status.rpartition(")")[2].split()
    return "" if fields[0] in "ZX" else fields[19]


def _boot() -> str:
    with contextlib.suppress(OSError):
        return BOOT_ID.read_text().strip()
    return ""
