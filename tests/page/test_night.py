"""Which batch a STOP on the page is for: the one that the kernel knows to run."""

from __future__ import annotations

import json
import math
import os
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rig.batch.folder import QUEUE, BatchFolder
from rig.batch.plan.conditions import BatchCondition, BatchPlan, PlannedRun
from rig.batch.queue import Queue
from rig.batch.queue_records import AttemptResult, RunEstimate
from rig.batch.running import ask_batch, batch_of
from rig.core.errors import ConfigurationError
from rig.page import server
from rig.page.night import latest_batch, night, running_batch
from rig.page.server import PageState
from rig.page.watch import BenchWatch
from rig.run.locks.lock_holder import LockHolder, holder_of

HOLD = """
import fcntl, os, sys
files = [os.open(path, os.O_RDWR | os.O_CREAT) for path in sys.argv[1:]]
for file in files:
    fcntl.flock(file, fcntl.LOCK_EX)
print("held", flush=True)
sys.stdin.read()
"""


@contextmanager
def held(*paths: Path) -> Iterator[None]:
    """Have another process hold the locks of these files."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, *map(str, paths)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert process.stdout is not None
    process.stdout.readline()
    try:
        yield
    finally:
        process.communicate()


def batch(results: Path, name: str, ctime_order: int) -> BatchFolder:
    folder = BatchFolder(results / name)
    (folder.path / "runs").mkdir(parents=True)
    (folder.path / QUEUE).write_text("")
    (folder.path / "supervisor.lock").write_text("")
    os.utime(folder.path / QUEUE, (ctime_order, ctime_order))
    return folder


@contextmanager
def recording(results: Path) -> Iterator[tuple[BatchFolder, Path]]:
    """A batch that runs, and the journal of its run under way."""
    night = batch(results, "night", 1)
    journal = night.journal(1, "sweep")
    with held(night.path / "supervisor.lock", journal):
        yield night, journal


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """What batches were asked for, by the page's server."""
    requests: list[Any] = []

    def ask_batch(folder: BatchFolder, request: str) -> str:
        requests.append((folder.path.name, request))
        return folder.path.name

    monkeypatch.setattr(server, "ask_batch", ask_batch)
    return requests


def stop(
    results: Path,
    journal: Path | None,
    wanted: dict[str, Any],
    signalled: list[Path],
    under_way: Any = None,
    target: Path | None = None,
) -> Any:
    """Press STOP with this choice, while the page shows the run of `journal`, its number 7. The
    locked file that is found for it is `target`, if given."""

    def ask_to_stop(ask: Any = None) -> Any:
        if journal is None:
            raise server.NotStoppedError("no run holds the bench")
        holder = SimpleNamespace(pid=1) if ask is None else ask(target or journal)
        if ask is None:
            signalled.append(journal)
        return SimpleNamespace(presses=1, holder=holder)

    header = SimpleNamespace(run_uuid="this", run_number=7)
    watch = SimpleNamespace(
        path=journal,
        results=results,
        view=SimpleNamespace(header=header),
        ask_to_stop=ask_to_stop,
        press_again=lambda: under_way,
        run_holder=holder_of,
        real=Path,
    )
    return server._stop(SimpleNamespace(watch=watch), wanted)  # type: ignore[arg-type]


def test_the_batch_that_runs_is_shown_before_a_later_one_that_does_not(tmp_path: Path) -> None:
    runs = batch(tmp_path, "a", 1)
    batch(tmp_path, "b", 2)
    assert running_batch(tmp_path) is None
    with held(runs.path / "supervisor.lock"):
        assert latest_batch(tmp_path) == running_batch(tmp_path) == runs


def test_a_stop_without_a_choice_in_a_run_of_a_batch_is_for_the_whole_night(
    tmp_path: Path, asked: list[Any]
) -> None:
    signalled: list[Path] = []
    with recording(tmp_path) as (night, journal):
        assert batch_of(journal) == night
        assert stop(tmp_path, journal, {}, signalled)[0] == 200
        assert (asked, signalled) == ([("night", "stop-now")], [journal])
        assert stop(tmp_path, journal, {"what": "run"}, signalled)[0] == 200
    assert asked[1:] == [("night", "stop-run 7")]
    assert signalled == [journal], "the batch ends its run itself"


@pytest.mark.parametrize("wanted", [{}, {"what": "run"}], ids=json.dumps)
def test_a_run_beside_a_batch_is_stopped_itself_and_the_batch_is_not_asked(
    tmp_path: Path, asked: list[Any], wanted: dict[str, Any]
) -> None:
    night = batch(tmp_path, "night", 1)
    journal = tmp_path / "2026-11-25" / "x_sweep_r001.rigj"
    journal.parent.mkdir()
    signalled: list[Path] = []
    with held(night.path / "supervisor.lock", journal):
        assert stop(tmp_path, journal, wanted, signalled)[0] == 200
    assert (asked, signalled) == ([], [journal])


def test_a_batch_that_cannot_be_asked_is_stopped_by_the_signal_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    signalled: list[Path] = []
    with recording(tmp_path) as (night, journal):
        (night.path / QUEUE).write_bytes(b"no database")
        status, said = stop(tmp_path, journal, {"what": "night"}, signalled)
    assert (status, signalled) == (200, [journal])
    assert "could not be asked" in said["problem"]


def test_a_further_press_without_a_choice_makes_no_stop_wider(
    tmp_path: Path, asked: list[Any]
) -> None:
    signalled: list[Path] = []
    with recording(tmp_path) as (_, journal):
        status, said = stop(tmp_path, journal, {}, signalled, SimpleNamespace(presses=2))
    assert (status, said["presses"], asked, signalled) == (200, 2, [], [])


