"""What holds a batch between its runs, apart from the figures of its references."""

from __future__ import annotations

import errno
import fcntl
import shutil
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rig.batch.execute.between_runs import SelfEnding
from rig.batch.execute.disk_room import has_room
from rig.batch.execute.drift_watch import DriftWatch
from rig.batch.execute.worker import Worker
from rig.batch.folder import BatchFolder
from rig.batch.plan.read import parse_batch
from rig.batch.queue import Queue
from rig.batch.queue_records import AttemptResult, RunEstimate
from rig.bench.settings import BenchSettings

BATCH = """
[batch]
name = "night"
hold_when = { free_disk_GB = 0.0 }
[[experiment]]
procedure = "sweep"
"""


class Night:
    """A batch of one run between its runs, and the holds that its worker asks for."""

    batch = BATCH

    def __init__(self, path: Path) -> None:
        self.folder, self.moved = path / "night", path / "moved"
        (self.folder / "runs").mkdir(parents=True)
        self.file, plan, _ = parse_batch(self.batch, "night.toml")
        estimates = dict.fromkeys(plan.conditions, RunEstimate(18.0, 1.0))
        self.queue = Queue.create(self.folder / "queue.sqlite", plan, estimates, {"name": "night"})
        self.watch = DriftWatch(self.queue, self.file, None, path)
        self.holds: list[tuple[str, SelfEnding | None]] = []
        worker: Any = Worker.__new__(Worker)
        worker._folder, worker._queue, worker._watch = (
            BatchFolder(self.folder),
            self.queue,
            self.watch,
        )
        worker._batch, worker._mounted = self.file.batch, None
        worker._commands = SimpleNamespace(take_given_up=lambda: False)
        worker._send = lambda *_, **__: None
        worker._between = SimpleNamespace(
            hold=lambda why, over=None, *_, **__: self.holds.append((why, over))
        )
        self.worker = worker

    def move_away(self) -> None:
        """Move the folder; the journal that has lost its name makes one of that name anew."""
        self.folder.rename(self.moved)
        (self.folder / "runs").mkdir(parents=True)

    def move_back(self) -> None:
        """Put the folder to its place."""
        shutil.rmtree(self.folder)
        self.moved.rename(self.folder)

    def fail(self, kind: str) -> tuple[str, SelfEnding | None]:
        """Return the hold after an attempt that failed for a reason of this kind."""
        ended = AttemptResult("failed", kind, 1, "r1.rigj: it cannot be written")
        self.worker._conclude(self.queue.claim(1), ended)
        return self.holds[-1]


@pytest.fixture
def night(tmp_path: Path) -> Iterator[Night]:
    found = Night(tmp_path)
    with found.queue:
        yield found


def test_a_batch_whose_folder_is_moved_away_waits_and_does_not_record_elsewhere(
    night: Night,
) -> None:
    """Its queue is open and stays with the folder that was moved; a run makes its folder anew."""
    watch, now = night.watch, datetime.now(UTC)
    upcoming = night.queue.upcoming()
    assert upcoming is not None
    assert watch.before(upcoming, now) == []
    night.move_away()
    (reason,) = watch.before(upcoming, now)
    assert reason.text == f"the folder {night.folder} of the batch was moved or deleted"
    assert "put its contents back into that folder, queue.sqlite last" in reason.hint
    night.move_back()
    assert watch.before(upcoming, now) == []


def test_a_copy_of_the_queue_does_not_end_the_hold(night: Night) -> None:
    """What is recorded goes to the file that is open, not to the copy."""
    night.move_away()
    shutil.copy(night.moved / "queue.sqlite", night.folder)
    (reason,) = night.watch.folder()
    assert "was replaced by a copy" in reason.text
    assert "Ctrl-C, then rig batch resume" in reason.hint


def test_a_run_whose_folder_was_moved_away_waits_for_the_folder_and_not_for_room(
    night: Night, monkeypatch: pytest.MonkeyPatch
) -> None:
    claim = night.queue.claim(1)
    night.move_away()
    assert not night.worker._disk_has_room(), "the room is in another folder"
    monkeypatch.setattr(night.queue, "finish", lambda *_: None)
    night.worker._conclude(claim, AttemptResult("failed", "storage", 1, "r1.rigj: was moved"))
    why, over = night.holds[-1]
    assert "was moved or deleted: put its contents back" in why
    assert over is not None
    assert over.words == "the folder is in its place"
    assert not over.is_over()
    night.move_back()
    assert over.is_over()
    assert night.worker._disk_has_room()


