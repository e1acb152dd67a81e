"""The figures of a slip trial: the strips' signal in the manner of the paper's Figure 10, the
forces with their ratio, and the error of the normal force."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from rig.figures.pressed import (
    LEAST_FORCE,
    WHOLE_RIDGE,
    a_figure_a_trial,
    from_touch_on,
    heading,
    mark_slips,
    seconds,
    shade,
    show_allowed_error,
    slips_of_the_world,
)
from rig.figures.style import STYLE, legend_above, set_margins

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from rig.files.runfile.reader import RunFile

ZOOM_S = 0.3
"""Time around the slip that is shown enlarged, as in the paper's Figure 10."""
REASON_WIDTH = 80
"""Number of characters of a line that fits into a panel."""


def draw_trials(run: RunFile) -> dict[str, Figure]:
    """Draw one figure per trial: the first has the run's name, the others append their own."""
    return a_figure_a_trial(run, draw_trial)


def draw_trial(run: RunFile, number: int, point: str) -> Figure:
    """Draw v_d, strips, forces, ratio and force error over time, with the slide or the ramp shaded
    and, on a simulated bench, the slips of the World marked; below, v_d around the slip."""
    series = {w.stream: w for w in run.waveforms(point)}
    signals, force = series["signals"], series["force"]
    begin, end = (float(run.column(name)[number]) for name in ("slide_from", "slide_to"))
    wanted = float(run.column("set_normal_force")[number])
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 10.4))
        # The empty row is for the times below the panels that share them.
        grid = figure.add_gridspec(7, 1, height_ratios=[1.8, 1.5, 1.6, 1.2, 1.0, 0.1, 2.0])
        difference = figure.add_subplot(grid[0])
        below = [figure.add_subplot(grid[row], sharex=difference) for row in range(1, 5)]
        strips, newtons, ratio, error = below
        zoom = figure.add_subplot(grid[6])
        for axes in (difference, *below[:-1]):
            axes.tick_params(labelbottom=False)
        t, mV = seconds(signals), {name: 1e3 * signals.values(name) for name in signals.counts}
        for axes in (difference, zoom):
            axes.plot(t, mV["v_d"], linewidth=0.8, color="C0", label="$v_d = v_1 - v_2$")
            axes.set_ylabel("$v_d$ (mV)")
        for colour, name, label in (("C1", "v_1", "$v_1$"), ("C2", "v_2", "$v_2$")):
            strips.plot(t, mV[name], linewidth=0.6, color=colour, label=label)
        strips.set_ylabel("Strips (mV)")
        slid = (t >= begin) & (t <= end)
        slips = slips_of_the_world(run, number, float(t[-1]))
        seen = t[slid][np.abs(mV["v_d"][slid]).argmax()] if slid.any() else begin
        middle = slips.get(WHOLE_RIDGE, float(seen))
        zoom.set_xlim(middle - ZOOM_S / 2, middle + ZOOM_S / 2)
        zoom.set_xlabel("Time since the record's start (s)")
        mark_slips((difference, zoom), slips)
        t, pressing, sideways = seconds(force), force.values("F_n"), force.values("F_t")
        newtons.plot(t, pressing, linewidth=0.8, label="$F_n$")
        newtons.plot(t, sideways, linewidth=0.8, label="$F_t$")
        newtons.set_ylabel("Force (N)")
        _ratio(ratio, t, pressing, sideways, wanted)
        _coefficients(ratio, run, number)
        held = (t >= begin) & (t <= end)
        error.plot(t[held], 100 * (pressing[held] / wanted - 1), linewidth=0.6, color="C3")
        show_allowed_error(error, run)
        error.set_ylabel("$F_n$ error (%)")
        loading = run.header.settings.get("loading", "slide")
        shade((difference, *below), begin, end, f"the {loading}")
        for axes in (difference, *below, zoom):
            legend_above(axes)
        from_touch_on(error, t, pressing, wanted)
        lines = heading(figure, run, number, point)
        set_margins(figure, top=0.72 + 0.18 * (lines - 2), between=0.3)
    return figure


def _ratio(
    axes: Axes,
    t: NDArray[np.float64],
    pressing: NDArray[np.float64],
    sideways: NDArray[np.float64],
    wanted: float,
) -> None:
    pressed = pressing > LEAST_FORCE * wanted
    values = np.where(pressed, sideways / np.where(pressed, pressing, 1.0), np.nan)
    axes.plot(t, values, linewidth=0.7, color="0.3")
    axes.set_ylabel("$F_t/F_n$")


def _coefficients(axes: Axes, run: RunFile, number: int) -> None:
    for name, colour in (("static_friction", "C1"), ("kinetic_friction", "C4")):
        found = float(run.column(name)[number])
        if np.isfinite(found):
            label = f"{name.replace('_', ' ')} {found:.3f}"
            axes.axhline(found, color=colour, linestyle="--", linewidth=0.8, label=label)
    why = str(run.column("no_friction")[number]) if "no_friction" in run.columns() else ""
    if why:
        text = textwrap.fill(f"no friction coefficients: {why}", REASON_WIDTH)
        axes.text(0.02, 0.9, text, transform=axes.transAxes, va="top", fontsize=8)