def test_a_run_that_ends_while_its_stop_is_asked_for_leaves_the_next_run_alone(
    tmp_path: Path, asked: list[Any]
) -> None:
    """The bench's lock, which its process holds for the next run, was taken for the journal's."""
    with recording(tmp_path) as (_, journal):
        bench = tmp_path / "bench.lock"
        with held(bench):
            status, said = stop(tmp_path, journal, {"what": "run"}, [], target=bench)
    assert (status, said["problem"], asked) == (409, "the run has ended already", [])


def test_a_further_press_after_the_end_of_the_run_that_was_stopped_stops_no_batch(
    tmp_path: Path, asked: list[Any]
) -> None:
    """The END of the run that alone was to stop may have been read before the press arrives."""
    signalled: list[Path] = []
    again = {"what": "again"}
    with recording(tmp_path) as (_, journal):
        status, said = stop(tmp_path, journal, again, signalled, SimpleNamespace(presses=3))
        assert (status, said["presses"]) == (200, 3)
        status, said = stop(tmp_path, journal, again, signalled)
        assert (status, "press again to stop what is at work now" in said["problem"]) == (409, True)
        assert (asked, signalled) == ([], [])
        assert stop(tmp_path, journal, {}, signalled)[0] == 200
    assert (asked, signalled) == ([("night", "stop-now")], [journal])


def test_a_stop_of_one_run_reaches_no_other_and_does_nothing_between_runs(
    tmp_path: Path, asked: list[Any]
) -> None:
    night = batch(tmp_path, "night", 1)
    journal = night.journal(1, "sweep")
    journal.touch()
    signalled: list[Path] = []
    with held(night.path / "supervisor.lock"):
        status, said = stop(tmp_path, journal, {"what": "run", "run": "this"}, signalled)
        assert (status, "no run is under way" in said["problem"]) == (409, True)
    with held(night.path / "supervisor.lock", journal):
        status, said = stop(tmp_path, journal, {"what": "run", "run": "that"}, signalled)
        assert (status, "has ended" in said["problem"]) == (409, True)
        assert stop(tmp_path, journal, {"what": "run", "run": "this"}, signalled)[0] == 200
    assert (asked, signalled) == ([("night", "stop-run 7")], [])


def test_the_night_is_shown_without_a_lock_and_read_once_for_all_viewers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = batch(tmp_path, "night", 1)
    folder.queue.unlink()
    Queue.create(folder.queue, BatchPlan({}, ()), {}, {"name": "friction"}).close()

    def try_the_lock(*_: object) -> bool:
        raise AssertionError("a supervisor that begins now would be refused")

    monkeypatch.setattr(BatchFolder, "is_held", try_the_lock)
    drifts: list[float] = []

    def drift(_: Queue) -> list[float]:
        drifts.append(math.nan)
        return drifts

    monkeypatch.setattr("rig.page.night._drift", drift)
    state = PageState(BenchWatch(tmp_path), None, None)  # type: ignore[arg-type]
    for _ in range(2):
        shown = server._night(state)
        assert (shown["name"], shown["running"], shown["drift"]) == ("friction", False, [None])


@pytest.mark.parametrize("error", [sqlite3.OperationalError("disk I/O error"), OSError("stale")])
def test_a_queue_that_cannot_be_read_says_what_is_the_matter(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    batch(tmp_path, "friction", 1)

    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("rig.page.night.status_of", fail)
    assert night(tmp_path) == {"problem": f"the batch friction cannot be read: {error}"}


def test_every_run_that_was_retried_is_counted_also_those_that_are_not_listed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rig.page.night.MOST_RUNS", 1)
    folder = batch(tmp_path, "night", 1)
    folder.queue.unlink()
    condition = BatchCondition("sweep-001", 0, "sweep", {}, {})
    runs = tuple(PlannedRun(k, "sweep-001", k) for k in (1, 2, 3))
    plan = BatchPlan({"sweep-001": condition}, runs)
    meta = {"name": "night", "state": "complete"}
    with Queue.create(folder.queue, plan, {"sweep-001": RunEstimate(10.0, 2.0)}, meta) as queue:
        for number in (1, 2, 3):
            if number < 3:
                queue.finish(queue.claim(number), AttemptResult("failed", "timeout"), "queued")
            queue.finish(queue.claim(number), AttemptResult("complete"), "done")
    monkeypatch.setattr("rig.page.night._drift", lambda _: [])
    assert night(tmp_path)["retried"] == 2


def test_a_batch_of_another_user_is_asked_nothing_although_its_queue_can_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = batch(tmp_path, "night", 1)
    folder.queue.unlink()
    Queue.create(folder.queue, BatchPlan({}, ()), {}, {"name": "friction"}).close()
    owner = LockHolder(4242, "bob", own=False)
    monkeypatch.setattr("rig.batch.running.holder_of", lambda _: owner)
    monkeypatch.setattr("os.geteuid", lambda: 4711)  # the lock file is not this user's
    with pytest.raises(ConfigurationError, match=r"belongs to bob \(process 4242\)"):
        ask_batch(folder, "stop-now")
    with Queue.open(folder.queue) as queue:
        assert queue.take_requests() == []


def test_a_stop_while_a_batch_rests_is_for_the_night(tmp_path: Path, asked: list[Any]) -> None:
    night = batch(tmp_path, "night", 1)
    with held(night.path / "supervisor.lock"):
        status, said = stop(tmp_path, None, {}, [])
    assert (status, asked) == (200, [("night", "stop-now")])
    assert said["text"] == "batch night was asked to stop"
