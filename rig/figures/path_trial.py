"""The figures of a path trial: the strips' signals, the forces, and the way of x."""

from __future__ import annotations

from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np

from rig.figures.pressed import (
    a_figure_a_trial,
    draw_difference,
    draw_forces,
    draw_strips,
    from_touch_on,
    heading,
    seconds,
    shade,
)
from rig.figures.slip_instants import ROWS_LEFT, Detections, draw_rows, instants_of, mark
from rig.figures.style import (
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


def draw_trials(run: RunFile) -> dict[str, Figure]:
    """Draw one figure per trial: the first has the run's name, the others append their own."""
    return a_figure_a_trial(run, draw_trial)


def strokes_of(run: RunFile, begin_s: float) -> list[tuple[float, float]]:
    """Return from when to when in s of a record x moves in one direction, for a path that begins at
    `begin_s`: its segments, those in the same direction together. A rest ends a stroke."""
    times_s = run.settings.get("path_times_s", ())
    steps_mm = np.diff(run.settings.get("path_positions_mm", ()))
    strokes: list[tuple[float, float]] = []
    before = 0.0
    for from_s, to_s, step_mm in zip(times_s[:-1], times_s[1:], steps_mm, strict=True):
        direction = float(np.sign(step_mm))
        if direction and direction == before:
            strokes[-1] = (strokes[-1][0], begin_s + to_s)
        elif direction:
            strokes.append((begin_s + from_s, begin_s + to_s))
        before = direction
    return strokes


def draw_trial(run: RunFile, number: int, point: str, detected: Detections) -> Figure:
    """Draw v_d, the strips, the forces and the position of x over time, with the motion shaded, and
    the slips, true (simulated bench) and `detected`."""
    series = {w.stream: w for w in run.waveforms(point)}
    signals, force, position = series["signals"], series["force"], series["position"]
    begin, end = (float(run.column(name)[number]) for name in ("motion_from", "motion_to"))
    with mpl.rc_context(STYLE):
        figure = column_figure(150)
        # The empty row is for what the accounts of the slips rest on.
        heights = [1.6, 1.4, 1.4, 1.2, 0.02, 1.4]
        every = figure.subplots(
            len(heights), 1, sharex=True, gridspec_kw={"height_ratios": heights}
        )
        every[4].remove()
        panels = [*every[:4], every[5]]
        difference, strips, newtons, way, rows = panels
        t = seconds(signals)
        draw_difference(difference, t, signals)
        draw_strips(strips, t, signals)
        t, pressing = seconds(force), force.values("F_n")
        draw_forces(newtons, t, force)
        ticks = series["ticks"].values("elapsed")
        way.plot(ticks, position.values("x"), color=BLUE, label="$x$ measured")
        commanded = position.values("x_commanded")
        way.plot(ticks, commanded, "--", color=GREY, label="$x$, target of the move")
        way.set_ylabel("$x$ (mm)")
        rows.set_xlabel("Time since the record's start (s)")
        shade(panels, begin, end, "the motion")
        for axes in panels:
            legend_above(axes)
        from_touch_on(way, t, pressing, float(run.column("set_normal_force")[number]))
        instants = instants_of(run, number, series, detected, *strokes_of(run, begin))
        draw_rows(rows, instants, way.get_xlim())
        mark((difference,), instants)
        if any(instants.slips_s().values()):
            difference.set_title("lines as in (e)", loc="left")
        letter(panels)
        set_margins(
            figure, top=heading(figure, run, number, point) + 0.14, gap_mm=4.0, left=ROWS_LEFT
        )
        figure.align_ylabels(panels[:-1])
    return figure
