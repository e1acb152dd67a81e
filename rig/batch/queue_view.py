"""What the queue of a batch holds. Any process may ask, also while a worker writes."""

from __future__ import annotations

import contextlib
import json
import sqlite3
from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, Self

from rig.batch.plan.conditions import BatchCondition
from rig.batch.queue_file import connected
from rig.batch.queue_records import Claim, RemainingWork, RunRow, RunState
from rig.core.errors import ExitCode

ROW = (
    "number, condition, repeat, state, code, reason, bench_s, points_done, points_planned,"
    " (SELECT count(*) FROM attempt a WHERE a.run = run.number) AS attempts,"
    " (SELECT procedure FROM condition c WHERE c.id = run.condition) AS procedure,"
    " json_extract(summary, '$.trials') AS trials,"
    " json_extract(summary, '$.valid_trials') AS valid_trials"
)
"""Columns of a `RunRow`."""
LATEST_FIRST = "julianday(ended) DESC, ended DESC, number DESC"
"""Order of the runs that have ended. Their times are local: as text they are not in order across a
change from summer time; as Julian days they have ms."""
AT_ONCE = 1000
"""Number of runs that are read at once."""
LATEST = 20
"""Number of complete runs of a condition from which it is seen how long a run takes."""


class QueueView:
    """An open queue, which is read only."""

    def __init__(self, path: Path, connection: sqlite3.Connection):
        self.path = path
        self._sql = connection

    @classmethod
    def open(cls, path: Path) -> Self:
        """Open an existing queue. Raises ConfigurationError if there is none, QueueNotOpenedError
        if it cannot be opened here, QueueDamagedError if the file is not a queue."""
        return cls(path, connected(path, writing=False))

    def close(self) -> None:
        """Close the file."""
        self._sql.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def is_whole(self, schema: str) -> bool:
        """Return whether SQLite finds nothing wrong with the file, every index and reference
        included, and its tables and indexes are those that the statements of `schema` make."""
        found = [row[0] for row in self._sql.execute("PRAGMA integrity_check(1)").fetchall()]
        if found != ["ok"] or self._sql.execute("PRAGMA foreign_key_check").fetchone() is not None:
            return False
        made_by = "SELECT type, name, sql FROM sqlite_master ORDER BY type, name"
        with contextlib.closing(sqlite3.connect(":memory:")) as empty:
            empty.executescript(schema)
            wanted = empty.execute(made_by).fetchall()
        return [tuple(row) for row in self._sql.execute(made_by).fetchall()] == wanted

    # --- the batch as a whole -------------------------------------------------------------------

    def meta(self, key: str, default: str = "") -> str:
        """Return an entry about the batch as a whole."""
        row = self._sql.execute("SELECT value FROM meta WHERE key = ?", (key,)).fetchone()
        return default if row is None else str(row[0])

    def counts(self) -> dict[RunState, int]:
        """Return the number of runs in each state."""
        found = dict.fromkeys(("queued", "running", "done", "failed", "set-aside"), 0)
        found.update(self._sql.execute("SELECT state, count(*) FROM run GROUP BY state").fetchall())
        return found  # type: ignore[return-value]

    def remaining(self) -> RemainingWork:
        """Return the work that is queued or running, with the rests between runs."""
        rows = self._sql.execute(
            "SELECT n, n * (c.estimate_s + c.rest_s), n * c.spread_s, n * c.size_B"
            " FROM condition c JOIN"
            " (SELECT condition, count(*) AS n FROM run WHERE state IN ('queued', 'running')"
            " GROUP BY condition) ON condition = c.id"
        ).fetchall()
        return RemainingWork(
            sum(row[0] for row in rows),
            sum(row[1] for row in rows),
            sum(row[2] ** 2 for row in rows) ** 0.5,
            sum(row[3] for row in rows),
        )

    def bench_s(self, number: int | None = None) -> float:
        """Return the bench time of all attempts, or of those at one run, in s."""
        query = "SELECT coalesce(sum(bench_s), 0) FROM run"
        where = ((), "") if number is None else ((number,), " WHERE number = ?")
        return float(self._sql.execute(query + where[1], where[0]).fetchone()[0])

    def condition(self, name: str) -> BatchCondition:
        """Return a condition by its id."""
        row = self._sql.execute("SELECT * FROM condition WHERE id = ?", (name,)).fetchone()
        return _condition_of(row)

    def conditions(self) -> dict[str, BatchCondition]:
        """Return all conditions by id, in the order of the batch file."""
        rows = self._sql.execute("SELECT * FROM condition ORDER BY place")
        return {row["id"]: _condition_of(row) for row in rows.fetchall()}

    def rows(self, states: Sequence[RunState] = ()) -> Iterator[RunRow]:
        """Yield the runs in the order of the queue, in constant memory."""
        where = f"WHERE state IN ({','.join('?' * len(states))})" if states else ""
        cursor = self._sql.execute(
            f"SELECT {ROW} FROM run {where} ORDER BY number",
            tuple(states),
        )
        while rows := cursor.fetchmany(AT_ONCE):
            for row in rows:
                yield RunRow(**dict(row))

    def retried(self) -> int:
        """Return the number of runs that were tried more than once."""
        query = "SELECT count(DISTINCT run) FROM attempt WHERE attempt > 1"
        return int(self._sql.execute(query).fetchone()[0])

    def latest(self, states: Sequence[RunState], most: int) -> list[RunRow]:
        """Return the runs that ended last, latest first."""
        cursor = self._sql.execute(
            f"SELECT {ROW} FROM run WHERE state IN ({','.join('?' * len(states))})"
            f" AND ended IS NOT NULL ORDER BY {LATEST_FIRST} LIMIT ?",
            (*states, most),
        )
        return [RunRow(**dict(row)) for row in cursor]

    def invalid(self, most: int) -> tuple[int, list[RunRow]]:
        """Return the number of runs that are done and have invalid points, and the latest of
        them, latest first."""
        where = "FROM run WHERE state = 'done' AND code = ?"
        code = int(ExitCode.FINISHED_WITH_FAILURES)
        number = self._sql.execute(f"SELECT count(*) {where}", (code,)).fetchone()[0]
        cursor = self._sql.execute(
            f"SELECT {ROW} {where} ORDER BY {LATEST_FIRST} LIMIT ?", (code, most)
        )
        return int(number), [RunRow(**dict(row)) for row in cursor]

    def references(self) -> list[BatchCondition]:
        """Return the conditions that are references, in the order of the batch file."""
        rows = self._sql.execute("SELECT * FROM condition WHERE reference = 1 ORDER BY place")
        return [_condition_of(row) for row in rows.fetchall()]

    def summaries(self, condition: str) -> list[tuple[int, dict[str, Any]]]:
        """Return number and summary of the runs of a condition that are done, in their order."""
        rows = self._sql.execute(
            "SELECT number, summary FROM run WHERE condition = ? AND state = 'done'"
            " AND summary IS NOT NULL ORDER BY number",
            (condition,),
        )
        return [(row[0], json.loads(row[1])) for row in rows]

    def first_summary_with(self, figure: str, since: int) -> tuple[int, dict[str, Any]] | None:
        """Return the first run from number `since` on that is done and whose summary has a
        figure."""
        row = self._sql.execute(
            "SELECT number, summary FROM run WHERE state = 'done' AND number >= ?"
            " AND json_extract(summary, ?) IS NOT NULL ORDER BY number LIMIT 1",
            (since, f'$."{figure}"'),
        ).fetchone()
        return None if row is None else (row[0], json.loads(row[1]))

    def attempts(self, number: int) -> dict[str, int]:
        """Return the number of a run's attempts that ended for each kind of reason."""
        return dict(
            self._sql.execute(
                "SELECT kind, count(*) FROM attempt WHERE run = ? AND kind != '' GROUP BY kind",
                (number,),
            ).fetchall()
        )

    def failed_in_a_row(self, most: int) -> int:
        """Return the number of latest ended runs, up to `most`, that have failed without one done
        since."""
        rows = self._sql.execute(
            "SELECT state FROM run WHERE ended IS NOT NULL AND state IN ('done', 'failed')"
            f" ORDER BY {LATEST_FIRST} LIMIT ?",
            (most,),
        ).fetchall()
        states = [row[0] for row in rows]
        return states.index("done") if "done" in states else len(states)

    def failures_of(self, condition: str) -> int:
        """Return the number of runs of a condition that have failed for good."""
        return int(
            self._sql.execute(
                "SELECT count(*) FROM run WHERE condition = ? AND state = 'failed'", (condition,)
            ).fetchone()[0]
        )

    # --- single runs ----------------------------------------------------------------------------

    def upcoming(self) -> Claim | None:
        """Return the run that would be claimed next; None where none is left."""
        row = self._sql.execute(
            "SELECT number, repeat, condition FROM run WHERE state = 'queued'"
            " ORDER BY number LIMIT 1"
        ).fetchone()
        return None if row is None else self._claim(row)

    def unfinished(self) -> Claim | None:
        """Return the claim of a worker that died during a run; None if there is none."""
        row = self._sql.execute(
            "SELECT number, repeat, condition FROM run WHERE state = 'running' LIMIT 1"
        ).fetchone()
        return None if row is None else self._claim(row, further=0)

    def began(self, claim: Claim) -> datetime:
        """Return when an attempt began."""
        row = self._sql.execute(
            "SELECT began FROM attempt WHERE run = ? AND attempt = ?", (claim.number, claim.attempt)
        ).fetchone()
        return datetime.fromisoformat(row[0])

    def unprocessed(self) -> list[tuple[int, str]]:
        """Return number and procedure of the finished runs whose files are still to be made."""
        rows = self._sql.execute(
            "SELECT number, procedure FROM run JOIN condition ON condition.id = run.condition"
            " WHERE processed IS NULL AND state IN ('done', 'failed') ORDER BY number"
        )
        return [(row[0], row[1]) for row in rows]

    def events(self, most: int) -> list[tuple[str, str, str]]:
        """Return the latest events (time, level, text), oldest first."""
        rows = self._sql.execute(
            "SELECT time, level, text FROM event ORDER BY id DESC LIMIT ?", (most,)
        ).fetchall()
        return [(row[0], row[1], row[2]) for row in reversed(rows)]

    def has_requests(self) -> bool:
        """Return whether the supervisor has requests to take."""
        return self._sql.execute("SELECT 1 FROM request LIMIT 1").fetchone() is not None

    def _claim(self, row: sqlite3.Row, further: int = 1) -> Claim:
        condition = self._sql.execute(
            "SELECT * FROM condition WHERE id = ?", (row["condition"],)
        ).fetchone()
        before = self._sql.execute(
            "SELECT count(*) FROM attempt WHERE run = ?", (row["number"],)
        ).fetchone()[0]
        return Claim(
            row["number"],
            before + further,
            row["repeat"],
            _condition_of(condition),
            max(condition["estimate_s"], self._longest_s(row["condition"])),
            condition["spread_s"],
            condition["size_B"],
        )

    def _longest_s(self, condition: str) -> float:
        """Return the longest bench time of the latest complete runs of a condition, in s, without
        those that were interrupted or tried again; 0 if there are none."""
        found = self._sql.execute(
            "SELECT coalesce(max(bench_s), 0) FROM (SELECT r.bench_s FROM run r"
            " WHERE r.condition = ? AND r.state = 'done'"
            " AND (SELECT count(*) FROM attempt a WHERE a.run = r.number) = 1"
            " ORDER BY r.number DESC LIMIT ?)",
            (condition, LATEST),
        )
        return float(found.fetchone()[0])


def _condition_of(row: sqlite3.Row) -> BatchCondition:
    return BatchCondition(
        row["id"],
        row["experiment"],
        row["procedure"],
        json.loads(row["settings"]),
        json.loads(row["varied"]),
        bool(row["reference"]),
        row["rest_s"],
    )
