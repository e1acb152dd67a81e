"""How the latest run ended, by its run file: its journal may be gone already."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

from rig.core.errors import RigError
from rig.files.journal.reader import DAMAGED, NEVER_CLOSED
from rig.files.journal.values import RunHeader
from rig.files.naming import JOURNAL_SUFFIX, RUN_SUFFIX
from rig.files.runfile.reader import RunFile
from rig.page.folder import FoundFile, ResultsFolder

FILES_TRIED = 20
"""Latest run files of which the first that can be read says how the latest run ended."""


class LatestFile:
    """The latest run file of a results folder that is of a run of this program."""

    def __init__(self, lock: threading.Lock):
        self._lock = lock
        self.file: FoundFile | None = None
        self.ending: dict[str, Any] | None = None
        """What it says of the run's end; None until one was found."""
        self.header: RunHeader | None = None
        self._unusable: set[FoundFile] = set()
        """Run files that cannot be read, or that were imported."""

    def look(self, folder: ResultsFolder) -> None:
        """Find it again, where another one has come."""
        files = _latest_run_first(folder)
        self._unusable &= set(files)
        for file in files[:FILES_TRIED]:
            if self.file == file:
                return
            if file not in self._unusable and (found := _ending_in(file.path)) is not None:
                with self._lock:
                    self.file = file
                    self.ending, self.header = found
                return
            self._unusable.add(file)


def _latest_run_first(folder: ResultsFolder) -> list[FoundFile]:
    """Return the run files of a folder in the order of their runs, the latest first.

    A run that is complete has left its file alone, written at its end. Of any other run the journal
    is there as well, and its last record is the run's: `rig recover` may write the file much later.
    """
    recorded_ns = {one.path: one.mtime_ns for one in folder.find(JOURNAL_SUFFIX)}

    def ended_ns(file: FoundFile) -> int:
        return recorded_ns.get(file.path.with_suffix(JOURNAL_SUFFIX), file.mtime_ns)

    return sorted(folder.find(RUN_SUFFIX), key=ended_ns, reverse=True)


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
