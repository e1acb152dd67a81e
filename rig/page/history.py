"""The runs of a results folder: read once, then followed; found by a name, never by a path."""

from __future__ import annotations

import hashlib
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rig.core.errors import RigError
from rig.core.text import shown_name
from rig.files.describe import describe, describe_processed
from rig.files.naming import JOURNAL_SUFFIX, RUN_SUFFIX
from rig.files.processed.reader import ProcessedFile
from rig.files.runfile.reader import RunFile
from rig.page.folder import FoundFile, ResultsFolder
from rig.page.view import INVALID

MOST_RUNS = 20_000
AT_ONCE = 20
"""Run files that are read before the index is handed on."""
PROCESSED = "processed"
KINDS = {
    ".h5": "application/x-hdf5",
    ".rigj": "application/octet-stream",
    ".png": "image/png",
    ".svg": "image/svg+xml",
    ".sha256": "text/plain; charset=utf-8",
    ".json": "application/json",
}
"""Files of a run that are handed out, by their suffix, with their media type."""


@dataclass(frozen=True)
class IndexedRun:
    """A run as the list shows it."""

    id: str
    path: Path
    mtime_ns: int
    fields: dict[str, Any]


class RunIndex:
    """The runs of a results folder."""

    def __init__(self, results: Path):
        self._folder = ResultsFolder(results)
        self._results = results
        self._runs: dict[Path, IndexedRun] = {}
        self._by_id: dict[str, IndexedRun] = {}
        self._lock = threading.Lock()
        self.complete = False
        """True once every file that was there has been read."""

    def update(self) -> bool:
        """Read some of the files that are new or have changed; return whether more are left."""
        files = self._folder.find(RUN_SUFFIX)
        compiled = {file.path.with_suffix("") for file in files}
        # The journal of a run that can be resumed lies beside its run file: it is one run.
        files += [
            file
            for file in self._folder.find(JOURNAL_SUFFIX)
            if file.path.with_suffix("") not in compiled
        ]
        files = files[:MOST_RUNS]
        there = {file.path for file in files}
        for path in [path for path in self._runs if path not in there]:
            self._forget(path)
        read = 0
        for file in files:
            known = self._runs.get(file.path)
            if known is not None and known.mtime_ns == file.mtime_ns:
                continue
            if file.path.suffix == JOURNAL_SUFFIX and known is not None:
                continue  # it grows; how it ended is known once it is a run file
            self._add(file)
            read += 1
            if read >= AT_ONCE:
                return True
        self.complete = True
        return False

    def _add(self, file: FoundFile) -> None:
        name = file.path.relative_to(self._results).as_posix()
        run_id = hashlib.sha256(name.encode("utf-8", "surrogateescape")).hexdigest()[:16]
        run = IndexedRun(run_id, file.path, file.mtime_ns, _fields(file.path) | {"id": run_id})
        with self._lock:
            self._runs[file.path] = self._by_id[run_id] = run

    def _forget(self, path: Path) -> None:
        with self._lock:
            run = self._runs.pop(path)
            self._by_id.pop(run.id, None)

    def rows(
        self, procedure: str = "", sample: str = "", outcome: str = "", most: int = 500
    ) -> dict[str, Any]:
        """Return the runs that match, newest first: at most `most`, and how many there are."""
        with self._lock:
            runs = list(self._runs.values())
        found = [
            run.fields
            for run in runs
            if procedure in ("", run.fields["procedure"])
            and sample.lower() in str(run.fields["sample"]).lower()
            and outcome in ("", run.fields["status"])
        ]
        found.sort(key=_begun, reverse=True)
        procedures = sorted({str(run.fields["procedure"]) for run in runs})
        return {
            "runs": found[:most],
            "matching": len(found),
            "of": len(runs),
            "procedures": procedures,
            "complete": self.complete,
        }

    def detail(self, run_id: str) -> dict[str, Any] | None:
        """Return what a run's file says, and its files by name; None for an unknown run."""
        with self._lock:
            run = self._by_id.get(run_id)
        if run is None:
            return None
        files = self._files(run)
        shown: dict[str, Any] = {
            "id": run_id,
            "name": shown_name(run.path.name),
            "files": [
                {"name": name, "bytes": size}
                for name, path in sorted(files.items())
                if (size := _size(path)) is not None
            ],
        }
        if run.path.suffix == RUN_SUFFIX:
            try:
                with RunFile.open(run.path) as opened:
                    shown["summary"] = describe(run.path, opened.header, opened.outcome)
                    shown["summary"]["file"] = shown["name"]
                    if (results := opened.results) is not None:
                        shown["summary"]["results"] = results.values
            except RigError as error:
                shown["problem"] = error.one_line()
            shown["processed"] = _processed(files)
        return shown

    def file(self, run_id: str, name: str) -> tuple[Path, str] | None:
        """Return a file of a run and its media type; None for any that is not one of them. The
        name, as `detail` has it, is looked up among the run's own files and never becomes part of
        a path."""
        with self._lock:
            run = self._by_id.get(run_id)
        if run is None:
            return None
        path = self._files(run).get(name)
        return None if path is None else (path, KINDS[path.suffix])

    def _files(self, run: IndexedRun) -> dict[str, Path]:
        """Return the files of a run by their names as they are shown: of its own folder and of
        ``processed``."""
        stem = run.path.name.removesuffix(run.path.suffix)
        found: dict[str, Path] = {}
        for folder in (run.path.parent, run.path.parent / PROCESSED):
            if folder.name == PROCESSED and folder.is_symlink():
                continue
            try:
                entries = list(folder.iterdir())
            except OSError:
                continue
            for path in entries:
                own = path.name.startswith((f"{stem}.", f"{stem}-"))
                if own and path.suffix in KINDS and path.is_file() and not path.is_symlink():
                    found[shown_name(path.name)] = path
        return found


