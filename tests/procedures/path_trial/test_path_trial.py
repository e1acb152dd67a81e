"""Path trials: what they refuse, the moves along a path, and a run on the simulated bench."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from procedures.path_trial import PathTrial
from procedures.path_trial.path import Course, moves_along
from procedures.path_trial.settings import PathTrialSettings
from procedures.pressed.axes import StagePoll
from rig.detector.notices import HeldForce, notices_in
from rig.files.definitions import definition_path
from rig.files.runfile.reader import RunFile


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"path_times_s": (0, 1)}, "path_times_s has 2 values, path_positions_mm has 0"),
        ({"path_times_s": (0, 1, 1), "path_positions_mm": (0, 1, 2)}, "must ascend from 0"),
        ({"path_times_s": (0.1, 1), "path_positions_mm": (0, 1)}, "must ascend from 0"),
        ({"path_times_s": (0, 1), "path_positions_mm": (1, 2)}, "must begin with 0, not 1"),
        ({"force_times_s": (0, 1), "force_shares": (0.5, 1)}, "must begin with 1, not 0.5"),
        ({"force_times_s": (0, 1), "force_shares": (1, 0.01)}, "force_shares has 0.01, less than"),
        ({"force_times_s": (0, 1), "force_shares": (1, 4)}, "ask for 16 N, which is not below"),
    ],
)
def test_a_path_or_course_that_cannot_be_followed_is_refused(given: dict, words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        PathTrialSettings(**given)


def test_a_change_of_speed_does_not_stop_the_stage_and_a_rest_does() -> None:
    course = Course((0.0, 1.0, 2.0, 3.0, 4.0), (0.0, 2.0, 3.0, 3.0, 1.0))
    reported = [(one.at_s, one.to_mm, one.speed_mm_s) for one in moves_along(course)]
    assert reported == [(0.0, 3.0, 2.0), (1.0, 3.0, 1.0), (3.0, 1.0, 2.0)]


def test_a_course_is_straight_between_its_corners_and_constant_after_them() -> None:
    course = Course((0.0, 1.0, 2.0), (1.0, 0.5, 0.7))
    assert [course.at(t, 1.0) for t in (0.0, 0.5, 1.5, 9.0)] == pytest.approx([1.0, 0.75, 0.6, 0.7])
    assert Course((), ()).at(3.0, 1.0) == 1.0


class Stage:
    """An x that reaches any speed at once, or with the acceleration of its drive."""

    def __init__(self, share: float = 1.0, acceleration_mm_s2: float = math.inf) -> None:
        self.latest, self.in_motion = StagePoll(), False
        self._share, self._acceleration_mm_s2 = share, acceleration_mm_s2
        self._at_mm, self._speed_mm_s, self._target = 10.0, 0.0, (10.0, 0.0)

    def start_move(self, to_mm: float, speed_mm_s: float) -> None:
        self._target = (to_mm, self._share * speed_mm_s)

    def advance(self, duration_s: float, now_s: float) -> None:
        steps = 100
        step_s = duration_s / steps
        for _ in range(steps):
            to_mm, fastest_mm_s = self._target
            left_mm = to_mm - self._at_mm
            braked_mm_s = math.sqrt(2 * self._acceleration_mm_s2 * abs(left_mm)) if left_mm else 0.0
            aim_mm_s = min(fastest_mm_s, abs(left_mm) / step_s, braked_mm_s)
            change_mm_s = math.copysign(aim_mm_s, left_mm) - self._speed_mm_s
            most_mm_s = self._acceleration_mm_s2 * step_s
            self._speed_mm_s += max(-most_mm_s, min(most_mm_s, change_mm_s))
            self._at_mm += self._speed_mm_s * step_s
        self.latest = StagePoll(now_s, now_s, self._at_mm, self._target[0])


def warnings_of(settings: PathTrialSettings, x: Stage) -> list[str]:
    """What is said about a trial with that stage."""
    said: list[str] = []

    def run_ticks(duration_s: float, step: Any) -> None:
        for number in range(round(100 * duration_s)):
            now_s = 5.0 + 0.01 * number
            if number:
                x.advance(0.01, now_s)
            step(SimpleNamespace(began_s=now_s))

    trial: Any = SimpleNamespace(
        x=x,
        run_ticks=run_ticks,
        hold_at=lambda force_N: None,
        hold_tick=lambda tick: None,
        series=SimpleNamespace(rates=SimpleNamespace(tick_s=0.01)),
        record=SimpleNamespace(point="trial-001"),
        run=SimpleNamespace(event=lambda kind, topic, text: said.append(text)),
    )
    PathTrial(settings).under_force(trial)
    return said


@pytest.mark.parametrize(("share", "warned"), [(1.0, False), (0.95, False), (0.7, True)])
def test_an_x_that_does_not_follow_its_path_has_a_warning(share: float, warned: bool) -> None:
    """Found by an attack: x at 70 % of its speed made a valid trial without a word."""
    settings = PathTrialSettings(
        path_times_s=(0.0, 0.5, 1.0, 1.5), path_positions_mm=(0.0, 2.0, 2.0, 0.0)
    )
    said = warnings_of(settings, Stage(share))
    assert bool(said) == warned
    assert all("trial-001: x was up to 0.6" in text for text in said)
    assert all("more than 60 ms at 4 mm/s" in text for text in said)


@pytest.mark.parametrize(
    ("times_s", "positions_mm", "step_mm_s"),
    [
        ((0.0, 0.5, 1.0), (0.0, 10.0, 0.0), 40.0),
        ((0.0, 0.5, 0.51, 1.01), (0.0, 10.0, 10.0, 0.0), 40.0),
        ((0.0, 0.5, 1.0, 1.5), (0.0, 10.0, 10.0, 0.0), 20.0),
        ((0.0, 0.5, 1.0), (0.0, 10.0, 15.0), 20.0),
    ],
    ids=["reversal", "reversal over a short rest", "rest", "slower"],
)
def test_a_stage_with_the_acceleration_of_its_drive_has_no_warning(
    times_s: tuple[float, ...], positions_mm: tuple[float, ...], step_mm_s: float
) -> None:
    """A turn at 20 mm/s takes an ideal stage 3.0 mm off its path."""
    settings = PathTrialSettings(path_times_s=times_s, path_positions_mm=positions_mm)
    assert settings.largest_speed_step_mm_s == pytest.approx(step_mm_s)
    assert warnings_of(settings, Stage(acceleration_mm_s2=settings.acceleration_mm_s2)) == []
    (said,) = warnings_of(settings, Stage(acceleration_mm_s2=settings.acceleration_mm_s2 / 4))
    assert "x was up to" in said


@pytest.mark.thorough
def test_x_follows_the_path_and_the_force_its_course_and_the_skin_is_lifted(rig: Any) -> None:
    from nexusformat.nexus.validate import lint_nxdl, validate_application, validate_file

    done = rig.run(
        "path-trial", "--json", "--world", rig.world(""),
        "--world-log", str(rig.world_log), "--normal-force", "3N",
        "--tick", "200", "--path-times", "0,0.2,0.5,0.6",
        "--path-positions", "0,0.06,0.06,0", "--force-times", "0,0.8,1.1",
        "--force-shares", "1,1,0.5", "--stay", "0.4",
    )  # fmt: skip
    assert done.code == 0, done.stderr
    z = [e for e in rig.log() if e["device"] == "stage_z" and e["what"] in ("move", "at-rest")]
    assert (z[-1]["what"], z[-1]["value"]) == ("at-rest", pytest.approx(5.0, abs=0.01))
    file, definition = rig.only("*.h5"), definition_path("NXrig_path_trial")
    assert lint_nxdl(definition) == []
    assert validate_file(str(file)) == (0, 0)
    assert validate_application(str(file), application=str(definition)) == (0, 0)
    with RunFile.open(file) as run:
        (reading,) = run.readings()
        (force,) = run.waveforms("trial-001", stream="force")
        (ticks,) = run.waveforms("trial-001", stream="ticks")
        (position,) = run.waveforms("trial-001", stream="position")
        begun_s = reading["motion_from_s"]
        since_s = ticks.values("elapsed") - begun_s
        x_mm = position.values("x") - 10.0
        normal_N = force.values("F_n")
        at_s = np.arange(normal_N.size) / 1000 - begun_s
    for time_s, wanted_mm in ((-0.05, 0.0), (0.1, 0.03), (0.35, 0.06), (0.9, 0.0)):
        assert np.interp(time_s, since_s, x_mm) == pytest.approx(wanted_mm, abs=0.008)
    for time_s, wanted_N in ((-0.1, 3.0), (0.6, 3.0), (0.95, 2.25), (1.4, 1.5)):
        near = np.abs(at_s - time_s) < 0.01
        assert normal_N[near].mean() == pytest.approx(wanted_N, abs=0.12)
    assert reading["smallest_normal_N"] == pytest.approx(1.5, abs=0.1)
    assert rig.only("*.png").stat().st_size > 20_000, "one trial has one figure"
    assert not reading["invalid"], "the force is judged by the set point of its time"
    forces = [one for one in notices_in(reading) if isinstance(one, HeldForce)]
    assert forces[0].force_N == 3.0
    assert 0 < forces[0].sample / 1000 < begun_s
    course = [(one.sample / 1000 - begun_s, one.force_N) for one in forces[1:]]
    assert [force_N for _, force_N in course] == sorted((f for _, f in course), reverse=True)
    for time_s, force_N in course:
        wanted_N = np.interp(time_s, [0.8, 1.1], [3.0, 1.5])
        assert force_N == pytest.approx(wanted_N, abs=0.1), "within some ticks"
    assert course[-1][1] == pytest.approx(1.5)


@pytest.mark.thorough
def test_a_set_point_that_leaps_is_no_lost_force_and_z_stays_slow_enough_to_brake(rig: Any) -> None:
    """From 2 to 12 N within a millisecond: the force cannot be there at once. From 12 N on only 3 N
    are left to the limit, so z is slower than under 2 N."""
    done = rig.run(
        "path-trial", "--json", "--no-figures", "--world-log", str(rig.world_log),
        "--normal-force", "2N", "--force-times", "0,0.4,0.401", "--force-shares", "1,1,6",
        "--stay", "1.0",
    )  # fmt: skip
    assert done.code == 5, done.stderr  # no trial is valid, see below
    assert done.errors == []
    with RunFile.open(rig.only("*.h5")) as run:
        (reading,) = run.readings()
        (force,) = run.waveforms("trial-001", stream="force")
        (ticks,) = run.waveforms("trial-001", stream="ticks")
        (position,) = run.waveforms("trial-001", stream="position")
        begun_s = reading["motion_from_s"]
        looked_s, z_mm = ticks.values("elapsed") - begun_s, position.values("z")
        normal_N = force.values("F_n")
        since_s = np.arange(normal_N.size) / 1000 - begun_s
    late = (since_s > 1.0) & (since_s < 1.3)
    assert normal_N[late].mean() == pytest.approx(12.0, rel=0.02)
    assert normal_N.max() < 13.0
    assert "force error peak" in reading["invalid"], "the force was far from its set point"
    fastest_mm_s = (np.diff(z_mm) / np.diff(looked_s))[looked_s[1:] > 0.3].max()
    assert 0.2 < fastest_mm_s < 0.55, "3 N at 250 N/mm allow 0.52 mm/s, 13 N would allow 1.3"


@pytest.mark.thorough
def test_a_series_has_a_figure_of_its_trials(rig: Any) -> None:
    world = rig.world("")
    given = ("--world", world, "--force-times", "0,0.1", "--force-shares", "1,1.1")
    two = rig.run("path-trial", "--json", *given, "--stay", "0.1", "-n", "2")
    assert two.code == 0, two.stderr
    (name,) = [name for name in two.object["figures"] if name.endswith("-series.svg")]
    drawn = (rig.folder / name).read_text("utf-8")
    assert "SIMULATED path series, 2 of 2 trials valid" in drawn
    assert "strip 1: " in drawn
