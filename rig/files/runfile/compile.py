"""Compiling: a journal becomes a run file, HDF5 with NeXus attributes.

The way of the data, each module once:

1. ``journal.reader.read_journal`` indexes the journal: points, events, segments, no samples.
2. ``table`` makes the columns; ``write_entry`` and ``write_plots`` write all but the samples.
3. ``sample_walk`` reads the samples, ``write_samples`` writes them to where ``sample_groups`` says.
4. ``read_back`` compares the file with what the steps before have seen.
5. ``hdf5.publishing`` gives the file its name.

The file appears under its name only when it is whole, on the disk, and has read back equal to the
journal. An earlier file of the same run is replaced. The same journal gives the same bytes.
"""

from __future__ import annotations

import contextlib
import errno
import os
from pathlib import Path

from rig.core.atomic import sync_folder
from rig.core.text import in_shell
from rig.files.checksum import sha256_of
from rig.files.errors import JournalError, RecordingError, RunFileError, room_for, why_not_opened
from rig.files.hdf5.guarded_file import GuardedFile
from rig.files.hdf5.nexus import plain_text
from rig.files.hdf5.publishing import publishing
from rig.files.hdf5.safe_reading import DAMAGE, refuse_links, text_of
from rig.files.journal.reader import JournalContents, read_journal
from rig.files.journal.writer import lock_journal
from rig.files.naming import JOURNAL_SUFFIX, RUN_SUFFIX, checksum_path
from rig.files.runfile.read_back import differences
from rig.files.runfile.sample_walk import SampleWalk
from rig.files.runfile.table import point_table
from rig.files.runfile.write_entry import write_entry, write_root
from rig.files.runfile.write_samples import SampleWriter

SHOWS_DAMAGE = (errno.EINVAL, errno.EFAULT, errno.EOVERFLOW)
"""Error numbers that are due to what is in a file: HDF5 asks the system for bytes at an address
that a damaged file names."""


def compile_run(
    journal: Path | str, target: Path | str | None = None, *, retire: bool = False
) -> Path:
    """Compile a journal into its run file (beside it unless ``target`` says otherwise).

    With ``retire`` the journal of a complete run is deleted afterwards; that of any other run
    stays, since resuming needs it. The file is read-only; ``<file>.sha256`` beside it is in
    sha256sum's format.

    Raises JournalError (no journal; being written), RecordingError (disk), RunFileError (the file
    does not read back equal: the journal stays, nothing is published; or the target is another
    run's file).
    """
    journal = Path(journal)
    target = journal.with_suffix(RUN_SUFFIX) if target is None else Path(target)
    descriptor = _open(journal)
    try:
        lock_journal(journal, descriptor, shared=True)
        contents = read_journal(journal)
        _refuse_other_run(target, contents)
        recover = f"`rig recover {in_shell(journal)}`; the journal is untouched"
        try:
            _publish(contents, target)
        except OSError as error:
            cause = f"cannot be written: {error.strerror or error}"
            hint = f"{room_for(error)}, then {recover}"
            raise RecordingError(target, cause, hint) from error
        except (ImportError, MemoryError) as error:
            cause = f"cannot be written: {type(error).__name__}: {error}"
            hint = (
                "not enough memory, or the installation is damaged: raise the limit (ulimit -v), "
                f"then {recover}"
            )
            raise RecordingError(target, cause, hint) from error
        if retire and contents.complete:
            journal.unlink()
            sync_folder(journal.parent)
    finally:
        os.close(descriptor)
    return target


def journal_equals_file(journal: Path | str, file: Path | str) -> bool:
    """Return whether the file holds everything that the journal holds, sample by sample."""
    return not differences(SampleWalk(read_journal(journal)).exhaust(), Path(file))


def _open(journal: Path) -> int:
    if journal.suffix == RUN_SUFFIX:
        hint = f"its journal would be {journal.with_suffix(JOURNAL_SUFFIX).name}"
        raise JournalError(journal, None, "a run file, not a journal", hint)
    try:
        return os.open(journal, os.O_RDONLY | os.O_NONBLOCK)  # a pipe is refused when it is read
    except OSError as error:
        raise JournalError(journal, None, error.strerror or str(error)) from error


def _publish(contents: JournalContents, target: Path) -> None:
    """Write beside the target, check, make durable, rename; leaves nothing behind if it fails."""
    with publishing(target) as part:
        walk = _write(contents, part, target.name)
        findings = differences(walk, part)
        if findings:
            raise RunFileError(target, f"does not read back equal: {findings[0]}", "run it again")


def _write(contents: JournalContents, path: Path, name: str) -> SampleWalk:
    """Write the file, and return the walk over the journal's samples. Raises OSError if the disk
    fails."""
    import h5py

    table, walk = point_table(contents), SampleWalk(contents)
    guarded = GuardedFile(path)
    try:
        with h5py.File(guarded, "w") as file:
            entry = write_root(file, contents, name)
            write_entry(entry, contents, table)
            guarded.check()
            samples = SampleWriter(entry, contents)
            for piece in walk.pieces():
                samples.write(piece)
                guarded.check()
            samples.finish(walk.blocks)
            if contents.header.layout.default not in entry or not table.ids:
                entry.attrs["default"] = "waveforms" if "waveforms" in entry else "points"
        guarded.check()
    except (RuntimeError, ValueError, TypeError, KeyError) as error:
        guarded.check()
        reason = f"cannot be compiled: {type(error).__name__}: {error}"
        raise JournalError(
            contents.path, None, reason, "keep the journal; this is a bug"
        ) from error
    finally:
        guarded.close()
    return walk


def _refuse_other_run(target: Path, contents: JournalContents) -> None:
    """Raise RunFileError if the target exists and is another run's file.

    A damaged file is replaced. One whose checksum shows that it is damaged is not even opened: HDF5
    may loop for ever on it.
    """
    if not target.exists():
        return
    with contextlib.suppress(OSError, UnicodeDecodeError):
        if checksum_path(target).read_text(encoding="utf-8").split()[:1] != [sha256_of(target)]:
            return
    import h5py

    try:
        with h5py.File(target) as file:
            refuse_links(file)
            found = text_of(file["entry/identifier_experiment"])
    except DAMAGE as error:
        number = error.errno if isinstance(error, OSError) else None
        if number and number not in SHOWS_DAMAGE:  # it may be sound, and another run's
            reason = why_not_opened(error) or os.strerror(number)
            raise RunFileError(
                target,
                f"cannot be replaced unread: {reason}",
                "move it away, or compile to another name",
            ) from error
        return
    if found != plain_text(contents.header.run_uuid):
        raise RunFileError(
            target, "is the file of another run", "move it away, or compile to another name"
        )
