"""What becomes of a worker's reports: the queue's state, lines, notifications."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rig.batch.execute.between_runs import BENCH_IN_USE, BENCH_SAFE
from rig.batch.execute.worker_reports import WorkerReports
from rig.batch.folder import BatchFolder
from rig.batch.plan.read import parse_batch
from rig.batch.queue import Queue
from rig.batch.queue_records import HOLDS, PRESSES, WAITS_FOR_A_PERSON, RunEstimate

BATCH = """
[batch]
name = "night"
[[experiment]]
procedure = "sweep"
"""


class Night:
    """A batch of one run whose worker reports, and what people see of it."""

    def __init__(self, path: Path) -> None:
        _, plan, _ = parse_batch(BATCH, "night.toml")
        estimates = dict.fromkeys(plan.conditions, RunEstimate(18.0, 1.0))
        self.folder = BatchFolder(path)
        self.queue = Queue.create(self.folder.queue, plan, estimates, {"name": "night"})
        self.said: list[str] = []
        self.notified: list[tuple[str, str]] = []
        self.files: list[int] = []
        people: Any = SimpleNamespace(
            say=self.said.append,
            notify=lambda occasion, text: self.notified.append((occasion, text)),
        )
        files: Any = SimpleNamespace(add=lambda number, procedure: self.files.append(number))
        self.reports = WorkerReports(
            self.folder, self.queue, lambda write, *values: write(*values), people, files
        )

    def report(self, event: str, **values: object) -> None:
        """Have the worker report an event."""
        assert self.reports.take(json.dumps({"event": event, **values}).encode())


@pytest.fixture
def night(tmp_path: Path) -> Iterator[Night]:
    found = Night(tmp_path)
    with found.queue:
        yield found


def test_people_are_notified_of_a_hold_once_and_its_state_is_set_each_time(night: Night) -> None:
    over = "the folder is in its place"
    hold = {"text": "the folder was moved", "by_itself": over, "bench": BENCH_SAFE}
    night.report("hold", **hold)
    assert night.queue.meta("state") == "held: the folder was moved"
    night.report("state", state="running", text="the folder is in its place again")
    assert night.queue.meta("state") == "running: the folder is in its place again"
    night.report("hold", **hold)
    assert night.queue.meta("state") == "held: the folder was moved"
    assert night.notified == [("hold", "the folder was moved")]
    assert night.said[-1] == (
        "the bench is safe and the batch waits; it continues when the folder is in its place, or "
        f"with: rig batch resume {night.folder.path}"
    )


def test_a_hold_that_a_mere_resume_does_not_end_is_not_said_to_continue_with_it(
    night: Night,
) -> None:
    why = "cell.json has expired: stop the batch, calibrate"
    night.report("hold", text=why, by_itself="", bench=BENCH_SAFE, by_resume=False)
    assert night.said[-1] == "the bench is safe and the batch waits"
    assert night.queue.meta("state") == f"held: {why}"


def test_what_only_a_person_can_end_is_kept_for_the_next_worker(night: Night) -> None:
    night.report("hold", text="it is in use", by_itself="", bench=BENCH_IN_USE)
    assert night.said[-1] == (
        "the bench is left to the other program and the batch waits; it continues with: "
        f"rig batch resume {night.folder.path}"
    )
    assert night.queue.meta(WAITS_FOR_A_PERSON) == "it is in use"
    night.reports.say_that_it_waits()
    assert night.said[-1].startswith("the batch still waits: it is in use; ")


def test_holds_of_all_attempts_are_added_up(night: Night) -> None:
    begun = {"number": 1, "condition": "sweep", "estimate_s": 18.0}
    night.report("run", attempt=1, **begun)
    night.report("disturbed", holds=1, presses=1, reason="the door is open")
    night.report("disturbed", holds=2, presses=2, reason="the door is open")
    assert len(night.notified) == 1, "the first hold of a run only"
    night.reports.close_attempt()  # its worker died
    night.report("run", attempt=2, **begun)
    night.report("disturbed", holds=1, presses=1, reason="the door is open")
    assert night.queue.meta(HOLDS) == "3"
    assert night.reports.presses.total == 3


def test_the_presses_of_a_worker_that_dies_are_not_forgotten(night: Night) -> None:
    """Seen on the simulated bench: each wears the film, and the batch had made one less."""
    night.report("run", number=1, attempt=1, condition="sweep", estimate_s=18.0)
    night.report("pressed", presses=1)
    assert night.queue.meta(PRESSES) == "1"
    night.reports.close_attempt()
    ended = {"number": 1, "points": "1 of 13", "reason": "it died", "code": 0, "bench": ""}
    died = {"ending": "died", "state": "queued", "holds": 0, "presses": 0, "procedure": "sweep"}
    night.report("finished", **ended, **died)
    night.report("run", number=1, attempt=2, condition="sweep", estimate_s=18.0)
    night.report("pressed", presses=1)
    assert (night.reports.presses.total, night.queue.meta(PRESSES)) == (2, "2")


def test_a_run_that_failed_is_reported_and_its_files_are_made(night: Night) -> None:
    night.report("run", number=1, attempt=1, condition="sweep", estimate_s=18.0)
    ended = {"number": 1, "points": "3 of 175", "reason": "generator: no answer", "code": 3}
    bench = {"bench": "Bench is safe.", "holds": 0, "presses": 1, "procedure": "sweep"}
    night.report("finished", ending="failed", state="queued", **ended, **bench)
    assert night.said[-1].endswith("it stays queued for another attempt")
    assert not night.files, "its journal is continued"
    night.report("finished", ending="failed", state="failed", **ended, **bench)
    assert night.files == [1]
    assert night.notified == [("failure", "run 1: failed, 3 of 175: generator: no answer")]
    assert night.reports.bench == "Bench is safe."


@pytest.mark.parametrize(("state", "files"), [("failed", [1]), ("queued", [])])
def test_the_files_of_a_run_that_a_person_has_ended_alone_are_made(
    night: Night, state: str, files: list[int]
) -> None:
    """It is not taken again, as one is that was stopped with the batch."""
    night.report("run", number=1, attempt=1, condition="sweep", estimate_s=18.0)
    ended = {"number": 1, "points": "3 of 175", "reason": "", "code": 143, "procedure": "sweep"}
    bench = {"bench": "Bench is safe.", "holds": 0, "presses": 1}
    night.report("finished", ending="stopped", state=state, **ended, **bench)
    assert night.said[-1] == "run 1: stopped, 3 of 175"
    assert (night.files, night.notified) == (files, [])


@pytest.mark.parametrize("line", [b"warning: something printed", b"{}", b'{"event": ["a"]}', b"7"])
def test_a_line_that_is_no_report_changes_nothing(night: Night, line: bytes) -> None:
    assert not night.reports.take(line)
    assert not night.said
