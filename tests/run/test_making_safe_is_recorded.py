"""A run records that it makes the bench safe; no failure of that record keeps it from doing so."""

from __future__ import annotations

from pathlib import Path

import pytest
from made_up import Example, run_of

from rig.core.errors import InstrumentError, RigError
from rig.core.settings import Settings
from rig.files.errors import RecordingError
from rig.files.journal.reader import read_journal
from rig.run.context import Run
from rig.run.points import Point, Reading


class Disturbed(Example):
    """The first point ends the run, with a recorder that then does not take an event."""

    def __init__(self, refuses: bool):
        super().__init__(Settings())
        self._refuses = refuses

    def take(self, run: Run, point: Point) -> Reading:
        put = run._recorder.put_event

        def refuse_once(fields: object) -> None:
            run._recorder.put_event = put  # type: ignore[method-assign]
            raise ValueError("a bug")

        if self._refuses:
            run._recorder.put_event = refuse_once  # type: ignore[method-assign]
        raise RigError("it ends here")


def test_the_journal_says_that_the_run_makes_the_bench_safe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcome = run_of(Disturbed(False), tmp_path, monkeypatch)
    assert outcome.journal is not None
    codes = [event.code for event in read_journal(outcome.journal).events]
    assert codes[0] == "making-safe"


def test_a_recorder_that_takes_no_event_does_not_keep_the_bench_from_being_made_safe(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    procedure = Disturbed(True)
    outcome = run_of(procedure, tmp_path, monkeypatch)
    assert procedure.log[-3:] == ["off", "guard: safe", "guard: done"]
    assert outcome.safe


class Moved(Example):
    """The folder of results is moved away while the bench is made safe."""

    def arm(self, run: Run) -> None:
        run.arm("lamp", lambda: self._off(run), done="lamp off")

    def _off(self, run: Run) -> None:
        journal = run._recorder.journal.path
        journal.rename(journal.with_suffix(".moved"))
        run.event("info", "first", "word")
        while run._recorder._moved is None:
            run.clock.sleep(0.01)
        run.event("info", "last", "words")


def test_a_journal_that_is_moved_while_the_bench_is_made_safe_has_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcome = run_of(Moved(Settings()), tmp_path, monkeypatch)
    assert outcome.status == "failed"
    assert outcome.journal is not None
    end = read_journal(outcome.journal).end
    assert end is not None
    assert (end.status, end.points_done) == ("failed", 2)
    assert "was moved" in end.reason
    assert [event.message for event in read_journal(outcome.journal).events][-2:-1] == ["words"]


class FullDisk(Example):
    """The disk is full from the first point on. z meets something on its way up, says so, and has
    to go on up all the same."""

    def arm(self, run: Run) -> None:
        super().arm(run)
        run.arm("preload", lambda: self._up(run), done="preload released")

    def _up(self, run: Run) -> None:
        run.event("warning", "answer-lost", "one answer was lost on the way up")
        run.ending.fail(InstrumentError("stage_z", "unload", "it was stopped", "look"))
        run.ending.doubt("it is not known where stage_z is", "the sensor sends nothing")
        self.log.append("up")

    def take(self, run: Run, point: Point) -> Reading:
        full = RecordingError("a.rigj", "no space left on device")

        def refuse(fields: object) -> None:
            raise full

        run._recorder.put_event = refuse  # type: ignore[method-assign]
        raise full


def test_a_full_disk_does_not_end_the_way_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Seen on the simulated bench: z stopped halfway, and the preload was reported as not switched
    off for want of space on the disk."""
    procedure = FullDisk(Settings())
    outcome = run_of(procedure, tmp_path, monkeypatch)
    assert procedure.log[-4:] == ["up", "off", "guard: safe", "guard: done"]
    assert (outcome.off_failures, outcome.code) == ([], RecordingError("", "").code)
    assert "one answer was lost on the way up" in outcome.warnings
    assert outcome.left == ("it is not known where stage_z is",)
