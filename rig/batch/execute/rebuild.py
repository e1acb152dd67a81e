"""Rebuilds the queue of a batch whose file is damaged: the plan from the batch file, and what
became of each run from the run's own files. The damaged file is kept under another name."""

from __future__ import annotations

import contextlib
import json
import sqlite3
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from rig.batch.execute.batch_clock import PASSED_S
from rig.batch.execute.crash_recovery import outcome_from_journal
from rig.batch.execute.prepare import prepare
from rig.batch.execute.start import read_terms, terms_of
from rig.batch.folder import BatchFolder
from rig.batch.plan.conditions import BatchCondition, BatchPlan, PlannedRun
from rig.batch.plan.policy import kind_of
from rig.batch.plan.procedures import installed
from rig.batch.plan.read import read_batch
from rig.batch.plan.settings import BatchFile
from rig.batch.queue import SCHEMA, Queue
from rig.batch.queue_file import QueueNotOpenedError
from rig.batch.queue_records import AttemptResult, RunState
from rig.batch.queue_view import QueueView
from rig.core.errors import ConfigurationError, RigError
from rig.core.text import in_shell
from rig.files.journal.reader import read_journal
from rig.files.journal.values import RunHeader
from rig.files.naming import RUN_SUFFIX
from rig.files.runfile.reader import RunFile

HINT = "name a copy of it, in the folder that its other files are relative to: --file FILE"


def rebuild(
    folder: BatchFolder,
    batch_file: Path | None,
    bench: Path | None,
    now: datetime,
    say: Callable[[str], None],
) -> dict[RunState, int]:
    """Make the queue of a batch again, and return the number of runs in each state.

    `batch_file` and `bench` are needed where they are not where they were when the batch began, or
    where the folder does not say where that was. A run that is complete is done; one whose files
    say that it failed has failed (`rig batch resume --retry-failed` queues it again); any other is
    queued, and continues from its journal. Numbers of attempts, holds and events are lost.

    Raises ConfigurationError if the batch is running, if its queue is sound, or if the batch file
    is not that of the runs.
    """
    for who in ("supervisor", "worker"):
        if folder.is_held(who):
            raise ConfigurationError(
                f"{folder.path}: the batch is running", "stop it first: rig batch stop"
            )
    if is_sound(folder):
        raise ConfigurationError(
            f"the queue of {folder.path} is sound; there is nothing to rebuild",
            f"see: rig batch status {in_shell(folder.path)}",
        )
    terms = read_terms(folder)
    path = batch_file or Path(terms.get("batch_file", folder.batch_file))
    _require_same(path, folder.batch_file)
    if bench is None and terms.get("bench"):
        bench = Path(terms["bench"])
    # As it was begun: calibration records may have expired since.
    begun = datetime.fromisoformat(terms["begun"]) if "begun" in terms else now
    prepared = prepare(path, bench, begun, say, begun=True)
    meta = terms or terms_of(path, prepared, now)
    new = folder.path / "queue.rebuilt.sqlite"
    new.unlink(missing_ok=True)
    try:
        with Queue.create(new, prepared.plan, prepared.estimates, meta) as queue:
            _restore(queue, folder, prepared.plan)
            counts = queue.counts()
            queue.set_meta("state", "rebuilt from the runs' files")
            queue.add_event("warning", "the queue was damaged and has been rebuilt")
            queue.close_log()
    except BaseException:
        new.unlink(missing_ok=True)
        raise
    _put_away(folder.queue)
    new.rename(folder.queue)
    return counts


