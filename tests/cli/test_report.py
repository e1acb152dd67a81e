"""What the closing lines of a run say of its figures."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from procedures import sweep
from rig.cli import report
from rig.core.errors import ExitCode
from rig.figures.drawing import Drawn
from rig.run.outcome import Outcome


@pytest.fixture
def drawn_of(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The run files that figures were asked of; each gives one picture and one warning."""
    asked: list[Path] = []

    def draw_in_child(file: Path) -> Drawn:
        asked.append(file)
        return Drawn((file.with_suffix(".png"),), ("the figure x of y could not be drawn: z",))

    monkeypatch.setattr(report, "draw_in_child", draw_in_child)
    return asked


def closing(capsys: pytest.CaptureFixture[str], done: int, figures: bool) -> tuple[dict, str]:
    outcome = Outcome("complete", ExitCode.DONE, 2, done, file=Path("r.h5"))
    report.finish(sweep, outcome, as_json=True, figures=figures, debug=False)
    printed = capsys.readouterr()
    return json.loads(printed.out), printed.err


def test_figures_are_listed_and_one_that_fails_is_a_warning(
    drawn_of: list[Path], capsys: pytest.CaptureFixture[str]
) -> None:
    answer, told = closing(capsys, done=2, figures=True)
    assert drawn_of == [Path("r.h5")]
    assert (answer["figures"], answer["exit"]) == (["r.png"], 0)
    assert answer["warnings"] == ["the figure x of y could not be drawn: z"]
    assert "warning: the figure x of y could not be drawn: z\nfigure: r.png\n" in told


@pytest.mark.parametrize(("done", "figures"), [(0, True), (2, False)])
def test_without_a_completed_point_nothing_is_drawn_and_nothing_is_said(
    drawn_of: list[Path], capsys: pytest.CaptureFixture[str], done: int, figures: bool
) -> None:
    answer, told = closing(capsys, done, figures)
    assert drawn_of == []
    assert (answer["figures"], answer["warnings"]) == ([], [])
    assert "figure" not in told
