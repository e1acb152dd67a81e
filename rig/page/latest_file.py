"""How the latest run ended, by its run file: its journal may be gone already."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

from rig.core.errors import RigError
from rig.files.journal.reader import DAMAGED, NEVER_CLOSED
from rig.files.journal.values import RunHeader
from rig.files.naming import RUN_SUFFIX
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
        files = folder.find(RUN_SUFFIX)
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
