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
    a_figure_a_trial,
    from_touch_on,
    heading,
    seconds,
    shade,
    show_allowed_error,
)
from rig.figures.style import STYLE, legend_above, set_margins

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from numpy.typing import NDArray

    from rig.files.runfile.reader import RunFile

REASON_WIDTH = 80
"""Number of characters of a line that fits into a panel."""


def draw_trials(run: RunFile) -> dict[str, Figure]:
    """Draw one figure per trial: the first has the run's name, the others append their own."""
    return a_figure_a_trial(run, draw_trial)


def draw_trial(run: RunFile, number: int, point: str) -> Figure:
    """Draw signal, forces, ratio and force error over time, with the slide or the ramp shaded."""
    series = {w.stream: w for w in run.waveforms(point)}
    signals, force = series["signals"], series["force"]
    begin, end = (float(run.column(name)[number]) for name in ("slide_from", "slide_to"))
    wanted = float(run.column("set_normal_force")[number])
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 7.6))
        volts, newtons, ratio, error = figure.subplots(
            4, 1, sharex=True, gridspec_kw={"height_ratios": [2.4, 1.6, 1.2, 1.0]}
        )
        t, mV = seconds(signals), {name: 1e3 * signals.values(name) for name in signals.counts}
        volts.plot(t, mV["v_d"], linewidth=0.8, color="C0", label="$v_d = v_1 - v_2$")
        for colour, name, label in (("C1", "v_1", "$v_1$"), ("C2", "v_2", "$v_2$")):
            volts.plot(t, mV[name], linewidth=0.5, alpha=0.5, color=colour, label=label)
        volts.set_ylabel("Signal (mV)")
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
        error.set_xlabel("Time since the record's start (s)")
        loading = run.header.settings.get("loading", "slide")
        shade((volts, newtons, ratio, error), begin, end, f"the {loading}")
        for axes in (volts, newtons, ratio, error):
            legend_above(axes)
        from_touch_on(error, t, pressing, wanted)
        lines = heading(figure, run, number, point)
        set_margins(figure, top=0.72 + 0.18 * (lines - 2), between=0.22)
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
