"""The queue: every run exactly once, whoever dies between two transactions."""

from __future__ import annotations

import contextlib
import gc
import sqlite3
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rig.batch import queue as queues
from rig.batch import queue_file
from rig.batch.execute.rebuild import is_sound
from rig.batch.folder import BatchFolder
from rig.batch.plan.conditions import BatchCondition, BatchPlan, PlannedRun
from rig.batch.queue import Queue
from rig.batch.queue_records import AttemptResult, RunEstimate
from rig.batch.queue_view import QueueView
from rig.core.errors import ConfigurationError, RigError


def plan(conditions: int = 2, repeats: int = 3) -> BatchPlan:
    names = [f"sweep-{k:03d}" for k in range(1, conditions + 1)]
    made = {
        name: BatchCondition(
            name, 0, "sweep", {"load_N": float(k)}, {"load_N": float(k)}, rest_s=1.0
        )
        for k, name in enumerate(names, 1)
    }
    order = [(name, repeat) for repeat in range(1, repeats + 1) for name in names]
    return BatchPlan(made, tuple(PlannedRun(k, *run) for k, run in enumerate(order, 1)))


def created(path: Path, made: BatchPlan) -> Queue:
    estimates = dict.fromkeys(made.conditions, RunEstimate(10.0, 2.0, 1000))
    return Queue.create(path / "queue.sqlite", made, estimates, {"name": "test"})


def taken(queue: Queue) -> int:
    upcoming = queue.upcoming()
    assert upcoming is not None
    return queue.claim(upcoming.number).number


def test_runs_are_claimed_in_order_and_each_once(tmp_path: Path) -> None:
    with created(tmp_path, plan()) as queue:
        order = []
        while (upcoming := queue.upcoming()) is not None:
            claim = queue.claim(upcoming.number)
            order.append(claim.number)
            queue.finish(claim, AttemptResult("complete", bench_s=5.0, summary={"x": 1}), "done")
        assert order == [1, 2, 3, 4, 5, 6]
        assert queue.counts()["done"] == 6
        assert queue.bench_s() == 30.0


def test_a_run_is_expected_to_take_as_long_as_others_of_its_condition_have_taken(
    tmp_path: Path,
) -> None:
    """A run that was tried again does not show how long one takes."""
    with created(tmp_path, plan(conditions=1, repeats=5)) as queue:

        def take(bench_s: float, *, tries: int = 1) -> float:
            for further in reversed(range(tries)):
                upcoming = queue.upcoming()
                assert upcoming is not None
                claim = queue.claim(upcoming.number)
                assert claim.estimate_s == upcoming.estimate_s
                ended = AttemptResult("failed" if further else "complete", bench_s=bench_s)
                queue.finish(claim, ended, "queued" if further else "done")
            return claim.estimate_s

        assert take(7.0) == 10.0, "as planned"
        assert take(15.5) == 10.0
        assert take(12.0, tries=2) == 15.5
        assert take(14.0) == 15.5
        assert take(1.0) == 15.5


def test_a_run_that_is_taken_is_nobody_elses(tmp_path: Path) -> None:
    with created(tmp_path, plan()) as queue, Queue.open(queue.path) as other:
        assert taken(queue) == 1
        with pytest.raises(RigError, match="run 1 is not queued"):
            other.claim(1)


def test_what_a_dead_worker_had_claimed_is_found_and_continues_in_its_place(tmp_path: Path) -> None:
    with created(tmp_path, plan()) as queue:
        taken(queue)
    with Queue.open(tmp_path / "queue.sqlite") as queue:
        left = queue.unfinished()
        assert left is not None
        assert (left.number, left.attempt) == (1, 1)
        queue.finish(left, AttemptResult("died", "died", reason="it died"), "queued")
        again = queue.upcoming()
        assert again is not None
        assert (again.number, again.attempt) == (1, 2)
        assert queue.attempts(1) == {"died": 1}
        assert queue.unfinished() is None


