"""What a worker records of attempts at a run, apart from those that have a bench."""

from __future__ import annotations

import os
import signal
import sqlite3
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import recorded_run

from rig.batch.execute import worker as working
from rig.batch.execute import worker_link
from rig.batch.execute.worker import Worker
from rig.batch.folder import BatchFolder
from rig.batch.plan.read import parse_batch
from rig.batch.queue import Queue
from rig.batch.queue_records import AttemptResult, RunEstimate
from rig.core.errors import ExitCode, RigError
from rig.files.journal.writer import JournalWriter
from rig.run.outcome import RunOutcome
from rig.run.stopping import NOTHING_CONNECTED, StopFlag, StopRequestedError

BATCH = """
[batch]
name = "night"
[[experiment]]
procedure = "sweep"
"""


@pytest.fixture
def queue(tmp_path: Path) -> Iterator[Queue]:
    """A batch of one run, whose first attempt was interrupted."""
    _, plan, _ = parse_batch(BATCH, "night.toml")
    estimates = dict.fromkeys(plan.conditions, RunEstimate(18.0, 1.0))
    with Queue.create(tmp_path / "queue.sqlite", plan, estimates, {"name": "night"}) as made:
        interrupted = AttemptResult("stopped", bench_s=100.0, points_done=8, points_planned=13)
        made.finish(made.claim(1), interrupted, "queued")
        yield made


def worker_of(queue: Queue) -> Any:
    """A worker of this batch, without a supervisor and a bench."""
    worker: Any = Worker.__new__(Worker)
    worker._folder, worker._queue = BatchFolder(queue.path.parent), queue
    worker._send = lambda *_, **__: None
    worker._clock = SimpleNamespace(used=lambda bench_s: None)
    worker._commands = SimpleNamespace(take_given_up=lambda: False)
    worker._completed_elsewhere = lambda claim: None
    return worker


@pytest.mark.parametrize(
    "ends_it",
    [StopRequestedError(signal.SIGINT, NOTHING_CONNECTED), RigError("the bench is in use")],
    ids=["stopped", "failed"],
)
def test_an_attempt_that_is_over_before_it_has_a_bench_leaves_the_points_of_the_run(
    queue: Queue, ends_it: RigError, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Found by hand: a run with 8 of 13 points was one with 0 of 0 after a Ctrl-C while its bench
    was started again."""
    recorded = AttemptResult("died", points_done=8, points_planned=13)
    monkeypatch.setattr(working, "outcome_from_journal", lambda journal: recorded)
    worker = worker_of(queue)

    def perform(*_: object) -> None:
        raise ends_it

    def conclude(claim: Any, ended: AttemptResult) -> None:
        queue.finish(claim, ended, "queued")
        raise ends_it

    worker._perform, worker._conclude = perform, conclude
    with pytest.raises(RigError), ExitStack() as at_the_end:
        worker._take(queue.upcoming(), at_the_end)
    (row,) = queue.rows()
    assert (row.points_done, row.points_planned) == (8, 13)


def test_a_run_can_be_ended_alone_while_its_bench_is_started(
    queue: Queue, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seen on the simulated bench: `rig batch stop --this-run` did nothing then, and said that it
    had."""
    monkeypatch.setattr(os, "kill", lambda pid, number: None)
    nothing = SimpleNamespace(start=lambda: None)
    monkeypatch.setattr(worker_link.threading, "Thread", lambda **_: nothing)  # type: ignore[attr-defined]
    worker, sent = worker_of(queue), list[dict[str, Any]]()
    worker._send = lambda event, **fields: sent.append(fields)
    worker._commands = worker_link.CommandListener(StopFlag(), worker._send)

    def perform(*_: object) -> None:
        worker._commands._handle("stop-run 1")
        raise StopRequestedError(signal.SIGTERM, NOTHING_CONNECTED)

    worker._perform = perform
    with ExitStack() as at_the_end:
        worker._take(queue.upcoming(), at_the_end)
    (row,) = queue.rows()
    assert (row.state, row.reason) == ("failed", working.GIVEN_UP)
    assert (sent[-1]["ending"], sent[-1]["state"]) == ("stopped", "failed")
    assert not worker._commands.in_run


def test_the_night_between_two_attempts_is_not_time_on_a_real_bench(queue: Queue) -> None:
    """A batch with `stop_when.bench_hours` would end because of it."""
    claim = queue.claim(1)
    with closing(sqlite3.connect(queue.path)) as sql:
        sql.execute("UPDATE attempt SET began = '2026-11-22T10:00:00+01:00' WHERE attempt = 2")
        sql.commit()
    worker = worker_of(queue)
    journal = worker._folder.journal(1, "sweep")
    journal.parent.mkdir()
    twelve_h = 43_200.0
    with JournalWriter.create(journal, recorded_run.header()) as writer:  # begins at 22:00
        writer.event(recorded_run.event(100.0))
        writer.event(recorded_run.event(twelve_h + 300.0))
        writer.sync()
    ended: list[AttemptResult] = []
    worker._terms = SimpleNamespace(bench=Path("bench.toml"))
    worker._conclude = lambda _, result: ended.append(result)
    worker._recover()
    assert claim.attempt == 2
    assert [one.bench_s for one in ended] == [300.0]


def test_a_run_that_was_paused_is_not_expected_to_take_that_long_again(queue: Queue) -> None:
    """After a pause of 2 h the night would end 2 h early."""
    outcome = RunOutcome("complete", ExitCode.DONE, duration_s=7220.0, on_hold_s=7200.0)
    outcome.holds, passed_s = 1, list[float]()
    worker = worker_of(queue)
    worker._clock = SimpleNamespace(used=passed_s.append)
    worker._perform = lambda *_: outcome
    worker._conclude = lambda claim, ended: queue.finish(claim, ended, "done")
    with ExitStack() as at_the_end:
        worker._take(queue.upcoming(), at_the_end)
    assert passed_s == [7220.0]
    assert queue.bench_s() == 100.0 + 20.0, "with the attempt before"
