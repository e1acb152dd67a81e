"""Common parts of the figures of pressed trials."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from rig.figures.pressed import scale_to


def test_an_axis_is_scaled_by_the_values_that_are_given_and_not_by_what_is_drawn() -> None:
    axes = Figure().subplots()
    axes.plot([0, 1, 2], [-100.0, 1.0, 3.0])
    scale_to(axes, [np.array([1.0, np.nan]), np.array([3.0])])
    low, high = axes.get_ylim()
    assert -0.5 < low < 1.0
    assert 3.0 < high < 4.5
    scale_to(axes, [np.array([np.nan])])
    assert axes.get_ylim() == (low, high)
