"""The figures of a roll trial, in the manner of the paper's Figures 17 and 19: the turn, both
strips' signals and their difference, the forces, and the error of the normal force."""

from __future__ import annotations

from typing import TYPE_CHECKING

import matplotlib as mpl
from matplotlib.figure import Figure

from rig.figures.pressed import (
    a_figure_a_trial,
    from_touch_on,
    heading,
    scale_to,
    seconds,
    shade,
    show_allowed_error,
)
from rig.figures.style import STYLE, legend_above, set_margins

if TYPE_CHECKING:
    from rig.files.runfile.reader import RunFile


AROUND_S = 0.05
"""Time around the roll whose signals set the scale."""


def draw_trials(run: RunFile) -> dict[str, Figure]:
    """Draw one figure per trial: the first has the run's name, the others append their own."""
    return a_figure_a_trial(run, draw_trial)


def draw_trial(run: RunFile, number: int, point: str) -> Figure:
    """Draw the angle and its deviation from the commanded one, strips, difference, forces and force
    error over time, with the roll shaded. Strips and difference are scaled by the roll; what the
    touch-down goes beyond is in the file."""
    series = {w.stream: w for w in run.waveforms(point)}
    signals, force, rotation = series["signals"], series["force"], series["rotation"]
    begin, end = (float(run.column(name)[number]) for name in ("roll_from", "roll_to"))
    wanted = float(run.column("set_normal_force")[number])
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 9.8))
        panels = figure.subplots(
            6, 1, sharex=True, gridspec_kw={"height_ratios": [1.2, 0.9, 2.0, 1.4, 1.5, 1.0]}
        )
        angle, deviation, strips, difference, newtons, error = panels
        ticks = series["ticks"].values("elapsed")
        angle.plot(ticks, rotation.values("angle"), linewidth=0.9, label=r"$\phi$ measured")
        commanded = rotation.values("angle_commanded")
        angle.plot(ticks, commanded, "--", linewidth=0.7, color="0.4", label=r"$\phi$ commanded")
        angle.set_ylabel("Angle (deg)")
        behind = rotation.values("angle") - commanded
        deviation.plot(ticks, behind, linewidth=0.7, color="C5", label="measured - commanded")
        deviation.set_ylabel("Dev. (deg)")
        t = seconds(signals)
        rolled = (t >= begin - AROUND_S) & (t <= end + AROUND_S)
        for axes, names in ((strips, ("v_1", "v_2")), (difference, ("v_d",))):
            scale_to(axes, [1e3 * signals.values(name)[rolled] for name in names])
        for colour, name, label in (("C1", "v_1", "$v_1$"), ("C2", "v_2", "$v_2$")):
            strips.plot(t, 1e3 * signals.values(name), linewidth=0.7, color=colour, label=label)
        strips.set_ylabel("Strips (mV)")
        difference.plot(t, 1e3 * signals.values("v_d"), linewidth=0.7, label="$v_d = v_1 - v_2$")
        difference.set_ylabel("$v_d$ (mV)")
        t, pressing = seconds(force), force.values("F_n")
        newtons.plot(t, pressing, linewidth=0.8, label="$F_n$")
        newtons.plot(t, force.values("F_t"), linewidth=0.8, label="$F_t$")
        newtons.set_ylabel("Force (N)")
        held = (t >= begin) & (t <= end)
        error.plot(t[held], 100 * (pressing[held] / wanted - 1), linewidth=0.6, color="C3")
        show_allowed_error(error, run)
        error.set_ylabel("$F_n$ error (%)")
        error.set_xlabel("Time since the record's start (s)")
        shade(panels, begin, end, "the roll")
        for axes in panels:
            legend_above(axes)
        from_touch_on(error, t, pressing, wanted)
        lines = heading(figure, run, number, point)
        set_margins(figure, top=0.72 + 0.18 * (lines - 2), between=0.24)
    return figure
