"""The figures of a roll trial, in the manner of the paper's Figures 17 and 19: the turn, both
strips' signals and their difference, the forces, and the error of the normal force."""

from __future__ import annotations

from typing import TYPE_CHECKING

import matplotlib as mpl

from rig.figures.pressed import (
    a_figure_a_trial,
    draw_difference,
    draw_force_error,
    draw_forces,
    draw_strips,
    from_touch_on,
    heading,
    scale_to,
    seconds,
    shade,
)
from rig.figures.slip_instants import ROWS_LEFT, Detections, draw_rows, instants_of
from rig.figures.style import (
    BLACK,
    BLUE,
    GREY,
    STYLE,
    column_figure,
    legend_above,
    letter,
    set_margins,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from rig.files.runfile.reader import RunFile


AROUND_S = 0.05
"""Time around the roll whose signals set the scale."""


def draw_trials(run: RunFile) -> dict[str, Figure]:
    """Draw one figure per trial: the first has the run's name, the others append their own."""
    return a_figure_a_trial(run, draw_trial)


def draw_trial(run: RunFile, number: int, point: str, detected: Detections) -> Figure:
    """Draw the angle and its deviation from the commanded one, strips, difference, forces and force
    error over time, with the roll shaded, and the slips, true (simulated bench) and `detected`.
    Strips and difference are scaled to the roll; what the touch-down goes beyond is in the file."""
    series = {w.stream: w for w in run.waveforms(point)}
    signals, force, rotation = series["signals"], series["force"], series["rotation"]
    begin, end = (float(run.column(name)[number]) for name in ("roll_from", "roll_to"))
    wanted = float(run.column("set_normal_force")[number])
    with mpl.rc_context(STYLE):
        figure = column_figure(190)
        # The empty row is for what the accounts of the slips rest on.
        heights = [1.2, 0.9, 1.7, 1.4, 1.4, 1.1, 0.02, 1.4]
        every = figure.subplots(
            len(heights), 1, sharex=True, gridspec_kw={"height_ratios": heights}
        )
        every[6].remove()
        panels = [*every[:6], every[7]]
        angle, deviation, strips, difference, newtons, error, rows = panels
        ticks = series["ticks"].values("elapsed")
        angle.plot(ticks, rotation.values("angle"), color=BLUE, label=r"$\phi$ measured")
        commanded = rotation.values("angle_commanded")
        angle.plot(ticks, commanded, "--", color=GREY, label=r"$\phi$ commanded")
        angle.set_ylabel("Angle (deg)")
        behind = rotation.values("angle") - commanded
        deviation.plot(ticks, behind, linewidth=0.7, color=BLACK, label="measured − commanded")
        deviation.set_ylabel("Deviation (deg)")
        t = seconds(signals)
        draw_strips(strips, t, signals)
        draw_difference(difference, t, signals)
        rolled = (t >= begin - AROUND_S) & (t <= end + AROUND_S)
        for axes, names in ((strips, ("v_1", "v_2")), (difference, ("v_d",))):
            axes.set_title("scaled to the roll", loc="left")
            scale_to(axes, [1e3 * signals.values(name)[rolled] for name in names])
        t, pressing = seconds(force), force.values("F_n")
        draw_forces(newtons, t, force)
        draw_force_error(error, run, number, force, (begin, end))
        rows.set_xlabel("Time since the record's start (s)")
        shade(panels, begin, end, "the roll")
        for axes in panels:
            legend_above(axes)
        from_touch_on(error, t, pressing, wanted)
        draw_rows(rows, instants_of(run, number, series, detected), error.get_xlim())
        letter(panels)
        set_margins(
            figure, top=heading(figure, run, number, point) + 0.14, gap_mm=4.0, left=ROWS_LEFT
        )
        figure.align_ylabels(panels[:-1])
    return figure
