"""A run that has to be over by a time begins no point that would last longer, and ends the point
under way early enough to make the bench safe."""

from __future__ import annotations

from pathlib import Path

import pytest
from made_up import Example, run_of

from rig.core.errors import ExitCode
from rig.core.settings import Settings
from rig.run.context import Run
from rig.run.points import Point, Reading
from rig.run.stopping import MAKING_SAFE_S, StopFlag, TimeLimit


class Timed(Example):
    """Each point is expected to take 30 s and takes `each_s`, of a time that this keeps itself."""

    def __init__(self, left_s: float, each_s: float):
        super().__init__(Settings())
        self.left_s, self._each_s = left_s, each_s

    def points(self) -> tuple[Point, ...]:
        return tuple(Point(p.id, p.condition, (), duration_s=30.0) for p in super().points())

    def take(self, run: Run, point: Point) -> Reading:
        self.left_s -= self._each_s
        return super().take(run, point)


@pytest.mark.parametrize(
    ("left_s", "each_s", "done", "words"),
    [
        (71.0, 30.0, ["first", "second"], ""),
        (69.0, 30.0, ["first"], "the next point takes about 30 s and would not be over by 07:00"),
        (45.0, 40.0, [], "stopped: 07:00 was reached"),
    ],
    ids=["both fit", "one fits", "slower than expected"],
)
def test_no_point_is_begun_that_would_not_be_over_and_none_outlasts_the_limit(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    left_s: float,
    each_s: float,
    done: list[str],
    words: str,
) -> None:
    assert MAKING_SAFE_S == 10.0
    procedure, stop = Timed(left_s, each_s), StopFlag()
    stop.time_limit = TimeLimit("07:00", lambda: procedure.left_s)
    outcome = run_of(procedure, tmp_path, monkeypatch, stop=stop)
    assert procedure.log == ["on", *done, "off", "guard: safe", "guard: done"]
    assert outcome.points_done == len(done)
    assert outcome.status == ("stopped" if words else "complete")
    assert outcome.code == (ExitCode.STOPPED_BY_CONDITION if words else ExitCode.DONE)
    assert [failure.message for failure in outcome.failures if words not in failure.message] == []
    assert outcome.safe