def test_what_is_left_counts_rests_and_adds_spreads_of_one_condition(tmp_path: Path) -> None:
    with created(tmp_path, plan()) as queue:
        left = queue.remaining()
    assert left.runs == 6
    assert left.bench_s == 6 * 11.0
    assert left.spread_s == pytest.approx((6.0**2 + 6.0**2) ** 0.5)


def test_setting_a_condition_aside_leaves_the_others(tmp_path: Path) -> None:
    with created(tmp_path, plan()) as queue:
        claim = queue.claim(taken(queue) + 1)
        queue.finish(claim, AttemptResult("failed", "limit", 4, "too much"), "failed")
        assert queue.set_aside("sweep-002", "1 of its runs failed") == 2
        assert [row.number for row in queue.rows(("queued",))] == [3, 5]
        assert [row.number for row in queue.rows(("set-aside",))] == [4, 6]
        queue.set_processed(2, {"file": None})
        assert queue.put_back() == 3
        assert [row.number for row in queue.rows(("queued",))] == [2, 3, 4, 5, 6]
        queue.finish(queue.claim(2), AttemptResult("complete"), "done")
        assert queue.unprocessed() == [(2, "sweep")], "its files are made anew"
        assert queue.attempts(2) == {}


def test_failures_in_a_row_end_with_a_run_that_is_done(tmp_path: Path) -> None:
    with created(tmp_path, plan()) as queue:
        for state in ("failed", "done", "failed", "failed"):
            claim = queue.claim(taken_next(queue))
            ending = (
                AttemptResult("complete")
                if state == "done"
                else AttemptResult("failed", "timeout", 3)
            )
            queue.finish(claim, ending, state)  # type: ignore[arg-type]
        assert queue.failed_in_a_row(10) == 2


