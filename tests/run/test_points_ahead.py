"""What a journal says, at each point, of the time that is still ahead."""

from __future__ import annotations

from pathlib import Path

import pytest
from made_up import Example, run_of

from rig.core.errors import RigError
from rig.core.settings import Settings
from rig.files.journal.follow import JournalTail
from rig.files.journal.format import PointBegin
from rig.run.context import Run
from rig.run.points import Point, Reading


class Descending(Example):
    """Points that take less and less time; the last fails."""

    def points(self) -> tuple[Point, ...]:
        times_s = {"a": 40.0, "b": 5.0, "c": 0.5}
        return tuple(Point(name, 1, (), duration_s=time_s) for name, time_s in times_s.items())

    def take(self, run: Run, point: Point) -> Reading:
        if point.id == "c":
            raise RigError("the last point fails")
        return super().take(run, point)


def test_each_point_begins_with_what_is_expected_of_it_and_of_those_behind_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcome = run_of(Descending(Settings()), tmp_path, monkeypatch)
    assert outcome.journal is not None
    with JournalTail(outcome.journal) as tail:
        begun = [record for record in tail.poll() if isinstance(record, PointBegin)]
    names = ("expected_s", "ahead_s", "points_ahead", "of")
    assert [tuple(record.fields[name] for name in names) for record in begun] == [
        (40.0, 5.5, 2, 3),
        (5.0, 0.5, 1, 3),
        (0.5, 0.0, 0, 3),
    ]
