"""The file by which a monitor sees that a batch lives."""

from __future__ import annotations

import json
import os
from datetime import datetime
from pathlib import Path

import pytest

from rig.batch.report.heartbeat import EVERY_S, Heartbeat, HeartbeatRecord


class Hours:
    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "night-1.heartbeat.json"


def read(path: Path) -> HeartbeatRecord:
    return HeartbeatRecord(**json.loads(path.read_text()))


def running(point: str = "", run: int = 12, message: str = "") -> HeartbeatRecord:
    return HeartbeatRecord("running", run, 240, point, simulated=True, message=message)


def test_a_heartbeat_says_who_is_where_and_since_when(path: Path) -> None:
    Heartbeat(path).write(running("trial-003"))
    reported = json.loads(path.read_text())
    assert reported["pid"] == os.getpid()
    assert [reported[key] for key in ("state", "run", "of", "point")] == [
        "running",
        12,
        240,
        "trial-003",
    ]
    assert read(path).simulated
    assert datetime.fromisoformat(reported["time"]).tzinfo is not None
    assert [file.name for file in path.parent.iterdir()] == [path.name], "nothing is left beside it"


def test_a_new_point_waits_for_its_time_and_a_new_run_or_message_does_not(path: Path) -> None:
    hours = Hours()
    heartbeat = Heartbeat(path, hours)

    def said(beat: HeartbeatRecord) -> HeartbeatRecord:
        heartbeat.write(beat)
        return read(path)

    assert said(running("a")).point == "a"
    assert said(running("b")).point == "a"
    hours.now_s += EVERY_S
    assert said(running("c")).point == "c"
    assert said(running("d", run=13)).point == "d"
    assert said(running("e", run=13, message="retaken")).message == "retaken"
    assert said(HeartbeatRecord("holding", 13, 240)).state == "holding"


def test_a_disk_that_does_not_take_it_disturbs_nobody_and_is_reported_once(
    path: Path, tmp_path: Path, caplog
) -> None:
    hours = Hours()
    gone = Heartbeat(tmp_path / "gone" / "night-1.json", hours)
    for _ in range(3):
        gone.write(running())
        hours.now_s += EVERY_S
    assert len(caplog.records) == 1
    (tmp_path / "gone").mkdir()
    gone.write(running())
    assert read(tmp_path / "gone" / "night-1.json").run == 12