def test_a_hold_for_want_of_room_ends_by_itself_and_one_for_want_of_locks_does_not(
    night: Night,
) -> None:
    """The next attempt would fail in the same way, and the one after it."""
    why, over = night.fail("storage")
    assert why.startswith("the data cannot be saved: r1.rigj")
    assert over is not None
    assert over.words == "there is room on the disk"
    why, over = night.fail("recording")
    assert why.startswith("the data cannot be saved: r1.rigj")
    assert over is None


def test_a_run_whose_bench_another_program_has_stays_queued_and_waits_for_a_person(
    night: Night,
) -> None:
    why, over = night.fail("in-use")
    assert (why, over) == ("r1.rigj: it cannot be written", None)
    assert night.queue.counts()["queued"] == 1


def test_a_disk_that_locks_nothing_has_no_room_for_a_journal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert has_room(tmp_path, 1000)

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    assert not has_room(tmp_path, 1000)
    assert not list(tmp_path.iterdir())


REFERENCES = """
[batch]
name = "night"
hold_when = { free_disk_GB = 0.0, zero_drift_N = 1.0 }
[[experiment]]
procedure = "slip-trial"
every = 1
[[experiment]]
procedure = "sweep"
repeat = 2
"""
GAINS = ("mean_touch_gain_1_dB", "mean_touch_gain_2_dB")


class ReferenceNight(Night):
    """A batch with two references, and a third after its last run."""

    batch = REFERENCES

    def finish(self, first_dB: float, second_dB: float, zero_N: float) -> list[str]:
        """Finish a reference, and the run after it; return the holds that follow, which a person
        ends by a resume."""
        before = len(self.holds)
        figures = dict(zip(GAINS, (first_dB, second_dB), strict=True))
        summary = figures | {"force_zero_N": [0.0, 0.0, zero_N]}
        upcoming = self.queue.upcoming()
        assert upcoming is not None
        assert upcoming.condition.reference
        claim = self.queue.claim(upcoming.number)
        self.worker._conclude(claim, AttemptResult("complete", summary=summary))
        if (upcoming := self.queue.upcoming()) is not None:
            self.queue.finish(self.queue.claim(upcoming.number), AttemptResult("complete"), "done")
        return [why for why, _ in self.holds[before:]]


@pytest.fixture
def reference_night(tmp_path: Path) -> Iterator[ReferenceNight]:
    found = ReferenceNight(tmp_path)
    with found.queue:
        yield found


def test_resuming_accepts_what_was_found_and_nothing_else(reference_night: ReferenceNight) -> None:
    """What has moved within its tolerance was shown to no one: it would creep from hold to hold."""
    night = reference_night
    night.worker._mounted = BenchSettings(name="b", fixture={"mounted": "plate"})
    assert night.finish(12.0, 12.0, 0.0) == []
    (why,) = night.finish(6.0, 11.7, 0.7)
    assert "strip 1" in why
    assert "strip 2" not in why
    assert "zero" not in why
    (why,) = night.finish(5.8, 11.3, 1.3)
    assert "strip 1" not in why, "accepted"
    assert "moved by -0.70 dB (from 12.00 to 11.30 dB; tolerance 0.5 dB) since run 1" in why
    assert "its zero along z moved by +1.30 N (from 0.00 to 1.30 N; limit 1 N) since run 1" in why


def test_a_reference_that_an_earlier_worker_has_taken_is_judged_as_well(
    reference_night: ReferenceNight,
) -> None:
    """This worker has had no bench yet: the parts are named by the bench file."""
    night = reference_night
    assert night.finish(12.0, 12.0, 0.0) == []
    (why,) = night.finish(6.0, 12.0, 0.0)
    assert why.startswith("gain by touch-down and tap moved by -6.00 dB"), "on simulated benches"
    skin = {"name": "B", "films": {"strip_1": "film 7"}}
    own = BenchSettings(name="b", fixture={"mounted": "plate"}, skin=skin)
    night.watch._plan = SimpleNamespace(settings=own)  # type: ignore[assignment]
    (why,) = night.finish(0.0, 12.0, 0.0)
    assert why.startswith("film 'film 7' in strip 1 of skin 'B': gain by touch-down")
