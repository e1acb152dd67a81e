"""Watches a results folder: which run there is, what its journal says, who holds the bench.

One thread calls `poll` a few times a second. It reads files and the kernel's tables and writes
nothing; a run cannot notice it. Others read under `lock`.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rig.core.errors import RigError
from rig.files.errors import JournalError
from rig.files.journal.follow import JournalTail
from rig.files.journal.format import JournalRecord, PointDiscard
from rig.files.journal.reader import DAMAGED, NEVER_CLOSED
from rig.files.journal.values import End, JournalEvent, Results, RunHeader
from rig.files.naming import JOURNAL_SUFFIX, RUN_SUFFIX
from rig.files.runfile.reader import RunFile
from rig.page.folder import FoundFile, ResultsFolder
from rig.page.stop_course import StopCourse, StopSigns, stop_course
from rig.page.view import RunView
from rig.page.word import BenchWord, Facts, bench_word
from rig.run.bench_mark import BenchMark, read_marks
from rig.run.guard import GUARD_SUFFIX, report_path
from rig.run.lock_holder import (
    LockHolder,
    NotStoppedError,
    ask_to_stop,
    guard_of,
    holder_of,
    lives,
    lock_file,
    locked_inodes,
)

LOOK_EVERY_S = 0.5
"""Between two looks at folders, locks and marks."""
FILES_TRIED = 20
"""Latest run files of which the first that can be read says how the latest run ended."""
MOST_BYTES_A_POLL = 16 << 20


class Stop:
    """A stop that was asked for."""

    def __init__(self, holder: LockHolder, journal: Path | None, *, run_only: bool = False):
        self.holder, self.journal, self.run_only = holder, journal, run_only
        self.at_s = time.monotonic()
        self.wall = time.strftime("%H:%M:%S")
        self.presses = 1
        self.guard_pid = guard_of(holder.pid)
        self.reacted = False
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
        self.results = results
        self.bench = bench
        """Bench file that is watched although no run of it is in the folder; None for none."""
        self.lock = threading.Lock()
        self.folder = ResultsFolder(results)
        self.view = RunView()
        self.generation = 0
        """Counts the runs that were shown: traces of different ones do not belong together."""
        self.path: Path | None = None
        """Journal that is followed."""
        self.holder: LockHolder | None = None
        """The process that writes the journal."""
        self.bench_holder: LockHolder | None = None
        """The process that holds the bench of the run, or of the bench file."""
        self._run_pid = -1
        """Process that was seen to write the journal that is shown."""
        self._guarded = False
        self.stop: Stop | None = None
        self.word = BenchWord("unknown", "nothing was read yet")
        self.behind = True
        """True while a long journal is still read up to its end."""
        self._tail: JournalTail | None = None
        self._problem = ""
        self._grew_s = time.monotonic()
        self._looked_s = -LOOK_EVERY_S
        self._names: tuple[str, ...] = ()
        """Names of the addresses of the run's bench, and of the bench file's."""
        self._names_of: Path | None = None
        self._other_bench = False
        """True if a bench file is watched and the run that is shown was on another bench."""
        self._plan_problem = ""
        self._locks_problem = ""
        self._bench_name = ""
        self.heartbeat_timeout_s = 0.0
        self._last_file: tuple[FoundFile, dict[str, Any]] | None = None
        self._last_header: RunHeader | None = None
        self._unusable: set[FoundFile] = set()
        """Run files that cannot be read, or that were imported."""
        self._marks: list[BenchMark] = []
        self._report: dict[str, Any] = {}

    # --- polling --------------------------------------------------------------------------------

    def poll(self) -> None:
        """Read what has come; look at folders, locks and marks where that is due."""
        now = time.monotonic()
        if now - self._looked_s >= LOOK_EVERY_S:
            self._looked_s = now
            self._look()
        self._read(now)
        word = bench_word(self.facts(now))
        with self.lock:
            self.word = word

    def _look(self) -> None:
        locked = locked_inodes()
        journals = self.folder.find(JOURNAL_SUFFIX)
        self._look_at_files()
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

    def _is_news(self, journal: FoundFile) -> bool:
        """Return whether a journal that nobody writes is to be shown: it is another one than that
        which is shown, and newer than the latest run file."""
        if self.path is not None and self._tail is not None and not self._tail.deleted:
            try:
                shown = self.path.lstat().st_mtime_ns
            except OSError:
                shown = 0
            return journal.path != self.path and journal.mtime_ns > shown
        if self._last_file is None:
            return True
        latest = self._last_file[0]
        # The journal that a run file was made of says more than the file, and is older.
        of_it = journal.path.with_suffix(RUN_SUFFIX) == latest.path
        return of_it or journal.mtime_ns > latest.mtime_ns

    def _follow(self, path: Path, holder: LockHolder | None = None) -> None:
        if self._tail is not None:
            self._tail.close()
        self._tail = JournalTail(path)
        with self.lock:
            self.path, self.view, self._problem = path, RunView(), ""
            self.word = BEGUN  # the word before was that of another run
            self.generation += 1
            self._run_pid = -1
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
                if self.stop is not None and not self.behind:
                    self.stop.reacted |= _reacts(record)
                    if isinstance(record, End):
                        self.stop.end = record
            if records:
                self._grew_s = now
            else:
                self.behind = False
            # With what was read, so that no viewer sees a run with the word from before it.
            self.word = bench_word(self.facts(now))

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
        self._name_bench()
        holder = None
        marks: list[BenchMark] = []
        problem = ""
        try:
            for name in self._names:
                holder = holder or holder_of(lock_file(name), locked)
            marks = read_marks(self._names)
        except RigError as error:  # no folder that can be trusted: nothing is believed of it
            problem = error.one_line()
        report = self._guard_report()
        with self.lock:
            self.bench_holder, self._marks, self._report = holder, marks, report
            self._locks_problem = problem

    @property
    def _shown(self) -> Path | None:
        """The journal or run file by which the bench is judged."""
        if self.path is not None:
            return self.path
        return None if self._last_file is None else self._last_file[0].path

    def _name_bench(self) -> None:
        """Find the names of the bench's addresses, once for each run."""
        wanted = self._shown or self.bench
        if wanted is None or self._names_of == wanted:
            return
        header = self.view.header if self.path is not None else self._last_header
        if self.path is not None and header is None:
            return
        from rig.bench.plan import parse_bench, read_bench
        from rig.run.lock import address_names

        own: tuple[str, ...] = ()
        watched: tuple[str, ...] = ()
        problem, name, timeout_s = "", "", 0.0
        if self.bench is not None:
            try:
                plan = read_bench(self.bench)
                watched, name = address_names(plan), plan.settings.name
                timeout_s = plan.settings.heartbeat_timeout_s
            except RigError as error:
                problem = error.one_line()
        if header is not None:
            try:
                plan = parse_bench(header.bench_toml, header.bench_file)
                own, name = address_names(plan), plan.settings.name
                timeout_s = plan.settings.heartbeat_timeout_s
            except RigError as error:
                name, timeout_s = "", 0.0
                if not header.simulated:
                    problem = f"the bench of the latest run cannot be read: {error.one_line()}"
        with self.lock:
            self._names_of = wanted
            self._names = tuple(dict.fromkeys(own + watched))
            self._other_bench = bool(header and watched) and not set(own) & set(watched)
            self._plan_problem = problem
            self._bench_name, self.heartbeat_timeout_s = name, timeout_s

    def _guard_report(self) -> dict[str, Any]:
        """Return what the guard of the run that is shown has reported; empty for nothing. A report
        of an earlier attempt at the run says nothing of this one."""
        if self._shown is None:
            return {}
        journal = self._shown.with_suffix(JOURNAL_SUFFIX)
        try:
            written_ns = journal.stat().st_mtime_ns
        except OSError:  # its run file is what is left of it
            written_ns = 0
        beside = journal.with_suffix(GUARD_SUFFIX)
        for path in (beside, report_path(self.results, self._bench_name)):
            try:
                report = json.loads(path.read_text(encoding="utf-8"))
                older = path.stat().st_mtime_ns < written_ns
            except (OSError, ValueError):
                continue
            if not isinstance(report, dict) or older:
                continue
            if self._run_pid > 0 and report.get("run_pid") != self._run_pid:
                continue
            if path == beside or report.get("journal") == str(journal.resolve()):
                return dict(report)
        return {}

    def _look_at_files(self) -> None:
        """Learn how the latest run ended where its journal is gone already."""
        if self.path is not None:
            return
        files = self.folder.find(RUN_SUFFIX)
        self._unusable &= set(files)
        for file in files[:FILES_TRIED]:
            if self._last_file is not None and self._last_file[0] == file:
                return
            if file not in self._unusable and (found := _ending_in(file.path)) is not None:
                with self.lock:
                    self._last_file, self._last_header = (file, found[0]), found[1]
                return
            self._unusable.add(file)

    def _files_problem(self) -> str:
        """Return why what was read says nothing of the bench any more: its files, or the folder
        that the next run would record in, have gone. Empty where they are there."""
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
        view = self.view
        end = view.end
        by_file = None if self._last_file is None or self.path is not None else self._last_file[1]
        another = ""
        saves = self.bench_holder is not None and self.bench_holder.pid == self._run_pid
        if self.bench_holder is not None and self.holder is None and not saves:
            another = f"process {self.bench_holder.pid} ({self.bench_holder.user})"
        lives = self.holder is not None or saves
        unfinished = [mark for mark in self._marks if mark.state == "running" and not lives]
        for mark in unfinished:
            if not another and mark.run is not None and mark.run.lives:  # its lock was removed
                another = f"process {mark.run.pid} ({mark.user})"
        refuses = [mark.in_words() for mark in self._marks if mark.refuses]
        report = self._report
        failed = bool(report) and report.get("safe") is not True
        if failed:
            refuses.append(f"the guard could not make the bench safe: {report.get('failures')}")
        return Facts(
            run_lives=lives,
            held_by_another=another,
            recorded=self._shown is not None,
            other_bench=self._other_bench,
            ended=end is not None or (by_file is not None and by_file["closed"]),
            exit=end.exit if end is not None else 0 if by_file is None else int(by_file["exit"]),
            holding=view.holding,
            off_failed=view.off_failed,
            force_N=view.force_N if view.recording and view.point is not None else None,
            silent_s=self.silent_s(now),
            recording=view.recording and view.point is not None,
            guarded=self._guarded,
            unsafe="; ".join(dict.fromkeys(refuses))[:1000],
            pressed=self._pressed(),
            unfinished=bool(unfinished),
            guard_reported=bool(report) and not failed,
            problem=self._problem or ("the journal is still being read" if self.behind else ""),
            bench_problem=self._locks_problem or self._plan_problem or self._files_problem(),
        )

    def silent_s(self, now: float | None = None) -> float:
        """Return for how long the journal has not grown."""
        return (time.monotonic() if now is None else now) - self._grew_s

    def _pressed(self) -> str:
        """Return what was reported to be still pressed, empty for nothing."""
        marks = (mark for mark in self._marks if mark.state == "stopped" and not mark.released)
        pressed = [mark.report for mark in marks]
        if self._report.get("pressed") and self._report.get("released") is not True:
            pressed.append(str(self._report["pressed"]))
        return "; ".join(pressed)[:500]

    def course(self) -> StopCourse | None:
        """Return how far the stop that was asked for has come, None if none was."""
        stop = self.stop
        if stop is None:
            return None
        report = self._report
        said = f"{report.get('cause', '')}; {report.get('pressed', '')}".strip("; ")
        return stop_course(
            StopSigns(
                since_s=time.monotonic() - stop.at_s,
                presses=stop.presses,
                pid=stop.holder.pid,
                process_lives=lives(stop.holder.pid),
                reacted=stop.reacted,
                ended=stop.end is not None,
                exit=0 if stop.end is None else stop.end.exit,
                status=""
                if stop.end is None
                else f"{stop.end.status}, {stop.end.points_done} points, {stop.end.reason}",
                guard_pid=stop.guard_pid,
                heartbeat_timeout_s=self.heartbeat_timeout_s,
                guard_report=f"The guard of the run had to act: {said}" if report else "",
                guard_safe=report.get("safe") is True,
                recording=stop.journal is not None,
                bench_safe=self.word.word == "safe",
                pressed=self._pressed(),
            )
        )

    @property
    def last_file(self) -> dict[str, Any] | None:
        """What the latest run file says, where no journal is shown."""
        return None if self._last_file is None else self._last_file[1]

    # --- stopping -------------------------------------------------------------------------------

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
        wider = end_the_run is None and self.stop is not None and self.stop.run_only
        again = self.press_again()
        if again is not None and not wider:
            return again
        target, journal = self._target()
        holder = (end_the_run or ask_to_stop)(target)
        with self.lock:
            self.stop = Stop(holder, journal, run_only=end_the_run is not None)
            return self.stop

    def _target(self) -> tuple[Path, Path | None]:
        """Return the locked file whose holder is to be stopped: the journal of the run that is
        shown; for a run that records elsewhere, the lock of the bench."""
        path = self.path
        if path is not None and holder_of(path) is not None:
            return path, path
        for name in self._names:
            file = lock_file(name)
            if holder_of(file) is not None:
                return file, None
        if path is not None and self.view.end is None and not self._report:
            raise NotStoppedError(
                "the run's process is gone, and its guard has not reported yet",
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


def _ending_in(path: Path) -> tuple[dict[str, Any], RunHeader] | None:
    """Return how the run of a run file ended, and its header; None for a file that is of no run
    here."""
    try:
        with RunFile.open(path) as run:
            outcome, header = run.outcome, run.header
    except RigError:
        return None
    if outcome.imported:
        return None
    ending = {
        "exit": outcome.exit,
        "closed": not outcome.reason.startswith((NEVER_CLOSED, DAMAGED)),
        "status": outcome.status,
        "procedure": header.procedure,
        "mark": header.mark,
        "file": path.name,
    }
    return ending, header
