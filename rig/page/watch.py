"""Watches a results folder: which run there is, what its journal says, who holds the bench.

One thread calls `poll` a few times a second. It reads files and the kernel's tables and writes
nothing; a run cannot notice it. Others read under `lock`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rig.files.errors import JournalError
from rig.files.journal.follow import UNSOUND, JournalTail
from rig.files.journal.format import JournalRecord, PointDiscard
from rig.files.journal.values import End, JournalEvent, Results
from rig.files.naming import JOURNAL_SUFFIX, RUN_SUFFIX
from rig.page.bench_signs import BenchSigns, is_last
from rig.page.folder import FoundFile, ResultsFolder
from rig.page.in_time import NotInTimeError, in_time
from rig.page.latest_file import LatestFile
from rig.page.stop_course import StopCourse, StopSigns, stop_course
from rig.page.view import RunView
from rig.page.word import BenchWord, Facts, bench_word
from rig.run.locks.lock_holder import (
    LockHolder,
    NotStoppedError,
    ask_to_stop,
    guard_of,
    holder_by_path,
    holder_of,
    lives,
    lock_file,
    locked_inodes,
)

DISK_S = 2.0
"""Time within which the disk of the results must answer where a stop waits for it."""
LOOK_EVERY_S = 0.5
"""Between two looks at folders, locks and marks."""
MOST_BYTES_A_POLL = 16 << 20


class Stop:
    """A stop that was asked for on the page, and what the process has done since."""

    def __init__(self, holder: LockHolder, journal: Path | None, *, run_only: bool = False):
        self.holder, self.journal, self.run_only = holder, journal, run_only
        self.at_s = time.monotonic()
        self.wall = time.strftime("%H:%M:%S")
        self.presses = 1
        self.guard_pid = guard_of(holder.pid)
        self.reacted = False
        self.after_end = False
        """The process had recorded an END before the press, and nothing since: it saves its data,
        or has begun another attempt at the run."""
        self.end: End | None = None

    @property
    def over(self) -> bool:
        """True if the run has recorded its end: a further press would be meant for the next."""
        return self.end is not None


BEGUN = BenchWord("unknown", "the journal is still being read")
"""The word of a run of which nothing has been read yet."""


class BenchWatch:
    """The latest run of a results folder, and the bench that it is on."""

    def __init__(self, results: Path, bench: Path | None = None):
        """`bench` is a bench file that is watched although no run of it is in the folder."""
        self.results = results
        self._without_links = results.resolve()
        self.lock = threading.Lock()
        """Never held while a file is looked at: a disk that does not answer would stop the page."""
        self.signs = BenchSigns(results, bench, self.lock)
        self._folder = ResultsFolder(results)
        self._latest = LatestFile(self.lock)
        self.view = RunView()
        self.generation = 0
        """Counts the runs that were shown: traces of different ones do not belong together."""
        self.path: Path | None = None
        """Journal that is followed."""
        self.holder: LockHolder | None = None
        """The process that writes the journal."""
        self._run_pid = -1
        """Process that was seen to write the journal that is shown."""
        self._ended_pid = -1
        """Process that was seen to record the END that is shown; -1 if none was."""
        self._guarded = False
        self.stop: Stop | None = None
        self.word = BenchWord("unknown", "nothing was read yet")
        self.behind = True
        """True while a long journal is still read up to its end."""
        self._tail: JournalTail | None = None
        self._shown_ns = 0
        """Latest change of the journal that is shown, as of the latest look that found it."""
        self._problem = ""
        self._missing = ""
        """Why what was read says nothing of the bench any more: its files do not exist."""
        self._unsound: str | None = None
        """The problem that viewers were warned of: bytes of the journal that are not a record."""
        self._grew_s = time.monotonic()
        self._looked_s = -LOOK_EVERY_S

    # --- polling --------------------------------------------------------------------------------

    def poll(self) -> None:
        """Read what has come; look at folders, locks and marks where that is due."""
        now = time.monotonic()
        if now - self._looked_s >= LOOK_EVERY_S:
            self._looked_s = now
            self._look()
        self._missing = self._files_problem()
        self._read(now)
        word = bench_word(self.facts(now))
        with self.lock:
            self.word = word

    def _look(self) -> None:
        locked = locked_inodes()
        journals = self._folder.find(JOURNAL_SUFFIX)
        if self.path is None:
            self._latest.look(self._folder)
        self._note_change(journals)
        written = [one for one in journals if one.inode in locked]
        # Of two runs at once the one that is shown stays, and with it what STOP is for.
        written.sort(key=lambda one: one.path != self.path)
        chosen = None
        for one in written:
            if (holder := holder_of(one.path, locked)) is not None:
                chosen, found = one, holder
                break
        else:
            found = None
        if chosen is None and journals and self._is_news(journals[0]):
            chosen = journals[0]
        if chosen is not None and chosen.path != self.path:
            self._follow(chosen.path, found)
            self._note_change(journals)
        with self.lock:
            if self.stop is not None and found is not None and chosen is not None:
                another = found.pid != self.stop.holder.pid
                if another and self.stop.journal == chosen.path:  # it was resumed since
                    self.stop = None
            self.holder = found if chosen is not None and chosen.path == self.path else None
            self._guarded = False
            if self.holder is not None:
                if self.word.word == "safe":  # until what it records has been read
                    self.word = BEGUN
                self._run_pid = self.holder.pid
                self._guarded = guard_of(self.holder.pid) is not None
        self._look_at_bench(locked)

    def _note_change(self, journals: list[FoundFile]) -> None:
        for one in journals:
            if one.path == self.path:
                self._shown_ns = one.mtime_ns

    def _is_news(self, journal: FoundFile) -> bool:
        """Return whether a journal that no one writes is to be shown: it is another one than that
        which is shown, and newer than the latest run file."""
        if self.path is not None:
            # Its journal may have been compiled: one that is left over is that of an earlier run.
            return journal.path != self.path and journal.mtime_ns > self._shown_ns
        latest = self._latest.file
        if latest is None:
            return True
        # The journal that a run file was made of says more than the file, and is older.
        of_it = journal.path.with_suffix(RUN_SUFFIX) == latest.path
        return of_it or journal.mtime_ns > latest.mtime_ns

    def _follow(self, path: Path, holder: LockHolder | None = None) -> None:
        if self._tail is not None:
            self._tail.close()
        self._tail = JournalTail(path)
        with self.lock:
            self.path, self.view, self._problem = path, RunView(), ""
            self._unsound = None
            self.word = BEGUN  # the word before was that of another run
            self.generation += 1
            self._run_pid = self._ended_pid = -1
            self.behind = True
            self._grew_s = time.monotonic()
            if self.stop is not None and self.stop.journal != path:
                if self.stop.journal is None and self.stop.holder == holder:
                    self.stop.journal = path  # it was pressed before the run's first record
                else:
                    self.stop = None

    def _read(self, now: float) -> None:
        if self._tail is None or self._problem:
            self.behind = False
            return
        try:
            records = self._tail.poll(MOST_BYTES_A_POLL)
        except JournalError as error:
            self._restart(error)
            return
        if any(isinstance(record, End) for record in records):
            # The run has written its mark before its END: what is still pressed is known with it.
            self._look_at_bench(locked_inodes())
            self._looked_s = -LOOK_EVERY_S
        with self.lock:
            for record in records:
                self.view.take(record)
                goes_on = not isinstance(record, (End, Results))
                if self.stop is not None and self.stop.over and goes_on:
                    self.stop = None  # another attempt at the same run
                if not isinstance(record, Results):
                    ended_now = isinstance(record, End) and not self.behind
                    self._ended_pid = self._run_pid if ended_now else -1
                if self.stop is not None and not self.behind:
                    self.stop.after_end &= not goes_on
                    self.stop.reacted |= _reacts(record)
                    if isinstance(record, End):
                        self.stop.end = record
            if records:
                self._grew_s = now
            else:
                self.behind = False
            self._note_unsound(self._tail.problem)
            # With what was read, so that no viewer sees a run with the word from before it.
            self.word = bench_word(self.facts(now))

    def _note_unsound(self, problem: str | None) -> None:
        """Warn, once, of bytes that are not a record: nothing behind them can be shown."""
        if problem == self._unsound or (problem is not None and not problem.startswith(UNSOUND)):
            return
        self._unsound = problem
        if problem is not None:
            self.view.note(
                "warning", "page", f"what follows in the journal cannot be shown: {problem}"
            )

    def _restart(self, error: JournalError) -> None:
        """Begin again with a journal that was cut or replaced; say so of one that is none."""
        path = self.path
        assert path is not None
        if "cut to" in error.reason or "replaced" in error.reason:
            self._follow(path)
            with self.lock:
                self.view.note("warning", "page", error.reason)
            return
        with self.lock:
            self._problem = f"the journal cannot be followed: {error.reason}"

    def _look_at_bench(self, locked: dict[int, list[int]]) -> None:
        header = self.view.header if self.path is not None else self._latest.header
        if self.path is None or header is not None:
            self.signs.find_names(self._shown, header)
        self.signs.look(self._shown, self._run_pid, locked)

    @property
    def _shown(self) -> Path | None:
        """The journal or run file by which the bench is judged."""
        if self.path is not None:
            return self.path
        return None if self._latest.file is None else self._latest.file.path

    def _files_problem(self) -> str:
        """Return why what was read says nothing of the bench any more: its files, or the folder
        that the next run would record in, no longer exist. Empty if they exist."""
        shown = self._shown
        if shown is None:
            return ""
        if not self.results.is_dir():
            return f"the results folder {self.results} is not there any more"
        if not (shown.exists() or shown.with_suffix(RUN_SUFFIX).exists()):
            return f"{shown.name} is not in the results folder any more"
        return ""

    # --- saying ---------------------------------------------------------------------------------

    def facts(self, now: float | None = None) -> Facts:
        """Return what is known of the bench, for its word."""
        now = time.monotonic() if now is None else now
        view, signs = self.view, self.signs
        end = view.end
        by_file = self.last_file
        another = ""
        saves = signs.holder is not None and signs.holder.pid == self._run_pid
        if signs.holder is not None and self.holder is None and not saves:
            another = f"process {signs.holder.pid} ({signs.holder.user})"
        lives = self.holder is not None or saves
        unfinished = [mark for mark in signs.marks if mark.state == "running" and not lives]
        for mark in unfinished:
            if not another and mark.run is not None and mark.run.lives:  # its lock was removed
                another = f"process {mark.run.pid} ({mark.user})"
        return Facts(
            run_lives=lives,
            held_by_another=another,
            recorded=self._shown is not None,
            other_bench=signs.is_of_another,
            ended=end is not None or (by_file is not None and by_file["closed"]),
            exit=end.exit if end is not None else 0 if by_file is None else int(by_file["exit"]),
            holding=view.holding,
            off_failed=view.off_failed,
            force_N=view.force_N if view.recording and view.point is not None else None,
            silent_s=self.silent_s(now),
            recording=view.recording and view.point is not None,
            guarded=self._guarded,
            unsafe="; ".join(signs.refusals)[:1000],
            pressed=signs.pressed,
            unfinished=bool(unfinished),
            guard_reported=is_last(signs.report) and not signs.guard_failed,
            made_safe=signs.made_safe and not lives,
            problem=self._problem or ("the journal is still being read" if self.behind else ""),
            bench_problem=signs.problem or self._missing,
        )

    def silent_s(self, now: float | None = None) -> float:
        """Return for how long the journal has not grown."""
        return (time.monotonic() if now is None else now) - self._grew_s

    def course(self) -> StopCourse | None:
        """Return how far the stop that was asked for has come, None if none was."""
        stop = self.stop
        if stop is None:
            return None
        report = self.signs.report
        said = str(report.get("cause", ""))
        if report.get("released") is True:  # what is still pressed is said by `pressed`
            said = f"{said}; {report.get('pressed', '')}".strip("; ")
        return stop_course(
            StopSigns(
                since_s=time.monotonic() - stop.at_s,
                presses=stop.presses,
                pid=stop.holder.pid,
                process_lives=lives(stop.holder.pid),
                reacted=stop.reacted,
                after_end=stop.after_end,
                ended=stop.end is not None,
                exit=0 if stop.end is None else stop.end.exit,
                status=""
                if stop.end is None
                else f"{stop.end.status}, {stop.end.points_done} points, {stop.end.reason}",
                guard_pid=stop.guard_pid,
                heartbeat_timeout_s=self.signs.heartbeat_timeout_s,
                guard_report=f"The guard of the run had to act: {said}" if report else "",
                guard_done=is_last(report),
                guard_safe=report.get("safe") is True,
                recording=stop.journal is not None,
                bench_safe=self.word.word == "safe",
                made_safe=self.signs.made_safe,
                pressed=self.signs.pressed,
            )
        )

    @property
    def last_file(self) -> dict[str, Any] | None:
        """What the latest run file says of its run's end, where no journal is shown; else None."""
        return self._latest.ending if self.path is None else None

    # --- stopping -------------------------------------------------------------------------------

    def real(self, path: Path) -> Path:
        """Return a path in the results folder as the kernel knows it: absolute, without links."""
        if not path.is_relative_to(self.results):
            return path
        return self._without_links / path.relative_to(self.results)

    def run_holder(self, journal: Path) -> LockHolder | None:
        """Return the process that holds the lock of a journal, None if there is none. The disk is
        asked, for at most `DISK_S`, only where the kernel knows no process by the path: one of
        another user, for instance."""
        if (holder := holder_by_path(self.real(journal))) is not None:
            return holder
        try:
            return in_time(DISK_S, lambda: holder_of(journal))
        except NotInTimeError:
            return None

    def press_again(self) -> Stop | None:
        """Count a further press while a stop is under way, and return it; None if none is."""
        with self.lock:
            stop = self.stop
            if stop is None or stop.over or not lives(stop.holder.pid):
                return None
            stop.presses += 1
            return stop

    def ask_to_stop(self, end_the_run: Callable[[Path], LockHolder] | None = None) -> Stop:
        """Ask the run to end in order: SIGTERM to the process that holds its locks, and to no
        other. A further press only counts, but the process itself is asked if only its run was.

        `end_the_run` asks for the end of a run only, whose process continues: it is given the
        locked file and returns the process that holds it. Raises RigError; then nothing was sent.
        """
        before = self.stop
        wider = end_the_run is None and before is not None and before.run_only
        again = self.press_again()
        if again is not None and not wider:
            return again
        target, journal = self._target()
        holder = (end_the_run or self._send)(target)
        with self.lock:
            # Presses do not wait for each other: one may hang in the queue of a batch. Of two at
            # the same time both reach the process, and the second counts as a further one.
            same = self.stop
            if same is not None and same is not before and not same.over and same.holder == holder:
                same.presses += 1
                same.run_only &= end_the_run is not None
                return same
            self.stop = Stop(holder, journal, run_only=end_the_run is not None)
            self.stop.after_end = journal is not None and holder.pid == self._ended_pid
            return self.stop

    def _send(self, target: Path) -> LockHolder:
        """Send SIGTERM to the process that holds a lock, without the disk where that is possible;
        return the process. Raises NotStoppedError."""
        real = self.real(target)
        if holder_by_path(real) is not None:
            return ask_to_stop(real, by_path=True)
        return ask_to_stop(target)

    def _target(self) -> tuple[Path, Path | None]:
        """Return the locked file whose holder is to be stopped: the journal of the run that is
        shown; for a run that records elsewhere, the lock of the bench."""
        path = self.path
        if path is not None and self.run_holder(path) is not None:
            return path, path
        for name in self.signs.names:
            file = lock_file(name)
            if holder_of(file) is not None:
                return file, None
        if path is not None and self.view.end is None and not self.signs.report:
            raise NotStoppedError(
                "the run's process has ended, and its guard has not reported yet",
                "the guard makes the bench safe; if no report comes, switch it off by hand",
            )
        raise NotStoppedError(
            "no run holds the bench", "to stop all motion and switch all outputs off: make safe"
        )


def _reacts(record: JournalRecord) -> bool:
    """Return whether a run records this once it has noticed that it is to end."""
    if isinstance(record, JournalEvent):
        return record.code == "making-safe"
    return isinstance(record, (PointDiscard, End))
