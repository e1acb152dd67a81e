"""The queue of a batch: its runs and their outcomes, in one SQLite file.

The plan is written once, whole, before anything begins. From then on a run changes its state only
in a transaction that is on the disk (write-ahead log, full sync) before anybody acts on it: a run
is claimed before its first motion, and finished after its data are safe. Whoever dies in between
leaves a claim, which the next worker settles from the run's own journal
(`rig.batch.execute.crash_recovery`).

    queued -> running -> done | failed
       ^         |
       +---------+  stopped, retried, died: continued from its journal
    queued -> set-aside   left out: its condition has failed too often

One process writes runs (the worker, who holds the bench); any may read, and ask (`request`).
"""

from __future__ import annotations

import contextlib
import functools
import json
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Concatenate, Literal, NamedTuple, ParamSpec, Self, TypeVar

from rig.batch.plan.conditions import BatchCondition, BatchPlan
from rig.batch.queue_file import QueueConnection, QueueDamagedError, QueueWriteError
from rig.core.atomic import replacing
from rig.core.errors import ConfigurationError, RigError

RunState = Literal["queued", "running", "done", "failed", "set-aside"]
Ending = Literal["complete", "stopped", "failed", "died"]
BUSY_S = 30.0
"""Longest wait for a transaction of another process, in s."""
AT_ONCE = 1000
HOLDS, PRESSES = "holds", "presses"
"""Entries about the batch: how many holds its runs have had, and how often they have pressed
the object."""

