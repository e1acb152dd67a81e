"""What is known of a bench beside the journal of its run: who holds its lock, which marks it has,
what a guard has reported.
"""

from __future__ import annotations

import json
import math
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rig.core.errors import RigError
from rig.files.journal.values import RunHeader
from rig.files.naming import JOURNAL_SUFFIX
from rig.run.locks.bench_mark import BenchMark, made_safe_ns, read_marks
from rig.run.locks.lock_holder import LockHolder, holder_of, lock_file
from rig.run.making_safe.guard_report import GUARD_SUFFIX, report_path


def is_last(report: Mapping[str, Any]) -> bool:
    """Return whether this is the last report of a guard, which names the file of the run's data.
    Those before come while it still measures and lifts z."""
    return "file" in report


def _changed_ns(path: Path) -> int | None:
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return None


class BenchSigns:
    """The bench of the run that is shown, and that of the bench file that is watched.

    One thread calls `find_names` and `look`; others read under `lock`.
    """

    def __init__(self, results: Path, bench_file: Path | None, lock: threading.Lock):
        self._results, self._lock = results, lock
        self.bench_file = bench_file
        """Bench file that is watched although no run of it is in the folder; None for none."""
        self.names: tuple[str, ...] = ()
        """Names of the addresses of the run's bench, and of the bench file's."""
        self._names_of: Path | None = None
        self._bench_name = ""
        self.heartbeat_timeout_s = 0.0
        self.is_of_another = False
        """True if a bench file is watched and the run that is shown was on another bench."""
        self.holder: LockHolder | None = None
        """The process that holds the bench of the run, or of the bench file."""
        self.marks: list[BenchMark] = []
        self.report: dict[str, Any] = {}
        """What the guard of the run that is shown has reported; empty for nothing."""
        self.made_safe = False
        """True if ``rig make-safe`` has succeeded since the run that is shown last wrote its
        journal, since any guard's report, and since any run began on the bench."""
        self._plan_problem = ""
        self._locks_problem = ""

    @property
    def problem(self) -> str:
        """Why what is seen of the bench cannot be relied on; empty if it can."""
        return self._locks_problem or self._plan_problem

    def find_names(self, shown: Path | None, header: RunHeader | None) -> None:
        """Find the names of the bench's addresses, once for each run. `shown` is the journal or run
        file by which the bench is judged, and `header` what it says of the bench."""
        wanted = shown or self.bench_file
        if wanted is None or self._names_of == wanted:
            return
        from rig.bench.plan import parse_bench, read_bench
        from rig.run.locks.lock import address_names

        own: tuple[str, ...] = ()
        watched: tuple[str, ...] = ()
        problem, name, timeout_s = "", "", 0.0
        if self.bench_file is not None:
            try:
                plan = read_bench(self.bench_file)
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
        with self._lock:
            self._names_of = wanted
            self.names = tuple(dict.fromkeys(own + watched))
            self.is_of_another = bool(header and watched) and not set(own) & set(watched)
            self._plan_problem = problem
            self._bench_name, self.heartbeat_timeout_s = name, timeout_s

    def look(self, shown: Path | None, run_pid: int, locked: dict[int, list[int]]) -> None:
        """Look at locks, marks and reports. `run_pid` is the process that was seen to write the
        journal that is shown, or negative."""
        holder = None
        marks: list[BenchMark] = []
        problem = ""
        made_safe = False
        # Before the marks: a guard writes its mark first, so these are not older than its report.
        report = {} if shown is None else self._guard_report(shown, run_pid)
        try:
            for name in self.names:
                holder = holder or holder_of(lock_file(name), locked)
            marks = read_marks(self.names)
            noted_ns = made_safe_ns(self.names)
            if noted_ns is not None and shown is not None:
                made_safe = noted_ns > self._written_ns(shown)
        except RigError as error:  # no folder that can be trusted: nothing is believed of it
            problem = error.one_line()
        with self._lock:
            self.holder, self.marks, self.report = holder, marks, report
            self.made_safe = made_safe
            self._locks_problem = problem

    def _guard_report(self, shown: Path, run_pid: int) -> dict[str, Any]:
        """Return what the guard of a run has reported; empty for nothing. A report of an earlier
        attempt at the run says nothing of this one."""
        journal = shown.with_suffix(JOURNAL_SUFFIX)
        try:
            written_ns = journal.stat().st_mtime_ns
        except OSError:  # its run file is what is left of it
            written_ns = 0
        beside = journal.with_suffix(GUARD_SUFFIX)
        for path in self._reports(journal):
            try:
                report = json.loads(path.read_text(encoding="utf-8"))
                older = path.stat().st_mtime_ns < written_ns
            except (OSError, ValueError):
                continue
            if not isinstance(report, dict) or older:
                continue
            if run_pid > 0 and report.get("run_pid") != run_pid:
                continue
            if path == beside or report.get("journal") == str(journal.resolve()):
                return dict(report)
        return {}

    def _reports(self, journal: Path) -> tuple[Path, Path]:
        """Return where the guard of a run may have reported."""
        return journal.with_suffix(GUARD_SUFFIX), report_path(self._results, self._bench_name)

    def _written_ns(self, shown: Path) -> float:
        """Return when the files that say how a run has left its bench were last written; infinity
        if none of its own can be looked at."""
        journal = shown.with_suffix(JOURNAL_SUFFIX)
        own = [ns for path in {shown, journal} if (ns := _changed_ns(path)) is not None]
        reports = [ns for path in self._reports(journal) if (ns := _changed_ns(path)) is not None]
        return max(own + reports) if own else math.inf

    @property
    def guard_failed(self) -> bool:
        """True if a guard had to act and could not make the bench safe."""
        return bool(self.report) and self.report.get("safe") is not True

    @property
    def refusals(self) -> list[str]:
        """Reasons, in words, for which the next run on this bench is refused."""
        refuses = [mark.in_words() for mark in self.marks if mark.refuses]
        if self.guard_failed and not self.made_safe:
            failures = self.report.get("failures")
            refuses.append(f"the guard could not make the bench safe: {failures}")
        return list(dict.fromkeys(refuses))

    @property
    def pressed(self) -> str:
        """What was reported to be still pressed; empty for nothing."""
        marks = (mark for mark in self.marks if mark.state == "stopped" and not mark.released)
        pressed = [mark.report for mark in marks]
        said = str(self.report.get("pressed") or "")
        # The guard's mark says what its report says.
        if said and self.report.get("released") is not True and not any(said in x for x in pressed):
            pressed.append(said)
        return "; ".join(pressed)[:500]
