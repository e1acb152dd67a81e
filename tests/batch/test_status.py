"""The status of a batch says first what is wrong with its bench."""

from __future__ import annotations

from pathlib import Path

import pytest

from rig.batch.folder import BatchFolder
from rig.batch.plan.conditions import BatchCondition, BatchPlan, PlannedRun
from rig.batch.queue import Queue
from rig.batch.queue_records import AttemptResult, RunEstimate
from rig.batch.report.status import status_of
from rig.bench.plan import read_bench
from rig.run.locks.bench_mark import BenchMarks
from rig.run.locks.lock import address_names

BENCH = """
name = "bench-3"
[fixture]
mounted = "film-clamp"
[generator]
driver = "keysight-33500b"
resource = "TCPIP::127.0.0.1::5025::SOCKET"
max_amplitude_V = 5.0
"""


def test_a_bench_that_was_left_pressed_or_unsafe_is_said_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RIG_SHARED_FOLDER", str(tmp_path / "shared"))
    bench = tmp_path / "bench.toml"
    bench.write_text(BENCH)
    meta = {"name": "night", "bench": str(bench), "state": "stopped"}
    Queue.create(tmp_path / "queue.sqlite", BatchPlan({}, ()), {}, meta).close()
    marks = BenchMarks(address_names(read_bench(bench)), "bench-3", None)

    marks.stopped("still pressed at 12.44 mm, 3.9 N")
    pressed = status_of(BatchFolder(tmp_path))
    assert pressed.lines()[0].endswith("still pressed at 12.44 mm, 3.9 N")
    marks.unsafe({"stage_z": "no answer"})
    unsafe = status_of(BatchFolder(tmp_path))
    assert "the bench bench-3 was left unsafe" in unsafe.lines()[0]
    assert unsafe.as_object()["bench_warnings"]
    marks.clear()
    assert status_of(BatchFolder(tmp_path)).lines()[0].startswith("batch night")
    bench.unlink()
    assert "the state of the bench is not known" in status_of(BatchFolder(tmp_path)).lines()[0]


def test_the_lock_of_a_batch_can_be_opened_by_its_owner_alone(tmp_path: Path) -> None:
    """Who may read a file may lock it, and the batch would seem to be at work."""
    folder = BatchFolder(tmp_path)
    with folder.held_by("supervisor", 0.0):
        assert folder.is_held("supervisor")
        assert (tmp_path / "supervisor.lock").stat().st_mode & 0o777 == 0o600


def test_only_a_run_without_its_run_file_is_called_not_compiled(tmp_path: Path) -> None:
    folder = BatchFolder(tmp_path)
    condition = BatchCondition("sweep-001", 0, "sweep", {}, {})
    plan = BatchPlan(
        {"sweep-001": condition}, tuple(PlannedRun(k, "sweep-001", k) for k in (1, 2, 3))
    )
    estimates = {"sweep-001": RunEstimate(10.0, 2.0)}
    (tmp_path / "runs").mkdir()
    with Queue.create(
        folder.queue, plan, estimates, {"name": "night", "state": "stopped"}
    ) as queue:
        for number in (1, 2, 3):
            queue.finish(queue.claim(number), AttemptResult("complete"), "done")
    folder.run_file(1, "sweep").touch()
    folder.run_file(2, "sweep").touch()
    lines = status_of(folder).lines()
    assert "not compiled yet: 1 run file" in lines
    assert "figures and results still to be made: 2 runs" in lines
    assert lines[-1].startswith("continue with: rig batch resume")
