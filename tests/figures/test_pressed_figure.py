"""Common parts of the figures of pressed trials."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from rig.figures.pressed import mark_slips, scale_to


def test_an_axis_is_scaled_by_the_values_that_are_given_and_not_by_what_is_drawn() -> None:
    axes = Figure().subplots()
    axes.plot([0, 1, 2], [-100.0, 1.0, 3.0])
    scale_to(axes, [np.array([1.0, np.nan]), np.array([3.0])])
    low, high = axes.get_ylim()
    assert -0.5 < low < 1.0
    assert 3.0 < high < 4.5
    scale_to(axes, [np.array([np.nan])])
    assert axes.get_ylim() == (low, high)


def test_slips_of_the_world_are_told_apart_and_named_once() -> None:
    upper, lower = Figure().subplots(2, 1)
    mark_slips((upper, lower), {"whole ridge slips": 2.1, "gross slip": 2.3})
    assert [line.get_xdata()[0] for line in upper.lines] == [2.1, 2.3]
    assert len({line.get_linestyle() for line in lower.lines}) == 2
    named = [line.get_label() for line in lower.lines]
    assert named == ["whole ridge slips (World)", "gross slip (World)"]
    assert not upper.get_legend_handles_labels()[1]
