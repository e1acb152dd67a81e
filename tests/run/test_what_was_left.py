"""What the outcome of a run says of the bench that it leaves."""

from __future__ import annotations

import signal
from collections.abc import Sequence, Set
from pathlib import Path

import pytest
from made_up import Example, run_of

from rig.core.errors import ExitCode, InstrumentError
from rig.core.settings import Settings
from rig.run.context import Run
from rig.run.ending import Ending
from rig.run.observers import RunObserver
from rig.run.points import Point, Reading
from rig.run.stopping import StopFlag
from rig.run.trip import TripError


class Impatient(RunObserver):
    """A person who stops the run as soon as its plan is shown."""

    def __init__(self, stop: StopFlag):
        self._stop = stop

    def planned(self, points: Sequence[Point], recorded: Set[str], overhead_s: float) -> None:
        self._stop.requested = signal.SIGINT


class Waiting(Example):
    """It waits before it switches anything on."""

    def arm(self, run: Run) -> None:
        run.check_stop()
        super().arm(run)


@pytest.mark.parametrize(("procedure", "armed"), [(Waiting, False), (Example, True)])
def test_a_run_knows_whether_it_has_switched_anything_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, procedure: type[Example], armed: bool
) -> None:
    stop = StopFlag()
    outcome = run_of(procedure(Settings()), tmp_path, monkeypatch, Impatient(stop), stop=stop)
    assert outcome.code == ExitCode.SIGINT
    assert (outcome.armed, outcome.safe, outcome.own_bench) == (armed, True, True)
    assert bool(outcome.made_safe) == armed


class LeavesItPressed(Example):
    """What presses cannot be lifted."""

    def arm(self, run: Run) -> None:
        stuck = InstrumentError("stage_z", "unload", "it stands", "check the stage")
        run.arm("preload", lambda: run.ending.fail(stuck, "the film may still be pressed"))


def test_a_run_knows_what_it_has_left_pressed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcome = run_of(LeavesItPressed(Settings()), tmp_path, monkeypatch)
    assert outcome.left == ("the film may still be pressed",)
    assert (outcome.safe, outcome.code) == (False, ExitCode.INSTRUMENT)


class LeavesItUnknown(Example):
    """What presses goes up, and no sensor shows whether it has; a hold may come before that."""

    def arm(self, run: Run) -> None:
        super().arm(run)
        run.arm("preload", lambda: self._up(run), done="preload released")

    def _up(self, run: Run) -> None:
        unknown = "it is not known whether the film is still pressed"
        run.ending.doubt(unknown, f"the sensor sends nothing, and {unknown}")


def test_a_run_does_not_call_a_bench_safe_of_which_it_does_not_know_what_is_pressed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcome = run_of(LeavesItUnknown(Settings()), tmp_path, monkeypatch)
    assert outcome.left == ("it is not known whether the film is still pressed",)
    assert (outcome.safe, outcome.code) == (False, ExitCode.DONE)
    assert "preload released" not in outcome.made_safe
    assert [w for w in outcome.warnings if "the sensor sends nothing" in w]


def test_a_doubt_ends_where_the_bench_is_made_safe_again() -> None:
    ending = Ending(lambda level, code, text: None)
    ending.doubt("it is not known whether the film is still pressed", "no frames")
    with ending.making_safe():
        assert ending.left == ()


class Tripped(Example):
    """A limit is exceeded at the first point, and again after that if `twice`; something else is
    found while that is made safe."""

    twice = False

    def arm(self, run: Run) -> None:
        super().arm(run)
        run.arm("fan", lambda: self._off(run), done="fan off")

    def _off(self, run: Run) -> None:
        if not self.twice:
            run.ending.fail(InstrumentError("fan", "off", "it is hot", "let it cool"))

    def take(self, run: Run, point: Point) -> Reading:
        if self.log.count("on") <= 1 + self.twice:
            raise TripError("the limit was exceeded")
        return super().take(run, point)


@pytest.mark.parametrize(
    ("twice", "done"), [(False, ["lamp off"]), (True, ["fan off", "lamp off"])]
)
def test_what_was_switched_off_after_a_trip_is_stated_at_the_end(
    twice: bool, done: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is left to be switched off when the run ends, and the bench is not left unsaid; what
    has been switched on again is stated once."""
    procedure = Tripped(Settings())
    procedure.twice = twice
    outcome = run_of(procedure, tmp_path, monkeypatch)
    assert outcome.status == "failed"
    assert sorted(outcome.made_safe) == done
