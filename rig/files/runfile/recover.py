"""Recovering and resuming: the journal that a run left, found from either of its files."""

from __future__ import annotations

from pathlib import Path

from rig.core.errors import ExitCode
from rig.files.errors import JournalError, RunFileError
from rig.files.file_kind import MISTYPED, described, kind_of
from rig.files.journal.reader import JournalContents, read_journal
from rig.files.naming import RUN_SUFFIX, journal_path
from rig.files.runfile.compile import compile_run
from rig.files.runfile.reader import RunFile


def recover(file: Path | str) -> Path:
    """Compile what a journal holds; returns the path of the run file.

    Takes the journal or the run file that it belongs to. The journal of a run that did not complete
    stays, so that the run can be resumed. Raises JournalError when there is nothing to do.
    """
    return compile_run(_journal_of(Path(file), "recover"), retire=True)


def interrupted(file: Path | str) -> JournalContents:
    """Return the journal of an interrupted run, from itself or its run file, to be continued.

    Raises JournalError for a run that is complete, for a journal that is damaged before its end,
    and for whatever else the file is.
    """
    contents = read_journal(_journal_of(Path(file), "resume"))
    if contents.complete:
        raise JournalError(contents.path, None, "nothing to resume: the run is complete")
    if contents.header.origin is not None:
        name = contents.header.origin.file_name
        raise JournalError(
            contents.path, None, "an import cannot be resumed", f"`rig import` {name} again"
        )
    contents.require_continuable()
    return contents


def _journal_of(file: Path, purpose: str) -> Path:
    """Return the path of the journal: this file, or the one beside it. Raises JournalError, which
    says what the file is instead; its exit code is that of other commands for such a file."""
    kind = kind_of(file)
    if kind == "journal":
        return file
    if kind == "folder":
        raise JournalError(file, None, *described(file, kind))
    beside, run_file = journal_path(file), file.with_suffix(RUN_SUFFIX)
    if file.suffix == RUN_SUFFIX and kind_of(beside) == "journal":
        return beside
    if kind == "missing" and kind_of(run_file) == "hdf5":
        file, kind = run_file, "hdf5"
    if kind == "hdf5":
        raise _why_not(file, purpose)
    code = None if kind in MISTYPED else ExitCode.FOUND_WRONG
    raise JournalError(file, None, *described(file, kind), code)


def _why_not(file: Path, purpose: str) -> JournalError:
    """Return why an HDF5 file without a journal cannot be recovered or resumed."""
    try:
        with RunFile.open(file) as run:
            outcome = run.outcome
    except RunFileError as error:
        return JournalError(file, None, error.reason, error.hint, error.code)
    if outcome.status == "complete":
        return JournalError(file, None, f"nothing to {purpose}: the run is {outcome.extent()}")
    return JournalError(
        file,
        None,
        f"cannot {purpose} it: its journal {journal_path(file).name} is not beside it; the run "
        f"file itself is there ({outcome.extent()})",
    )
