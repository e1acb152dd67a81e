"""Names of run files: a folder a day, a number a run of that day."""

from __future__ import annotations

import errno
import re
from datetime import datetime
from pathlib import Path

RUN_SUFFIX = ".h5"
JOURNAL_SUFFIX = ".rigj"
CHECKSUM_SUFFIX = ".sha256"

_DAY = re.compile(r"\d{4}-\d{2}-\d{2}\Z")
_RUN = re.compile(r"_r(\d+)\.(?:h5|rigj)\Z")


def next_run_path(results: Path | str, procedure: str, when: datetime) -> Path:
    """Return the next run's path: ``2026-11-21/2026-11-21T22-00-00_sweep_r017.h5``.

    Makes the day's folder; raises NotADirectoryError where a file has its name. Two processes can
    be given the same number: the exclusive ``JournalWriter.create`` decides, and the loser
    (FileExistsError) asks again.
    """
    folder = Path(results) / f"{when:%Y-%m-%d}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:  # not that of a journal, after which another name is tried
        raise NotADirectoryError(errno.ENOTDIR, "not a folder", str(results)) from error
    numbers = [int(found[1]) for p in folder.iterdir() if (found := _RUN.search(p.name))]
    number = max(numbers, default=0) + 1
    return folder / f"{when:%Y-%m-%dT%H-%M-%S}_{procedure}_r{number:03d}{RUN_SUFFIX}"


def results_folder_of(journal: Path | str) -> Path:
    """Return the results folder of a journal: the folder above its day's folder. For a journal that
    lies anywhere else, such as a copy, it is the journal's own folder.
    """
    folder = Path(journal).parent
    return folder.parent if _DAY.match(folder.absolute().name) else folder


def journal_path(run_file: Path | str) -> Path:
    """Return the path of the journal beside a run file."""
    return Path(run_file).with_suffix(JOURNAL_SUFFIX)


def checksum_path(run_file: Path | str) -> Path:
    """Return the path of the checksum beside a file: ``<run>.h5.sha256``."""
    run_file = Path(run_file)
    return run_file.with_name(run_file.name + CHECKSUM_SUFFIX)
