"""What a page shows of a batch: its status as the terminal has it, its runs, its references."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import Any

from rig.batch.folder import QUEUE, BatchFolder
from rig.batch.queue_records import RunRow
from rig.batch.queue_view import QueueView
from rig.batch.report.heartbeat import read_heartbeat
from rig.batch.report.status import status_of
from rig.batch.running import is_running
from rig.core.errors import RigError
from rig.core.settings import unit_of

MOST_RUNS = 200
"""Runs of the queue that are listed of each state."""
MOST_FIGURES = 500


def latest_batch(results: Path) -> BatchFolder | None:
    """Return the batch of a results folder that runs, or the latest where none does; None if there
    is none."""
    found: list[tuple[bool, float, Path]] = []
    for queue in results.glob(f"*/{QUEUE}"):
        try:
            found.append(
                (is_running(BatchFolder(queue.parent)), queue.stat().st_ctime, queue.parent)
            )
        except OSError:
            continue
    return BatchFolder(max(found)[2]) if found else None


def running_batch(results: Path) -> BatchFolder | None:
    """Return the batch of a results folder that a supervisor runs now, None if there is none."""
    folder = latest_batch(results)
    return folder if folder is not None and is_running(folder) else None


def night(results: Path) -> dict[str, Any]:
    """Return the latest batch, ready for JSON; ``{}`` if there is none, ``{"problem": ...}`` for
    one that cannot be read."""
    folder = latest_batch(results)
    if folder is None:
        return {}
    try:
        status = status_of(folder, is_running(folder))
        with QueueView.open(folder.queue) as queue:
            lists = {
                "queued": [_row(row) for row in _first(queue, "queued")],
                "running": [_row(row) for row in _first(queue, "running")],
                "failed": [_row(row) for row in queue.latest(("failed",), MOST_RUNS)],
                "left_out": [_row(row) for row in _first(queue, "set-aside")],
                "done": [_row(row) for row in queue.latest(("done",), MOST_RUNS)],
            }
            retried = queue.retried()
            drift = _drift(queue)
    except RigError as error:
        return {"problem": error.one_line()}
    except (OSError, sqlite3.Error) as error:  # its disk fails, or another process keeps it locked
        return {"problem": f"the batch {folder.path.name} cannot be read: {error}"}
    beat = read_heartbeat(folder.heartbeat) if status.running else None
    shown = status.as_object()
    shown["folder"] = folder.path.name
    return shown | {
        "lists": lists,
        "retried": retried,
        "drift": drift,
        "heartbeat": None if beat is None else {"state": beat.state, "message": beat.message},
    }


def _first(queue: QueueView, state: Any) -> list[RunRow]:
    rows = []
    for row in queue.rows((state,)):
        rows.append(row)
        if len(rows) >= MOST_RUNS:
            break
    return rows


def _row(row: RunRow) -> dict[str, Any]:
    return {
        "run": row.number,
        "condition": row.condition,
        "repeat": row.repeat,
        "state": row.state,
        "code": row.code,
        "reason": row.reason[:300] or row.doubt,
        "bench_s": row.bench_s,
        "points": f"{row.points_done}/{row.points_planned}" if row.points_planned else "",
        "attempts": row.attempts,
    }


def _drift(queue: QueueView) -> list[dict[str, Any]]:
    """Return the watched figures of each reference by run, as differences from its first run."""
    from rig.batch.execute.drift import watched_figures
    from rig.batch.execute.terms import BatchTerms
    from rig.batch.plan.procedures import installed

    terms = BatchTerms.of(queue, BatchFolder(queue.path.parent))
    shown = []
    for condition in queue.references():
        named = terms.file.experiment[condition.experiment].drift
        for key, figure in watched_figures(installed(condition.procedure).drift, named).items():
            values = [
                (number, float(summary[key]))
                for number, summary in queue.summaries(condition.id)[:MOST_FIGURES]
                if isinstance(summary.get(key), (int, float))
            ]
            if values:
                shown.append(
                    {
                        "condition": condition.id,
                        "figure": figure.what,
                        "key": key,
                        "tolerance": figure.tolerance,
                        "unit": unit_of(key) or "",
                        "runs": [number for number, _ in values],
                        "change": [value - values[0][1] for _, value in values],
                    }
                )
    return shown