def is_sound(folder: BatchFolder) -> bool:
    """Return whether a rebuild would not improve the queue of a batch that is not running. A sound
    queue has an intact file and the conditions and runs of the batch file, and the runs whose own
    files are complete are done in it.

    A complete run is settled by `rig batch resume` alone where an attempt at it has begun. Raises
    QueueNotOpenedError where the file cannot be opened, which says nothing about it.
    """
    try:
        with QueueView.open(folder.queue) as queue:
            if not queue.is_whole(SCHEMA):
                return False
            BatchFile.model_validate_json(queue.meta("file"))
            conditions, rows = queue.conditions(), list(queue.rows())
        _, plan, _ = read_batch(folder.batch_file)
    except QueueNotOpenedError:
        raise
    except (RigError, OSError, sqlite3.Error, ValueError):
        return False
    if _as_kept(conditions) != _as_kept(plan.conditions):
        return False
    if [PlannedRun(row.number, row.condition, row.repeat) for row in rows] != list(plan.runs):
        return False
    for row in rows:
        journal = folder.journal(row.number, conditions[row.condition].procedure)
        complete = outcome_from_journal(journal).ending == "complete"
        to_be_settled = row.state in ("queued", "running", "failed") and row.attempts > 0
        if complete != (row.state == "done") and not to_be_settled:
            return False
    return True


def _as_kept(conditions: Mapping[str, BatchCondition]) -> Any:
    """Return conditions with the values that JSON makes of them, as the queue has them."""
    return json.loads(json.dumps([asdict(one) for one in conditions.values()]))


def _require_same(path: Path, copy: Path) -> None:
    """Refuse a batch file that is not the one that the batch began with."""
    try:
        same = path.read_text(encoding="utf-8") == copy.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigurationError(f"{path}: {error.strerror}", HINT) from error
    if not same:
        raise ConfigurationError(f"{path} differs from {copy}, the file of this batch", HINT)


def _restore(queue: Queue, folder: BatchFolder, plan: BatchPlan) -> None:
    """Give each run that has files the state that they show."""
    passed_s = 0.0
    for run in plan.runs:
        condition = plan.conditions[run.condition]
        journal = folder.journal(run.number, condition.procedure)
        if (header := _header_of(journal)) is None:
            continue
        _require_settings(run.number, header, condition)
        ended = outcome_from_journal(journal)
        state: RunState = "done" if ended.ending == "complete" else "queued"
        if state == "queued" and (failed := _failure_of(journal)) is not None:
            ended, state = (
                replace(failed, bench_s=ended.bench_s, on_hold_s=ended.on_hold_s),
                "failed",
            )
        queue.finish(queue.claim(run.number), ended, state)
        passed_s += ended.elapsed_s + condition.rest_s
    queue.set_meta(PASSED_S, f"{passed_s:.6f}")


def _header_of(journal: Path) -> RunHeader | None:
    """Return the header of a run's journal or run file; None if neither can be read."""
    with contextlib.suppress(RigError, OSError):
        return read_journal(journal).header
    with contextlib.suppress(RigError, OSError), RunFile.open(_run_file(journal)) as run:
        return run.header
    return None


def _failure_of(journal: Path) -> AttemptResult | None:
    """Return how a run failed, if that is what its files end with."""
    status, code, reason = "", 0, ""
    with contextlib.suppress(RigError, OSError):
        if journal.exists():
            ends = read_journal(journal).ends
            if ends:
                status, code, reason = ends[-1].status, ends[-1].exit, ends[-1].reason
        else:
            with RunFile.open(_run_file(journal)) as run:
                outcome = run.outcome
                status, code, reason = outcome.status, outcome.exit, outcome.reason
    return AttemptResult("failed", kind_of(code, ()), code, reason) if status == "failed" else None


def _require_settings(number: int, header: RunHeader, condition: BatchCondition) -> None:
    """Refuse a run that the batch file, as it is expanded now, does not have at this number."""
    own = installed(condition.procedure)
    asked = own.Settings.model_validate_json(json.dumps(dict(condition.settings)))
    if header.settings != asked.model_dump(mode="json"):
        raise ConfigurationError(
            f"run {number}: its file has other settings than the batch file gives now",
            "rebuild the queue with the version of the program that the batch began with",
        )


def _run_file(journal: Path) -> Path:
    return journal.with_suffix(RUN_SUFFIX)


def _put_away(queue: Path) -> None:
    """Rename a queue and the files that belong to it; nothing is deleted."""
    number = 1
    while (kept := queue.with_name(f"queue.damaged-{number}.sqlite")).exists():
        number += 1
    for end in ("", "-wal", "-shm", "-journal"):
        old = queue.with_name(queue.name + end)
        if old.exists():
            old.rename(kept.with_name(kept.name + end))
