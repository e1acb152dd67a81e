"""What became of a run whose worker died: told from the run's own files, never guessed.

The guard has made the bench safe and compiled what there was before this is asked (the worker's
lock is the guard's as well). A journal that ends whole, or a run file whose journal is gone, is a
run that is done; it is not taken again. Any other goes on at the point where it was interrupted.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rig.batch.plan.procedures import installed
from rig.batch.queue import Ended
from rig.core.errors import RigError
from rig.files.errors import JournalError
from rig.files.journal.reader import JournalContents, read_journal
from rig.files.naming import RUN_SUFFIX
from rig.files.runfile.reader import RunFile
from rig.files.runfile.recover import interrupted

if TYPE_CHECKING:
    from rig.files.journal.values import RunHeader
    from rig.run.points import Reading


def what_became_of(journal: Path) -> Ended:
    """How the attempt ended whose journal this is, or was before it was compiled."""
    if journal.exists():
        try:
            contents = read_journal(journal)
        except JournalError as error:
            return Ended("died", "died", reason=error.one_line())
        readings = [point.reading for point in contents.kept()]
        end = contents.ends[-1] if contents.complete else None
        return _ended(
            contents.header, None if end is None else end.exit, readings, contents.last_time
        )
    run_file = journal.with_suffix(RUN_SUFFIX)
    if run_file.exists():
        try:
            with RunFile.open(run_file) as run:
                outcome = run.outcome
                code = outcome.exit if outcome.status == "complete" else None
                return _ended(run.header, code, run.readings(), outcome.duration)
        except RigError as error:
            return Ended("died", "died", reason=error.one_line())
    return Ended("died", "died", reason="it died before its first record")


def to_continue(journal: Path) -> JournalContents | None:
    """The journal that a run goes on with; None where it begins afresh.

    One that cannot be continued is kept under another name.
    """
    if not journal.exists():
        return None
    try:
        return interrupted(journal)
    except JournalError:
        put_away(journal)
        return None


def put_away(journal: Path) -> Path:
    """Give a run's files another name, so that it can begin afresh; nothing is deleted."""
    for number in range(1, 1000):
        aside = journal.with_name(f"{journal.stem}.{number}{journal.suffix}")
        if not aside.exists():
            break
    for old in (journal, journal.with_suffix(RUN_SUFFIX)):
        if old.exists():
            old.rename(aside.with_suffix(old.suffix))
    return aside


def _ended(
    header: RunHeader, code: int | None, readings: Sequence[Reading], bench_s: float
) -> Ended:
    """Of a complete run with this exit code, or None for one that was interrupted."""
    if code is None:
        return Ended(
            "died",
            "died",
            reason="the process that ran it died",
            bench_s=bench_s,
            points_done=len(readings),
            points_planned=len(header.points),
        )
    procedure = installed(header.procedure)
    settings = procedure.Settings.model_validate_json(json.dumps(header.settings))
    return Ended(
        "complete",
        code=code,
        bench_s=bench_s,
        points_done=len(readings),
        points_planned=max(len(readings), len(header.points)),
        summary=procedure(settings).summarise(readings),
    )