def test_runs_are_in_the_order_of_their_ends_also_when_summer_time_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At 03:00 the clock shows 02:00 again; run 1 was queued again and has ended last."""
    times = {
        2: "2026-10-25T02:30:00.000000+02:00",
        3: "2026-10-25T02:59:00.000000+02:00",
        4: "2026-10-25T02:10:00.000000+01:00",
        1: "2026-10-25T02:20:00.000000+01:00",
    }
    with created(tmp_path, plan()) as queue:
        for number, ended in times.items():
            monkeypatch.setattr(queues, "_now", lambda ended=ended: ended)
            state = "done" if number in (2, 3) else "failed"
            result = (
                AttemptResult("complete", code=5) if state == "done" else AttemptResult("failed")
            )
            queue.finish(queue.claim(number), result, state)  # type: ignore[arg-type]
        assert queue.failed_in_a_row(10) == 2
        assert [row.number for row in queue.latest(("done", "failed"), 9)] == [1, 4, 3, 2]
        assert [row.number for row in queue.invalid(9)[1]] == [3, 2]


def taken_next(queue: Queue) -> int:
    upcoming = queue.upcoming()
    assert upcoming is not None
    return upcoming.number


def test_requests_are_heard_once_and_in_order(tmp_path: Path) -> None:
    with created(tmp_path, plan()) as queue, Queue.open(queue.path) as terminal:
        terminal.add_request("pause")
        terminal.add_request("go")
        assert queue.take_requests() == ["pause", "go"]
        assert queue.take_requests() == []


def test_a_queue_that_was_not_written_whole_is_none(tmp_path: Path) -> None:
    estimates = {"sweep-001": RunEstimate(1.0, 0.0)}  # of sweep-002 nothing is known
    with pytest.raises(KeyError):
        Queue.create(tmp_path / "queue.sqlite", plan(), estimates, {})
    with pytest.raises(ConfigurationError, match="holds no batch"):
        Queue.open(tmp_path / "queue.sqlite")


def test_a_queue_that_is_over_is_one_file_that_opens_where_nothing_can_be_written(
    tmp_path: Path,
) -> None:
    with created(tmp_path, plan()) as queue:
        taken(queue)
        queue.close_log()
        queue.close()
        assert [path.name for path in tmp_path.iterdir()] == ["queue.sqlite"]
        header = queue.path.read_bytes()[18:20]
    assert header == bytes([1, 1]), "no write-ahead log is asked for"
    with QueueView.open(tmp_path / "queue.sqlite") as queue:
        assert queue.counts()["running"] == 1


@pytest.mark.parametrize("content", [b"", b"no database", b"SQLite format 3\0" + 200 * b"\xff"])
def test_what_is_no_queue_is_refused_by_name(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "queue.sqlite"
    path.write_bytes(content)
    with pytest.raises(ConfigurationError, match=r"queue\.sqlite cannot be read as the queue"):
        Queue.open(path)


def test_a_queue_that_is_damaged_is_refused_with_how_to_rebuild_it(tmp_path: Path) -> None:
    with created(tmp_path, plan(20, 20)) as queue:
        queue.close_log()
    content = bytearray(queue.path.read_bytes())
    content[2 * len(content) // 3 :: 7] = b"\xa5" * len(content[2 * len(content) // 3 :: 7])
    queue.path.write_bytes(content)
    for kind in (Queue, QueueView):
        with pytest.raises(ConfigurationError, match=r"queue\.sqlite cannot be read") as raised:
            kind.open(queue.path)
        assert f"rig batch rebuild {tmp_path}" in str(raised.value.hint)


def test_a_queue_that_cannot_be_opened_here_is_not_called_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A rebuild would replace a sound queue."""
    with created(tmp_path, plan(2, 2)) as queue:
        queue.close_log()
    monkeypatch.setattr(queue_file, "BUSY_S", 0.0)
    with contextlib.closing(sqlite3.connect(queue.path, isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        for kind in (Queue, QueueView):
            with pytest.raises(ConfigurationError, match="cannot be opened: database is") as raised:
                kind.open(queue.path)
            assert "rebuild" not in str(raised.value.hint)
        with pytest.raises(ConfigurationError, match="cannot be opened: database is locked"):
            is_sound(BatchFolder(tmp_path))


@pytest.mark.parametrize(
    ("name", "remedy"),
    [
        ("SQLITE_FULL", "free some disk space"),
        ("SQLITE_IOERR_WRITE", "free some disk space"),
        ("SQLITE_IOERR_FSYNC", "free some disk space"),
        ("SQLITE_BUSY_RECOVERY", "another program has it open"),
        ("SQLITE_LOCKED", "another program has it open"),
        ("SQLITE_READONLY_ROLLBACK", "roll that back with: rig batch resume"),
        ("SQLITE_CANTOPEN", "see that you may write to the folder"),
        ("SQLITE_NOLFS", "see that you may write to the folder"),
        ("SQLITE_IOERR_READ", ""),
        ("SQLITE_CORRUPT_INDEX", ""),
        ("SQLITE_ERROR", ""),
    ],
)
def test_a_queue_is_called_damaged_only_where_what_is_in_it_is_to_blame(
    name: str, remedy: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    created(tmp_path, plan()).close()

    def refuse(*_: object, **__: object) -> None:
        error = sqlite3.OperationalError("refused")
        error.sqlite_errorname = name
        raise error

    monkeypatch.setattr(sqlite3, "connect", refuse)
    found = "cannot be opened: refused" if remedy else "cannot be read as the queue"
    with pytest.raises(ConfigurationError, match=found) as raised:
        Queue.open(tmp_path / "queue.sqlite")
    assert str(raised.value.hint).find(remedy or "rebuild it: rig batch rebuild") >= 0
    assert ("rebuild" in str(raised.value.hint)) == (not remedy)


def test_damage_that_is_met_later_is_named_as_well(tmp_path: Path) -> None:
    with created(tmp_path, plan(20, 20)) as queue:
        content = queue.path.read_bytes()
        queue.path.write_bytes(content[:100] + b"\xa5" * (len(content) - 100))
        with pytest.raises(ConfigurationError, match=r"queue\.sqlite cannot be read"):
            list(queue.rows())


def test_a_disk_that_takes_no_more_is_reported_with_the_remedy(tmp_path: Path) -> None:
    with created(tmp_path, plan()) as queue:
        queue._sql.execute(f"PRAGMA max_page_count = {_pages(queue)}")
        with pytest.raises(RigError, match=r"cannot be written: .*full") as raised:
            _fill(queue)
        assert raised.value.hint == "free some disk space, then: rig batch resume"
        assert queue.counts()["queued"] == 6, "and it goes on being read"


def test_a_queue_that_another_program_has_locked_is_reported_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rig.batch.queue_file.BUSY_S", 0.05)
    with created(tmp_path, plan()) as queue, sqlite3.connect(queue.path) as other:
        other.execute("BEGIN EXCLUSIVE")
        with pytest.raises(RigError, match="cannot be written: database is locked") as raised:
            queue.set_meta("state", "running")
        assert str(raised.value.hint).startswith("another program has it open: wait for it")
        assert str(raised.value.hint).endswith("then: rig batch resume")


def _fill(queue: Queue) -> None:
    for _ in range(10_000):
        queue.add_event("info", 1000 * "x")


def _pages(queue: Queue) -> int:
    (pages,) = queue._sql.execute("PRAGMA page_count").fetchone()
    return int(pages)


@pytest.mark.thorough
@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    kills=st.lists(st.integers(0, 60), max_size=8),
    failing=st.sets(st.integers(1, 6)),
)
def test_no_run_is_lost_or_doubled_wherever_the_worker_dies(
    tmp_path_factory: pytest.TempPathFactory, kills: list[int], failing: set[int]
) -> None:
    """A worker is killed after so many statements of SQL; the next one settles and goes on."""
    folder = tmp_path_factory.mktemp("queue")
    done: list[int] = []
    journals: dict[int, bool] = {}
    created(folder, plan()).close()
    for left in [*kills, 10_000]:
        queue = Queue.open(folder / "queue.sqlite")
        _dies_after(queue, left)
        try:
            _work(queue, journals, done, failing)
        except (RigError, sqlite3.OperationalError):
            pass
        finally:
            queue._sql.set_trace_callback(None)
            queue._sql.set_progress_handler(None, 1)
            queue.close()
        gc.collect()  # a cursor in a traceback keeps the lock of this process, which has not died
    with Queue.open(folder / "queue.sqlite") as queue:
        states = {row.number: row.state for row in queue.rows()}
    assert states == {n: "failed" if n in failing else "done" for n in range(1, 7)}
    assert sorted(done) == [n for n in range(1, 7) if n not in failing], "each was taken once"


def _work(queue: Queue, journals: dict[int, bool], done: list[int], failing: set[int]) -> None:
    """What the worker does, with a journal that says whether its run has ended whole."""
    claim = queue.unfinished()
    if claim is not None:
        whole = journals.get(claim.number, False)
        queue.finish(
            claim,
            AttemptResult("complete") if whole else AttemptResult("died", "died"),
            "done" if whole else "queued",
        )
    while (upcoming := queue.upcoming()) is not None:
        claim = queue.claim(upcoming.number)
        if claim.number in failing:
            queue.finish(claim, AttemptResult("failed", "limit", 4), "failed")
            continue
        done.append(claim.number)
        journals[claim.number] = True
        queue.finish(claim, AttemptResult("complete"), "done")


def _dies_after(queue: Queue, statements: int) -> None:
    """The connection breaks off at a statement, before it takes effect."""
    count = 0

    def handler() -> int:
        return 1 if count > statements else 0

    def counting(_: str) -> None:
        nonlocal count
        count += 1

    queue._sql.set_trace_callback(counting)
    queue._sql.set_progress_handler(handler, 1)
