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

One process writes runs (the worker, who holds the bench); any may read (`rig.batch.queue_view`) and
leave a request (`Queue.add_request`).
"""

from __future__ import annotations

import contextlib
import functools
import json
import sqlite3
from collections.abc import Callable, Iterator, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, Self, TypeVar

from rig.batch.plan.conditions import BatchCondition, BatchPlan
from rig.batch.queue_file import QueueWriteError, connected, remedy
from rig.batch.queue_records import AttemptResult, Claim, RunEstimate, RunState
from rig.batch.queue_view import QueueView
from rig.core.atomic import replacing
from rig.core.errors import RigError

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


class Queue(QueueView):
    """An open queue that is written to: what `QueueView` reads, and the transactions. Each method
    that writes is one transaction, durable when it returns."""

    def __init__(self, path: Path, connection: sqlite3.Connection):
        super().__init__(path, connection)
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
    def open(cls, path: Path) -> Self:
        """Open an existing queue to write to it. Raises ConfigurationError if there is none,
        QueueNotOpenedError if it cannot be opened here, QueueDamagedError if the file is not a
        queue."""
        return cls(path, connected(path, writing=True))

    def close_log(self) -> None:
        """Merge the write-ahead log into the one file, which can then be read from a read-only
        folder. Does nothing while another process has the file open."""
        with contextlib.suppress(sqlite3.OperationalError):
            self._sql.execute("PRAGMA journal_mode = DELETE")

    # --- the batch as a whole -------------------------------------------------------------------

    @_patient
    def set_meta(self, key: str, value: str) -> None:
        """Record an entry about the batch as a whole."""
        with self._transaction():
            self._sql.execute("INSERT OR REPLACE INTO meta VALUES (?, ?)", (key, value))

    # --- the worker -----------------------------------------------------------------------------

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

    @_patient
    def add_request(self, kind: str) -> None:
        """Leave a request for the supervisor, from another process."""
        with self._transaction():
            self._sql.execute("INSERT INTO request (time, kind) VALUES (?, ?)", (_now(), kind))

    @_patient
    def take_requests(self) -> list[str]:
        """Return the requests since the last call, oldest first; they are deleted."""
        if not self.has_requests():
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
                remedy(error.sqlite_errorname, self.path.parent, "then: rig batch resume"),
            ) from error


def give_up(error: QueueWriteError) -> None:
    """Raise the error: for `Queue.wait_for_disk` where nothing waits."""
    raise error


def _condition_row(place: int, condition: BatchCondition, estimate: RunEstimate) -> tuple[Any, ...]:
    return (
        *(condition.id, place, condition.experiment, condition.procedure),
        *(json.dumps(dict(condition.settings)), json.dumps(dict(condition.varied))),
        *(int(condition.reference), condition.rest_s, *estimate),
    )


def _now() -> str:
    return datetime.now().astimezone().isoformat(timespec="microseconds")