SCHEMA = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE condition (
    id TEXT PRIMARY KEY, place INTEGER NOT NULL, experiment INTEGER NOT NULL,
    procedure TEXT NOT NULL, settings TEXT NOT NULL, varied TEXT NOT NULL,
    reference INTEGER NOT NULL, rest_s REAL NOT NULL, estimate_s REAL NOT NULL,
    spread_s REAL NOT NULL, size_B INTEGER NOT NULL, set_aside TEXT NOT NULL DEFAULT ''
) WITHOUT ROWID;
CREATE TABLE run (
    number INTEGER PRIMARY KEY, condition TEXT NOT NULL REFERENCES condition (id),
    repeat INTEGER NOT NULL, state TEXT NOT NULL DEFAULT 'queued',
    code INTEGER, reason TEXT NOT NULL DEFAULT '', summary TEXT, began TEXT, ended TEXT,
    bench_s REAL NOT NULL DEFAULT 0, points_done INTEGER NOT NULL DEFAULT 0,
    points_planned INTEGER NOT NULL DEFAULT 0, processed TEXT
);
CREATE INDEX run_by_state ON run (state, condition);
CREATE INDEX run_by_condition ON run (condition, state, number);
CREATE TABLE attempt (
    run INTEGER NOT NULL REFERENCES run (number), attempt INTEGER NOT NULL,
    began TEXT NOT NULL, ended TEXT, ending TEXT, kind TEXT NOT NULL DEFAULT '',
    code INTEGER, reason TEXT NOT NULL DEFAULT '', bench_s REAL NOT NULL DEFAULT 0,
    PRIMARY KEY (run, attempt)
) WITHOUT ROWID;
CREATE TABLE event (
    id INTEGER PRIMARY KEY, time TEXT NOT NULL, level TEXT NOT NULL, text TEXT NOT NULL
);
CREATE TABLE request (id INTEGER PRIMARY KEY, time TEXT NOT NULL, kind TEXT NOT NULL);
"""


_Given = ParamSpec("_Given")
_Result = TypeVar("_Result")


def _patient(
    write: Callable[Concatenate[Queue, _Given], _Result],
) -> Callable[Concatenate[Queue, _Given], _Result]:
    """Give a method of the queue that is one transaction another try, for as long as the queue's
    `wait_for_disk` returns."""

    @functools.wraps(write)
    def patiently(self: Queue, /, *given: _Given.args, **named: _Given.kwargs) -> _Result:
        while True:
            try:
                return write(self, *given, **named)
            except QueueWriteError as error:
                self.wait_for_disk(error)

    return patiently


class RunEstimate(NamedTuple):
    """Expected duration and size of a run."""

    duration_s: float
    spread_s: float
    """Standard deviation of its duration."""
    size_B: int = 0
    """Size of its run file."""


@dataclass(frozen=True)
class Claim:
    """A run that a worker has taken on, and which attempt at it this is."""

    number: int
    attempt: int
    repeat: int
    condition: BatchCondition
    estimate_s: float
    spread_s: float
    size_B: int = 0
    """Size of its run file at most, as planned."""


@dataclass(frozen=True)
class AttemptResult:
    """Outcome of an attempt."""

    ending: Ending
    kind: str = ""
    """Kind of a failure, by which it is retried (`rig.batch.plan.policy.FailureKind`); or empty."""
    code: int = 0
    reason: str = ""
    bench_s: float = 0.0
    points_done: int = 0
    points_planned: int = 0
    summary: Mapping[str, Any] | None = None
    holds: int = 0
    """Holds of this attempt, which are counted for the batch, not for each run."""
    presses: int = 0
    """Number of presses of the object; counted likewise."""


@dataclass(frozen=True)
class RemainingWork:
    """Work that a batch has still to do, as planned."""

    runs: int
    bench_s: float
    spread_s: float
    """Standard deviation of `bench_s`, runs of one condition wrong together."""
    size_B: int = 0
    """Size of the run files to come."""


@dataclass(frozen=True)
class RunRow:
    """One run and its state."""

    number: int
    condition: str
    repeat: int
    state: RunState
    code: int | None
    reason: str
    bench_s: float
    points_done: int
    points_planned: int
    attempts: int


class Queue:
    """An open queue. Every method is one transaction, durable when it returns."""

    def __init__(self, path: Path, connection: sqlite3.Connection):
        self.path = path
        self._sql = connection
        self.wait_for_disk: Callable[[QueueWriteError], None] = give_up
        """Is called where a transaction was not written, and returns when it may be tried again;
        what it raises ends the try. Without another function the error is raised."""

    @classmethod
    def create(
        cls,
        path: Path,
        plan: BatchPlan,
        estimates: Mapping[str, RunEstimate],
        meta: Mapping[str, str],
    ) -> Self:
        """Return a new queue of all runs of a plan, with what is expected of a run by condition. It
        appears under its name when it is whole."""
        with (
            replacing(path) as beside,
            contextlib.closing(sqlite3.connect(beside, isolation_level=None)) as sql,
        ):
            sql.executescript("PRAGMA journal_mode = DELETE; PRAGMA synchronous = FULL;")
            sql.execute("BEGIN")
            for statement in filter(str.strip, SCHEMA.split(";")):
                sql.execute(statement)
            sql.executemany("INSERT INTO meta VALUES (?, ?)", meta.items())
            sql.executemany(
                "INSERT INTO condition (id, place, experiment, procedure, settings, varied,"
                " reference, rest_s, estimate_s, spread_s, size_B) VALUES (?,?,?,?,?,?,?,?,?,?,?)",
                (
                    _condition_row(place, condition, estimates[condition.id])
                    for place, condition in enumerate(plan.conditions.values())
                ),
            )
            sql.executemany(
                "INSERT INTO run (number, condition, repeat) VALUES (?, ?, ?)",
                ((run.number, run.condition, run.repeat) for run in plan.runs),
            )
            sql.execute("COMMIT")
        return cls.open(path)

    @classmethod
    def open(cls, path: Path, *, read_only: bool = False) -> Self:
        """Open an existing queue. Raises ConfigurationError if there is none, or if the file is not
        a queue."""
        if not path.is_file():
            raise ConfigurationError(
                f"{path.parent} holds no batch: there is no {path.name} in it",
                "name the folder of a batch, as `rig batch run` printed it",
            )
        mode = "ro" if read_only else "rw"
        try:
            sql = sqlite3.connect(
                f"{path.absolute().as_uri()}?mode={mode}",
                uri=True,
                factory=QueueConnection,
                timeout=BUSY_S,
                isolation_level=None,
                check_same_thread=False,
            )
            sql.execute("SELECT 1 FROM run LIMIT 1")
            (found,) = sql.execute("PRAGMA quick_check(1)").fetchone()
            if found != "ok":
                raise sqlite3.DatabaseError(found)
            if not read_only:
                sql.execute("PRAGMA journal_mode = WAL")
                sql.execute("PRAGMA synchronous = FULL")
        except (sqlite3.DatabaseError, QueueDamagedError) as error:
            why = error.__cause__ if isinstance(error, QueueDamagedError) else error
            raise QueueDamagedError(str(why), path) from error
        sql.path = path
        sql.row_factory = sqlite3.Row
        return cls(path, sql)

    def close_log(self) -> None:
        """Merge the write-ahead log into the one file, which can then be read from a read-only
        folder. Does nothing while another process has the file open."""
        with contextlib.suppress(sqlite3.OperationalError):
            self._sql.execute("PRAGMA journal_mode = DELETE")

    def close(self) -> None:
        """Close the file."""
        self._sql.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- what is known of the batch -------------------------------------------------------------

    def meta(self, key: str, default: str = "") -> str:
        """Return an entry about the batch as a whole."""
        row = self._sql.execute("SELECT value FROM meta WHERE key = ?", (key,)).fetchone()
        return default if row is None else str(row[0])

    @_patient
    def set_meta(self, key: str, value: str) -> None:
        """Record an entry about the batch as a whole."""
        with self._transaction():
            self._sql.execute("INSERT OR REPLACE INTO meta VALUES (?, ?)", (key, value))

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

    def rows(self, states: Sequence[RunState] = ()) -> Iterator[RunRow]:
        """Yield the runs in the order of the queue, in constant memory."""
        where = f"WHERE state IN ({','.join('?' * len(states))})" if states else ""
        cursor = self._sql.execute(
            "SELECT number, condition, repeat, state, code, reason, bench_s, points_done,"
            " points_planned, (SELECT count(*) FROM attempt a WHERE a.run = run.number) AS attempts"
            f" FROM run {where} ORDER BY number",
            tuple(states),
        )
        while rows := cursor.fetchmany(AT_ONCE):
            for row in rows:
                yield RunRow(**dict(row))

    def latest(self, states: Sequence[RunState], most: int) -> list[RunRow]:
        """Return the runs that ended last, latest first."""
        cursor = self._sql.execute(
            "SELECT number, condition, repeat, state, code, reason, bench_s, points_done,"
            " points_planned, (SELECT count(*) FROM attempt a WHERE a.run = run.number) AS attempts"
            f" FROM run WHERE state IN ({','.join('?' * len(states))}) AND ended IS NOT NULL"
            " ORDER BY number DESC LIMIT ?",
            (*states, most),
        )
        return [RunRow(**dict(row)) for row in cursor]

    def references(self) -> list[BatchCondition]:
        """Return the conditions that are references, in the order of the batch file."""
        rows = self._sql.execute("SELECT * FROM condition WHERE reference = 1 ORDER BY place")
        return [_condition_of(row) for row in rows.fetchall()]

    def summaries(self, condition: str) -> list[tuple[int, dict[str, Any]]]:
        """Yield number and summary of the runs of a condition that are done, in their order."""
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
            " ORDER BY ended DESC, number DESC LIMIT ?",
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

    # --- the worker -----------------------------------------------------------------------------

    def upcoming(self) -> Claim | None:
        """Return the run that would be claimed next; None where none is left."""
        row = self._sql.execute(
            "SELECT number, repeat, condition FROM run WHERE state = 'queued'"
            " ORDER BY number LIMIT 1"
        ).fetchone()
        return None if row is None else self._claim(row)

    @_patient
    def claim(self, number: int) -> Claim:
        """Claim a queued run: from here on it is running, whatever becomes of the caller.

        Raises RigError if the run is not queued, because another process has claimed it.
        """
        with self._transaction():
            row = self._sql.execute(
                "SELECT number, repeat, condition FROM run WHERE number = ? AND state = 'queued'",
                (number,),
            ).fetchone()
            if row is None:
                raise RigError(f"run {number} is not queued: another process has claimed it")
            claim = self._claim(row)
            now = _now()
            self._sql.execute(
                "INSERT INTO attempt (run, attempt, began) VALUES (?, ?, ?)",
                (number, claim.attempt, now),
            )
            self._sql.execute(
                "UPDATE run SET state = 'running', began = coalesce(began, ?) WHERE number = ?",
                (now, number),
            )
        return claim

    @_patient
    def finish(self, claim: Claim, ended: AttemptResult, state: RunState) -> None:
        """End an attempt and set the run's state: ``queued`` if it is to be continued."""
        now = _now()
        with self._transaction():
            self._sql.execute(
                "UPDATE attempt SET ended = ?, ending = ?, kind = ?, code = ?, reason = ?,"
                " bench_s = ? WHERE run = ? AND attempt = ?",
                (
                    *(now, ended.ending, ended.kind, ended.code, ended.reason, ended.bench_s),
                    *(claim.number, claim.attempt),
                ),
            )
            self._sql.execute(
                "UPDATE run SET state = ?, code = ?, reason = ?, summary = ?, ended = ?,"
                " bench_s = bench_s + ?, points_done = ?, points_planned = ? WHERE number = ?",
                (
                    *(state, ended.code, ended.reason),
                    None if ended.summary is None else json.dumps(ended.summary),
                    None if state == "queued" else now,
                    *(ended.bench_s, ended.points_done, ended.points_planned, claim.number),
                ),
            )

    def unfinished(self) -> Claim | None:
        """Return the claim of a worker that died during a run; None if there is none."""
        row = self._sql.execute(
            "SELECT number, repeat, condition FROM run WHERE state = 'running' LIMIT 1"
        ).fetchone()
        return None if row is None else self._claim(row, further=0)

    @_patient
    def set_aside(self, condition: str, reason: str) -> int:
        """Leave out what is queued of a condition; returns how many runs these are."""
        with self._transaction():
            self._sql.execute(
                "UPDATE condition SET set_aside = ? WHERE id = ?", (reason, condition)
            )
            changed = self._sql.execute(
                "UPDATE run SET state = 'set-aside', reason = ?, ended = ?"
                " WHERE condition = ? AND state = 'queued'",
                (reason, _now(), condition),
            )
        return changed.rowcount

    @_patient
    def put_back(self) -> int:
        """Queue failed and left-out runs again, and return their number."""
        with self._transaction():
            self._sql.execute("UPDATE condition SET set_aside = ''")
            self._sql.execute(
                "UPDATE attempt SET kind = '' WHERE run IN"
                " (SELECT number FROM run WHERE state IN ('failed', 'set-aside'))"
            )
            changed = self._sql.execute(
                "UPDATE run SET state = 'queued', ended = NULL, processed = NULL WHERE state IN"
                " ('failed', 'set-aside')"
            )
        return changed.rowcount

    # --- files of finished runs -----------------------------------------------------------------

    def unprocessed(self) -> list[tuple[int, str]]:
        """Return number and procedure of the finished runs whose files are still to be made."""
        rows = self._sql.execute(
            "SELECT number, procedure FROM run JOIN condition ON condition.id = run.condition"
            " WHERE processed IS NULL AND state IN ('done', 'failed') ORDER BY number"
        )
        return [(row[0], row[1]) for row in rows]

    @_patient
    def set_processed(self, number: int, what: Mapping[str, Any]) -> None:
        """Record which files were made of a run, by what they are."""
        with self._transaction():
            self._sql.execute(
                "UPDATE run SET processed = ? WHERE number = ?", (json.dumps(what), number)
            )

    # --- events and requests -------------------------------------------------------------

    @_patient
    def add_event(self, level: str, text: str) -> None:
        """Record an event, which `rig batch status` shows."""
        with self._transaction():
            self._sql.execute(
                "INSERT INTO event (time, level, text) VALUES (?, ?, ?)", (_now(), level, text)
            )

    def events(self, most: int) -> list[tuple[str, str, str]]:
        """Return the latest events (time, level, text), oldest first."""
        rows = self._sql.execute(
            "SELECT time, level, text FROM event ORDER BY id DESC LIMIT ?", (most,)
        ).fetchall()
        return [(row[0], row[1], row[2]) for row in reversed(rows)]

    @_patient
    def add_request(self, kind: str) -> None:
        """Leave a request for the supervisor, from another process."""
        with self._transaction():
            self._sql.execute("INSERT INTO request (time, kind) VALUES (?, ?)", (_now(), kind))

    @_patient
    def take_requests(self) -> list[str]:
        """Return the requests since the last call, oldest first; they are deleted."""
        if self._sql.execute("SELECT 1 FROM request LIMIT 1").fetchone() is None:
            return []
        with self._transaction():
            rows = self._sql.execute("SELECT kind FROM request ORDER BY id").fetchall()
            self._sql.execute("DELETE FROM request")
        return [str(row[0]) for row in rows]

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[None]:
        """Commit the block as a whole or not at all. Raises QueueWriteError where the disk does not
        take it."""
        try:
            self._sql.execute("BEGIN IMMEDIATE")
            try:
                yield
                self._sql.execute("COMMIT")
            except BaseException:
                if self._sql.in_transaction:  # a full disk has ended it already
                    self._sql.execute("ROLLBACK")
                raise
        except sqlite3.OperationalError as error:
            raise QueueWriteError(
                f"{self.path}: the queue cannot be written: {error}",
                "free the disk, then: rig batch resume",
            ) from error

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
            condition["estimate_s"],
            condition["spread_s"],
            condition["size_B"],
        )


def give_up(error: QueueWriteError) -> None:
    """Raise the error: for `Queue.wait_for_disk` where nothing waits."""
    raise error


def _condition_row(place: int, condition: BatchCondition, estimate: RunEstimate) -> tuple[Any, ...]:
    return (
        *(condition.id, place, condition.experiment, condition.procedure),
        *(json.dumps(dict(condition.settings)), json.dumps(dict(condition.varied))),
        *(int(condition.reference), condition.rest_s, *estimate),
    )


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


def _now() -> str:
    return datetime.now().astimezone().isoformat(timespec="microseconds")
