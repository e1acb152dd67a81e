"""Recovering: what a killed run left becomes a run file."""

from __future__ import annotations

from pathlib import Path

from rig.recording.compiled import compile_run
from rig.recording.errors import JournalError
from rig.recording.naming import JOURNAL_SUFFIX, RUN_SUFFIX, journal_path


def recover(journal: Path | str) -> Path:
    """Compile what a journal holds; gives the run file.

    Takes the journal or the run file that it belongs to. The journal of a run that did not
    complete stays, so that the run can be resumed. JournalError when there is nothing to do.
    """
    journal = Path(journal)
    if journal.suffix == RUN_SUFFIX:
        run_file, journal = journal, journal_path(journal)
        if not journal.exists() and run_file.exists():
            raise JournalError(run_file, None, "nothing to recover: its run was closed properly")
    if journal.is_dir():
        raise JournalError(journal, None, f"a folder; name a journal in it (*{JOURNAL_SUFFIX})")
    if not journal.exists():
        if journal.with_suffix(RUN_SUFFIX).exists():
            raise JournalError(journal, None, "nothing to recover: its run was closed properly")
        raise JournalError(journal, None, "no such journal")
    return compile_run(journal, retire=True)
