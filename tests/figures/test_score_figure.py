"""Figures of a score: one column wide, with axes that fit the data."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import matplotlib as mpl
import numpy as np
import pytest
from legible import faults

from rig.evaluation.scoring.roc import AXES
from rig.figures.score import draw_delays, draw_found, draw_roc
from rig.figures.style import STYLE

TITLE = "simulated trials, reporting seeds 1000000:1000400, 1600 trials"


def contenders(alarms: float, count: int = 8) -> list[Any]:
    """Results of detectors whose own thresholds give this share of false alarms."""
    threshold = np.geomspace(1 / 8, 8, 13)
    curve = SimpleNamespace(
        threshold=threshold, alarms=np.clip(alarms / threshold, 0, 1),
        found=np.clip(0.9 / threshold**0.2, 0, 1),
    )  # fmt: skip
    found = SimpleNamespace(value=0.8, low=0.7, high=0.9)
    groups = [
        SimpleNamespace(trait=trait, bin=name, score={"found": found})
        for trait in ("noise_mV", "friction_ratio", "speed_mm_s")
        for name in ("below 0.1", "0.1 to 0.2", "0.2 and above")
    ]
    outcomes = [
        SimpleNamespace(label="slip", found=True, after_ridge_s=1e-3 * n) for n in range(12)
    ]
    return [
        SimpleNamespace(
            contender=SimpleNamespace(name=f"detector {n}"), outcomes=outcomes, groups=groups,
            rocs=dict.fromkeys(AXES, curve),
        )
        for n in range(count)
    ]  # fmt: skip


@pytest.mark.parametrize(("alarms", "end"), [(0.004, 0.05), (0.08, 0.12), (0.6, 0.5)])
def test_the_axis_of_false_alarms_fits_the_detectors_own_thresholds(
    alarms: float, end: float
) -> None:
    figure = draw_roc(cast("Any", contenders(alarms, 2)), TITLE)
    for axes in figure.axes:
        assert axes.get_xlim()[1] == pytest.approx(end)


def test_no_two_contenders_look_alike_and_counts_begin_at_0() -> None:
    """The ideal observer, the ninth, had colour and marker of the first detector."""
    results = cast("Any", contenders(0.05, 9))
    looks = {
        (bars.lines[0].get_color(), bars.lines[0].get_marker())
        for bars in draw_found(results, TITLE).axes[0].containers
    }
    assert len(looks) == 9
    results[0].outcomes[:] = [SimpleNamespace(label="slip", found=False, after_ridge_s=0.0)]
    for axes in draw_delays(results, TITLE).axes:
        low, high = axes.get_ylim()
        assert low == 0
        assert high >= 1


def test_the_markers_of_none_and_of_all_are_whole_and_the_ratio_is_called_one() -> None:
    for figure in (
        draw(cast("Any", contenders(0.05, 2)), TITLE) for draw in (draw_roc, draw_found)
    ):
        low, high = figure.axes[0].get_ylim()
        assert low < -0.03
        assert high > 1.03
    labels = [axes.get_xlabel() for axes in figure.axes]
    assert "Friction ratio, $μ_k / μ_s$" in labels


@pytest.mark.parametrize("draw", [draw_roc, draw_found, draw_delays])
def test_a_score_is_legible_at_84_mm(draw: Any) -> None:
    figure = draw(contenders(0.05), TITLE)
    with mpl.rc_context(STYLE):
        assert [fault for fault in faults(figure) if "a curve runs" not in fault] == []
