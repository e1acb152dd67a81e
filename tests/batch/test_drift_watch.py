"""What holds a batch between its runs, apart from the figures of its references."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from rig.batch.execute.drift_watch import DriftWatch
from rig.batch.plan.read import parse_batch
from rig.batch.queue import Queue
from rig.batch.queue_records import RunEstimate

BATCH = """
[batch]
name = "night"
hold_when = { free_disk_GB = 0.0 }
[[experiment]]
procedure = "sweep"
"""


def test_a_batch_whose_folder_is_moved_away_waits_and_does_not_record_elsewhere(
    tmp_path: Path,
) -> None:
    """Its queue is open and stays with the folder that was moved; a run makes its folder anew."""
    folder, moved = tmp_path / "night", tmp_path / "moved"
    folder.mkdir()
    file, plan, _ = parse_batch(BATCH, "night.toml")
    estimates = dict.fromkeys(plan.conditions, RunEstimate(18.0, 1.0))
    with Queue.create(folder / "queue.sqlite", plan, estimates, {"name": "night"}) as queue:
        watch, now = DriftWatch(queue, file, None, tmp_path), datetime.now(UTC)
        upcoming = queue.upcoming()
        assert upcoming is not None
        assert watch.before(upcoming, now) == []
        folder.rename(moved)
        (folder / "runs").mkdir(parents=True)
        (reason,) = watch.before(upcoming, now)
        assert reason.text == f"the folder {folder} of the batch was moved or deleted"
        (folder / "runs").rmdir()
        folder.rmdir()
        moved.rename(folder)
        assert watch.before(upcoming, now) == []
