"""The lines with which a run begins and ends."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from threading import Timer

import pytest

from procedures.slip_trial import SlipTrial
from procedures.sweep import Sweep
from rig.cli import report
from rig.cli.report import ConsoleObserver, closing_lines
from rig.core.errors import ExitCode
from rig.figures.drawing import DrawingProcess, Drawn
from rig.run.arming import ShutdownFailure
from rig.run.making_safe.guard_link import TakenOver
from rig.run.outcome import RunOutcome
from rig.run.points import Point
from rig.run.stopping import StopRequestedError

POINTS = [Point(f"p{k}", k, (), duration_s=2.0) for k in range(20)]
FILE = Path("results/a.h5")
JOURNAL = Path("results/a.rigj")


def test_a_complete_run_says_so_and_where_its_data_are() -> None:
    outcome = RunOutcome("complete", ExitCode.DONE, 175, 175, simulated=True, file=FILE)
    outcome.duration_s, outcome.safe = 18.02, True
    outcome.made_safe = ("generator off", "preload released", "force stream stopped")
    assert closing_lines(
        Sweep, outcome, [Path(f"a-{k}.{kind}") for k in range(3) for kind in ("png", "svg")]
    ) == [
        "Finished: 175 of 175 points in 18.0 s of bench time (simulated).",
        "Saved: results/a.h5 and 3 figures (PNG and SVG)",
        "Bench is safe: generator off, preload released, force stream stopped.",
    ]


def test_a_run_on_a_real_bench_speaks_of_no_bench_time_and_one_trial_is_a_trial() -> None:
    outcome = RunOutcome("complete", ExitCode.DONE, 1, 1, file=FILE, duration_s=9.0)
    assert closing_lines(SlipTrial, outcome, [Path("a.png"), Path("a.svg")]) == [
        "Finished: 1 of 1 trial in 9.0 s.",
        "Saved: results/a.h5 and 1 figure (PNG and SVG)",
    ]


def test_a_run_that_was_stopped_says_by_what_and_how_to_resume_it() -> None:
    stopped = StopRequestedError(signal.SIGINT)
    outcome = RunOutcome("stopped", ExitCode.SIGINT, 20, 3, file=FILE, journal=JOURNAL)
    outcome.failures, outcome.duration_s = [stopped], 75.0
    assert closing_lines(SlipTrial, outcome, []) == [
        "Stopped by Ctrl-C: 3 of 20 trials in 0:01:15.",
        "Saved: results/a.h5",
        "Resume with: rig resume results/a.rigj",
    ]


def test_a_run_that_was_refused_says_that_it_did_not_begin() -> None:
    outcome = RunOutcome("failed", ExitCode.LIMIT, 1, 0, simulated=True)
    assert closing_lines(SlipTrial, outcome, []) == [
        "Failed: the run did not begin, nothing was recorded."
    ]
    resumed = RunOutcome("failed", ExitCode.INSTRUMENT, 3, 2, simulated=True)
    assert closing_lines(SlipTrial, resumed, []) == ["Failed: 2 of 3 trials (simulated)."]


def test_a_bench_that_is_not_safe_is_not_called_safe() -> None:
    outcome = RunOutcome("failed", ExitCode.UNSAFE, 20, 3, journal=JOURNAL)
    outcome.off_failures = [ShutdownFailure("normal force", "no answer")]
    outcome.made_safe = ("x stage stopped",)
    assert closing_lines(SlipTrial, outcome, []) == [
        "Failed: 3 of 20 trials.",
        "Bench is NOT safe (see above); done: x stage stopped.",
        "Recover the run file with: rig recover results/a.rigj",
    ]
    outcome.off_failures = []
    assert closing_lines(SlipTrial, outcome, [])[1] == (
        "Bench is stopped, but check it (see above): x stage stopped."
    )


def test_a_resumed_run_says_which_points_are_of_an_earlier_attempt_and_what_its_time_is() -> None:
    outcome = RunOutcome("complete", ExitCode.DONE, 175, 175, simulated=True, file=FILE)
    outcome.duration_s, outcome.points_earlier = 30.0, 39
    assert closing_lines(Sweep, outcome, [])[0] == (
        "Finished: 175 of 175 points, 39 of them earlier, in 30.0 s of bench time since the resume "
        "(simulated)."
    )
    refused = RunOutcome("failed", ExitCode.INSTRUMENT, 175, 39, points_earlier=39)
    assert closing_lines(Sweep, refused, []) == ["Failed: 39 of 175 points, 39 of them earlier."]


def test_a_run_that_is_stopped_before_anything_was_armed_says_so_and_shows_no_results(
    capsys: pytest.CaptureFixture[str],
) -> None:
    outcome = RunOutcome("stopped", ExitCode.SIGINT, 3, 0, file=FILE, journal=JOURNAL)
    outcome.failures, outcome.in_brief = [StopRequestedError(signal.SIGINT)], ["valid: 0 of 0"]
    outcome.safe, outcome.armed, outcome.own_bench = True, False, True
    report.finish(SlipTrial, outcome, as_json=False, drawing=None, debug=False)
    assert capsys.readouterr().err.splitlines() == [
        "Stopped by Ctrl-C: 0 of 3 trials.",
        "Saved: results/a.h5",
        "Bench is safe: there was nothing to switch off.",
        "Resume with: rig resume results/a.rigj",
    ]
    outcome.own_bench = False
    assert closing_lines(SlipTrial, outcome, [])[2] == (
        "Bench is unchanged: there was nothing to switch off."
    ), "an earlier run may have left something pressed"


def test_what_may_still_be_pressed_is_named_before_it_is_said_how_to_resume() -> None:
    outcome = RunOutcome("failed", ExitCode.INSTRUMENT, 3, 0, file=FILE, journal=JOURNAL)
    outcome.left = ("the skin may still be pressed",)
    outcome.made_safe = ("x stage stopped", "acquisition off")
    assert closing_lines(SlipTrial, outcome, [])[2:] == [
        "Bench is stopped, but the skin may still be pressed (see above): check stage_z before you "
        "resume; done: x stage stopped, acquisition off.",
        "Resume with: rig resume results/a.rigj",
    ]
    outcome.points_done = 3
    (line,) = closing_lines(SlipTrial, outcome, [])[2:]
    assert "check stage_z before the next run; done: " in line


def test_a_run_that_left_its_bench_unsafe_is_resumed_once_that_is_safe() -> None:
    outcome = RunOutcome("failed", ExitCode.UNSAFE, 3, 1, file=FILE, journal=JOURNAL)
    outcome.off_failures = [ShutdownFailure("normal force", "no answer")]
    last = "resume with: rig resume results/a.rigj"
    assert closing_lines(SlipTrial, outcome, [])[-1] == f"Once the bench is safe, {last}"
    outcome.taken_over = TakenOver(True, "the guard has stopped it")
    assert closing_lines(SlipTrial, outcome, [])[-1] == f"R{last[1:]}"


def test_plans_pauses_and_points_are_one_line_each(capsys: pytest.CaptureFixture[str]) -> None:
    with ConsoleObserver(SlipTrial, simulated=True) as console:
        console.planned(POINTS[:1], set(), 1.0)
        console.point_recorded(1, 1, POINTS[0], {})
        console.planned(POINTS, {"p0"}, 0.0)
    with ConsoleObserver(SlipTrial) as console:
        console.planned(POINTS, {"p0", "p1", "p2"}, 6.0)
        for state in ("running", "making safe", "paused", "running", "making safe"):
            console.state(state)
    assert capsys.readouterr().err.splitlines() == [
        "slip-trial: 1 trial, about 3.0 s of bench time",
        "1/1 p0",
        "slip-trial: 19 further trials (1 done), about 38.0 s of bench time",
        "slip-trial: resuming, 3 of 20 trials done, 17 to go, about 40.0 s",
        "PAUSED (bench is safe). Ctrl-Z continues, Ctrl-C ends the run.",
        "Resumed.",
    ]


def test_a_points_name_is_shown_as_it_is_on_a_terminal_too(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The bar took brackets for markup, and failed with an exception where they made none."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    point = Point("v[/1] [red]\x1b", 0, (), duration_s=2.0)
    with ConsoleObserver(SlipTrial) as console:
        console.planned([point], set(), 0.0)
        console.point_recorded(1, 1, point, {})
        console.saving()
    assert r"1/1 v[/1] [red]\x1b" in capsys.readouterr().err


def test_a_terminal_that_cannot_redraw_a_line_shows_one_for_each_point(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing but empty lines came there, because a bar is drawn in place only."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "dumb")
    with ConsoleObserver(SlipTrial) as console:
        console.planned(POINTS[:1], set(), 0.0)
        console.point_recorded(1, 1, POINTS[0], {})
        console.saving()
    assert capsys.readouterr().err.splitlines() == ["slip-trial: 1 trial, about 2.0 s", "1/1 p0"]


class Drawing(DrawingProcess):
    """Draws one picture of each file that it is asked to draw, with one warning."""

    def __init__(self) -> None:
        self.files: list[Path] = []

    def draw(self, file: Path, slow: Callable[[], None] = lambda: None) -> Drawn:
        self.files.append(file)
        return Drawn((file.with_suffix(".png"),), ("the figure x of y could not be drawn: z",))


def closing(
    capsys: pytest.CaptureFixture[str], done: int, drawing: Drawing | None
) -> tuple[dict, str]:
    outcome = RunOutcome("complete", ExitCode.DONE, 2, done, file=Path("r.h5"))
    report.finish(Sweep, outcome, as_json=True, drawing=drawing, debug=False)
    printed = capsys.readouterr()
    return json.loads(printed.out), printed.err


def test_figures_are_listed_and_one_that_fails_is_a_warning(
    capsys: pytest.CaptureFixture[str],
) -> None:
    drawing = Drawing()
    answer, reported = closing(capsys, 2, drawing)
    assert drawing.files == [Path("r.h5")]
    assert (answer["figures"], answer["exit"]) == (["r.png"], 0)
    assert answer["warnings"] == ["the figure x of y could not be drawn: z"]
    assert "warning: the figure x of y could not be drawn: z\n" in reported
    assert "Saved: r.h5 and 1 figure (PNG and SVG)\n" in reported


def test_ctrl_c_ends_the_wait_for_figures_and_not_the_run_which_is_over(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    said = Drawn((Path("r.png"),)).as_line("the figure x of y")
    busy = subprocess.Popen(
        ["/bin/sh", "-c", 'echo "$1"; sleep 1000', "sh", said],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    drawing = Drawing()
    drawing._child = busy
    monkeypatch.setattr(drawing, "draw", lambda *given: DrawingProcess.draw(drawing, *given))
    monkeypatch.setattr("rig.figures.drawing.SLOW_S", 0.5)
    # To the process, as from a terminal: one that a thread raises for itself would not end the wait
    # of the main thread.
    Timer(2.0, os.kill, [os.getpid(), signal.SIGINT]).start()
    outcome = RunOutcome("complete", ExitCode.DONE, 2, 2, file=Path("r.h5"), safe=True)
    outcome.made_safe = ("generator off",)
    report.finish(Sweep, outcome, as_json=False, drawing=drawing, debug=False)
    assert capsys.readouterr().err.splitlines() == [
        "Bench is safe. Saved: r.h5. Drawing the figures (Ctrl-C leaves them out) ...",
        "warning: the figure x of y and those after it were not drawn: stopped by Ctrl-C; "
        "`rig show --figures r.h5` draws them again",
        "Finished: 2 of 2 points.",
        "Saved: r.h5 and 1 figure (PNG and SVG)",
        "Bench is safe: generator off.",
    ]
    assert outcome.code is ExitCode.DONE
    assert busy.poll() is not None


def test_a_result_that_is_not_finite_is_null_for_another_program(
    capsys: pytest.CaptureFixture[str],
) -> None:
    outcome = RunOutcome("complete", ExitCode.DONE, 2, 2, summary={"worst_V": math.nan})
    report.finish(Sweep, outcome, as_json=True, drawing=None, debug=False)
    outcome_dry = RunOutcome("complete", ExitCode.DONE, 2, 2, summary={"worst_V": math.inf})
    report.finish_dry_run(Sweep, outcome_dry, as_json=True, debug=False)
    for line in capsys.readouterr().out.splitlines():
        assert json.loads(line)["summary"] == {"worst_V": None}


@pytest.mark.parametrize(("done", "drawing"), [(0, Drawing()), (2, None)])
def test_without_a_completed_point_nothing_is_drawn_and_nothing_is_said(
    capsys: pytest.CaptureFixture[str], done: int, drawing: Drawing | None
) -> None:
    answer, reported = closing(capsys, done, drawing)
    assert drawing is None or drawing.files == []
    assert (answer["figures"], answer["warnings"]) == ([], [])
    assert "figure" not in reported
