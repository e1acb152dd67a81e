"""Determines the outcome of a run whose worker died, from the run's own files alone.

The guard has made the bench safe and compiled what there was before this is asked (the worker's
lock is the guard's as well). A journal that ends whole, or a run file without a journal, is a
run that is done; it is not taken again. Any other is continued where it was interrupted.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.batch.plan.procedures import installed
from rig.batch.queue_records import AttemptResult
from rig.core.errors import RigError
from rig.core.validated import stored_settings
from rig.files.errors import JournalError
from rig.files.journal.reader import JournalContents, read_journal
from rig.files.naming import RUN_SUFFIX
from rig.files.runfile.reader import RunFile
from rig.files.runfile.recover import interrupted
from rig.run.holds import HOLD_OVER, ON_HOLD
from rig.run.results import results_of

if TYPE_CHECKING:
    from rig.files.journal.values import RunHeader
    from rig.run.points import Reading
    from rig.run.procedure import Procedure

log = logging.getLogger("rig")


def outcome_from_journal(journal: Path, began: datetime | None = None) -> AttemptResult:
    """Return how the attempt ended that has this journal, or had it before it was compiled.

    Its bench time is that of the whole run; or that of the attempt alone, where it is given when
    that `began`. On a real bench the time of a run includes that between its attempts.
    """
    if journal.exists():
        try:
            contents = read_journal(journal)
        except JournalError as error:
            return AttemptResult("died", "died", reason=error.one_line())
        readings = [point.reading for point in contents.kept()]
        codes = [(event.time, event.code) for event in contents.events]
        end = contents.ends[-1] if contents.complete else None
        return _ended(
            contents.header,
            None if end is None else end.exit,
            readings,
            *_times_s(contents.header, contents.last_time, _holds(codes), began),
        )
    run_file = journal.with_suffix(RUN_SUFFIX)
    if run_file.exists():
        try:
            with RunFile.open(run_file) as run:
                outcome = run.outcome
                code = outcome.exit if outcome.status == "complete" else None
                times_s = _times_s(run.header, outcome.duration, _holds(run.event_codes()), began)
                return _ended(run.header, code, run.readings(), *times_s)
        except RigError as error:
            return AttemptResult("died", "died", reason=error.one_line())
    return AttemptResult("died", "died", reason="it died before its first record")


def journal_to_resume(journal: Path) -> JournalContents | None:
    """Return the contents of the journal that a run continues; None if it starts afresh.

    A journal that cannot be continued is archived first.
    """
    if not journal.exists():
        return None
    try:
        return interrupted(journal)
    except JournalError:
        archive_files(journal)
        return None


def archive_files(journal: Path) -> Path:
    """Rename a run's files, so that it can begin again; nothing is deleted. Returns the new name of
    the journal."""
    for number in range(1, 1000):
        archived = journal.with_name(f"{journal.stem}.{number}{journal.suffix}")
        if not archived.exists():
            break
    for old in (journal, journal.with_suffix(RUN_SUFFIX)):
        if old.exists():
            old.rename(archived.with_suffix(old.suffix))
    return archived


def _holds(codes: Sequence[tuple[float, str]]) -> list[tuple[float, float]]:
    """Return begin and end, in s since the run's start, of the holds that have ended, by the times
    and codes of a run's events."""
    found, begun_s = list[tuple[float, float]](), None
    for time_s, code in codes:
        if code == ON_HOLD:
            begun_s = time_s
        elif code == HOLD_OVER and begun_s is not None:
            found.append((begun_s, time_s))
            begun_s = None
    return found


def _times_s(
    header: RunHeader,
    run_s: float,
    holds: Sequence[tuple[float, float]],
    began: datetime | None,
) -> tuple[float, float]:
    """Return the bench time without holds, and that on hold, up to a time since the run's start, of
    the attempt that `began` then; without that of the whole run."""
    elapsed_s = run_s
    if began is not None and header.start_time is not None:
        until = datetime.fromisoformat(header.start_time) + timedelta(seconds=run_s)
        elapsed_s = min(run_s, max(0.0, (until - began).total_seconds()))
    since_s = run_s - elapsed_s
    held_s = sum(max(0.0, min(over_s, run_s) - max(at_s, since_s)) for at_s, over_s in holds)
    return elapsed_s - held_s, held_s


def _ended(
    header: RunHeader,
    code: int | None,
    readings: Sequence[Reading],
    bench_s: float,
    on_hold_s: float,
) -> AttemptResult:
    """Return the result of a run that was completed with this exit code, or, where it is None, of
    one that was interrupted."""
    if code is None:
        return AttemptResult(
            "died",
            "died",
            reason="the process that ran it died",
            bench_s=bench_s,
            on_hold_s=on_hold_s,
            points_done=len(readings),
            points_planned=len(header.points),
        )
    procedure = installed(header.procedure)
    settings = stored_settings(procedure.Settings, header.settings)
    return AttemptResult(
        "complete",
        code=code,
        bench_s=bench_s,
        on_hold_s=on_hold_s,
        points_done=len(readings),
        points_planned=max(len(readings), len(header.points)),
        summary=_summary(procedure(settings), readings),
    )


def _summary(procedure: Procedure, readings: Sequence[Reading]) -> Mapping[str, Any]:
    """Return what was computed from the readings at the end of the run, or would have been. A bug
    in it costs the results and nothing else, as it does there (`rig.run.saving`)."""
    try:
        # False: the summary is without the true values of a simulated bench.
        return results_of(procedure, readings, simulated=False).values
    except Exception as error:
        log.warning("no results of the run", exc_info=error)
        return {}
