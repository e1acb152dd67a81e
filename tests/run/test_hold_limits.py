"""A run whose holds come again and again ends before the object has been pressed too often."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from made_up import Example, run_of

from rig.core.errors import ExitCode
from rig.core.settings import Settings
from rig.files.journal.reader import read_journal
from rig.run.context import Run
from rig.run.holds import HoldLimitError
from rig.run.observers import RunObserver
from rig.run.points import Point, Reading


class LooseContact(Example):
    """Each attempt at a point presses; a hold comes and goes in the first `disturbed` of them."""

    def __init__(self, disturbed: dict[str, int]):
        super().__init__(Settings())
        self._left = dict(disturbed)

    def take(self, run: Run, point: Point) -> Reading:
        run.count_press()
        if self._left.get(point.id, 0):
            self._left[point.id] -= 1
            run.holds.begin("the force sensor is silent")
            run.holds.end("the force sensor is silent")
        return super().take(run, point)


class Counting(RunObserver):
    def __init__(self) -> None:
        self.reported: list[tuple[str, int, int]] = []

    def hold_begun(self, reason: str, holds: int, presses: int) -> None:
        self.reported.append((reason, holds, presses))


@pytest.mark.parametrize(
    ("disturbed", "points", "presses", "words"),
    [
        ({"first": 5, "second": 5}, 2, 12, ""),
        ({"first": 2, "second": 65}, 1, 9, "6 holds at second, the limit is 5 ([holds] per_point"),
    ],
    ids=["within the limit", "beyond it"],
)
def test_a_contact_that_stays_loose_ends_the_run_with_its_counts(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    disturbed: dict[str, int],
    points: int,
    presses: int,
    words: str,
) -> None:
    procedure, seen = LooseContact(disturbed), Counting()
    outcome = run_of(procedure, tmp_path, monkeypatch, seen)
    assert outcome.points_done == points
    assert outcome.presses == presses
    assert outcome.holds == outcome.presses - points
    assert [holds for _, holds, _ in seen.reported] == [*range(1, outcome.holds + 1)]
    assert outcome.safe
    assert procedure.log[-3:] == ["off", "guard: safe", "guard: done"]
    assert procedure.log.count("on") == procedure.log.count("off")
    if words:
        (failure,) = outcome.failures
        assert isinstance(failure, HoldLimitError)
        assert outcome.code is ExitCode.INSTRUMENT
        assert words in failure.message
        assert failure.message.endswith("in this run 8 holds, 9 presses")
        assert outcome.journal is not None
        codes = [event.code for event in read_journal(outcome.journal).events]
        assert codes[:6] == ["hold", "on-hold", "hold-over"] * 2
    else:
        assert outcome.code is ExitCode.DONE


class Paused(Example):
    """A hold of 0.3 s disturbs the first attempt at a point."""

    def take(self, run: Run, point: Point) -> Reading:
        if run.holds.count == 0:
            run.holds.begin("the door is open")
            threading.Timer(0.3, run.holds.end, ["the door is open"]).start()
        return super().take(run, point)


def test_the_time_on_hold_is_part_of_the_run_s_and_is_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A batch does not expect it of its later runs."""
    outcome = run_of(Paused(Settings()), tmp_path, monkeypatch)
    assert outcome.code is ExitCode.DONE
    assert 0.15 < outcome.on_hold_s < outcome.duration_s
