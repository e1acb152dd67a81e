"""The figures of a path trial: the strips' signals, the forces, and the way of x."""

from __future__ import annotations

from typing import TYPE_CHECKING

import matplotlib as mpl
from matplotlib.figure import Figure

from rig.figures.pressed import a_figure_a_trial, from_touch_on, heading, seconds, shade
from rig.figures.style import STYLE, legend_above, set_margins

if TYPE_CHECKING:
    from rig.files.runfile.reader import RunFile


def draw_trials(run: RunFile) -> dict[str, Figure]:
    """Draw one figure per trial: the first has the run's name, the others append their own."""
    return a_figure_a_trial(run, draw_trial)


def draw_trial(run: RunFile, number: int, point: str) -> Figure:
    """Draw v_d, the strips, the forces and the position of x over time, with the motion shaded."""
    series = {w.stream: w for w in run.waveforms(point)}
    signals, force, position = series["signals"], series["force"], series["position"]
    begin, end = (float(run.column(name)[number]) for name in ("motion_from", "motion_to"))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 7.6))
        panels = figure.subplots(
            4, 1, sharex=True, gridspec_kw={"height_ratios": [1.6, 1.6, 1.6, 1.2]}
        )
        difference, strips, newtons, way = panels
        t = seconds(signals)
        difference.plot(t, 1e3 * signals.values("v_d"), linewidth=0.8, label="$v_d = v_1 - v_2$")
        difference.set_ylabel("$v_d$ (mV)")
        for colour, name, label in (("C1", "v_1", "$v_1$"), ("C2", "v_2", "$v_2$")):
            strips.plot(t, 1e3 * signals.values(name), linewidth=0.7, color=colour, label=label)
        strips.set_ylabel("Strips (mV)")
        t, pressing = seconds(force), force.values("F_n")
        newtons.plot(t, pressing, linewidth=0.8, label="$F_n$")
        newtons.plot(t, force.values("F_t"), linewidth=0.8, label="$F_t$")
        newtons.set_ylabel("Force (N)")
        ticks = series["ticks"].values("elapsed")
        way.plot(ticks, position.values("x"), linewidth=0.9, label="$x$ measured")
        commanded = position.values("x_commanded")
        way.plot(
            ticks, commanded, "--", linewidth=0.7, color="0.4", label="$x$, target of the move"
        )
        way.set_ylabel("$x$ (mm)")
        way.set_xlabel("Time since the record's start (s)")
        shade(panels, begin, end, "the motion")
        for axes in panels:
            legend_above(axes)
        from_touch_on(way, t, pressing, float(run.column("set_normal_force")[number]))
        lines = heading(figure, run, number, point)
        set_margins(figure, top=0.72 + 0.18 * (lines - 2), between=0.22)
    return figure