def _size(path: Path) -> int | None:
    """Return the size of a file; None for one that was removed meanwhile."""
    try:
        return path.stat().st_size
    except OSError:
        return None


def _begun(fields: dict[str, Any]) -> str:
    """Return the beginning of a run as its file's name has it, for sorting."""
    return str(fields["start"] or "")[:19].replace(":", "-") or str(fields["name"])


def _processed(files: dict[str, Path]) -> list[dict[str, Any]]:
    """Return what detectors have found, from the processed files of a run."""
    found = []
    for path in files.values():
        if path.parent.name == PROCESSED and path.suffix == RUN_SUFFIX:
            try:
                with ProcessedFile.open(path) as opened:
                    found.append(describe_processed(opened) | {"file": shown_name(path.name)})
            except RigError:
                continue
    return found


def _fields(path: Path) -> dict[str, Any]:
    """Return what the list shows of a run file, or of a journal by its name."""
    fields: dict[str, Any] = {
        "name": shown_name(path.name),
        "procedure": "",
        "sample": "",
        "start": None,
        "status": "unreadable",
        "mark": "",
        "points": "",
        "exit": None,
        "duration_s": None,
    }
    if path.suffix == JOURNAL_SUFFIX:
        parts = path.stem.split("_")
        middle = parts[1] if len(parts) > 1 else ""
        return fields | {"status": "journal", "procedure": middle}
    try:
        with RunFile.open(path) as run:
            header, outcome = run.header, run.outcome
            invalid = sum(map(bool, run.column(INVALID))) if INVALID in run.columns() else 0
    except RigError as error:
        return fields | {"problem": error.one_line()[:300]}
    return fields | {
        "procedure": header.procedure,
        "sample": header.sample.name,
        "start": header.start_time,
        "status": outcome.status,
        "mark": header.mark,
        "points": f"{outcome.points_done}/{outcome.points_planned}"
        + (f", {outcome.points_done - invalid} valid" if invalid else ""),
        "exit": outcome.exit,
        "duration_s": outcome.duration,
    }
