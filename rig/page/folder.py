"""The journals and run files of a results folder, listed again only where a folder changed."""

from __future__ import annotations

import os
import stat
import time
from dataclasses import dataclass
from pathlib import Path

from rig.files.naming import JOURNAL_SUFFIX, RUN_SUFFIX

BATCH_RUNS = "runs"
"""Folder of the runs within the folder of a batch."""
TRUSTED_NS = 2_000_000_000
"""Time after a folder's change from which a listing holds until the next: two changes within the
clock's step have one time, and some file systems count it in steps of 2 s."""


@dataclass(frozen=True)
class FoundFile:
    """A journal or run file in the folder of results."""

    path: Path
    mtime_ns: int
    inode: int


class ResultsFolder:
    """Journals and run files below a results folder: in the folder itself, in those of days and
    of batches."""

    def __init__(self, path: Path):
        self.path = path
        self._listed: dict[Path, tuple[int, int, list[Path]]] = {}
        """Change, time of the listing, names: by folder."""

    def find(self, suffix: str) -> list[FoundFile]:
        """Return the files of this suffix, newest first. Links and anything but regular files are
        left out. Never raises: what cannot be read is not there."""
        found = []
        for folder in self._folders():
            for path in self._names(folder):
                if path.suffix != suffix:
                    continue
                try:
                    status = path.lstat()
                except OSError:
                    continue
                if stat.S_ISREG(status.st_mode):
                    found.append(FoundFile(path, status.st_mtime_ns, status.st_ino))
        return sorted(found, key=lambda one: one.mtime_ns, reverse=True)

    def _folders(self) -> list[Path]:
        folders = [self.path]
        for path in self._subfolders(self.path):
            folders.append(path)
            if not (path / BATCH_RUNS).is_symlink():
                folders.append(path / BATCH_RUNS)
        return folders

    @staticmethod
    def _subfolders(folder: Path) -> list[Path]:
        try:
            return [
                Path(entry.path)
                for entry in os.scandir(folder)
                if entry.is_dir(follow_symlinks=False) and not entry.name.startswith(".")
            ]
        except OSError:
            return []

    def _names(self, folder: Path) -> list[Path]:
        try:
            now_ns = time.time_ns()
            changed = folder.stat().st_mtime_ns  # the results folder itself may be a link
            before = self._listed.get(folder)
            if before is not None and before[0] == changed and before[1] - changed > TRUSTED_NS:
                return before[2]
            names = [
                Path(entry.path)
                for entry in os.scandir(folder)
                if entry.name.endswith((JOURNAL_SUFFIX, RUN_SUFFIX))
                and not entry.name.startswith(".")
            ]
        except OSError:
            self._listed.pop(folder, None)
            return []
        self._listed[folder] = (changed, now_ns, names)
        return names
