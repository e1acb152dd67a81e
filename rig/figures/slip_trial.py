"""The figures of a slip trial: the strips' signal in the manner of the paper's Figure 10, the
forces with their ratio, the error of the normal force, and when the skin slipped by each account of
it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np

from rig.figures.pressed import (
    LEAST_FORCE,
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
from rig.figures.slip_instants import (
    ROWS_LEFT,
    TRUE,
    Detections,
    SlipInstants,
    draw_rows,
    instants_of,
    mark,
)
from rig.figures.style import (
    BLACK,
    ORANGE,
    PURPLE,
    SMALLEST_PT,
    STYLE,
    column_figure,
    legend_above,
    letter,
    set_margins,
    wrapped,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from rig.files.runfile.reader import RunFile

    Reals = NDArray[np.float64]

BEFORE_SLIP_S, AFTER_SLIP_S = 0.24, 0.06
"""Time around the slip that is shown enlarged: the 0.3 s of the paper's Figure 10, most of it
before the slip, where P_A and the neighbour's event are."""
IMPULSE_S = 0.01
"""Half width of P_B. The impulse of a slip takes a few ms."""
NEAR_SLIP_S = 0.02
"""Time before and after the slip in which its impulse is looked for."""
BRACKETS = 0.3
"""Room for the brackets above the signal, as a share of its span."""
TITLE_PT = 200.0
"""Width of a text that fits above a panel, after its letter."""


def draw_trials(run: RunFile) -> dict[str, Figure]:
    """Draw one figure per trial: the first has the run's name, the others append their own."""
    return a_figure_a_trial(run, draw_trial)


def draw_trial(run: RunFile, number: int, point: str, detected: Detections) -> Figure:
    """Draw v_d, strips, forces, ratio and force error over time, with the slide or the ramp shaded;
    below, v_d around the slip with P_A, the neighbour's event and P_B, and when the skin slipped:
    truly (simulated bench), measured and `detected`."""
    series = {w.stream: w for w in run.waveforms(point)}
    signals, force = series["signals"], series["force"]
    begin, end = (float(run.column(name)[number]) for name in ("slide_from", "slide_to"))
    wanted = float(run.column("set_normal_force")[number])
    instants = instants_of(run, number, series, detected, (begin, end))
    with mpl.rc_context(STYLE):
        figure = column_figure(196)
        # The empty rows are for times below panels that share them, and for the accounts.
        heights = [1.7, 1.3, 1.3, 1.1, 1.1, 0.1, 2.4, 0.06, 1.8]
        grid = figure.add_gridspec(len(heights), 1, height_ratios=heights)
        difference = figure.add_subplot(grid[0])
        strips, newtons, ratio, error = below = [
            figure.add_subplot(grid[row], sharex=difference) for row in range(1, 5)
        ]
        zoom = figure.add_subplot(grid[6])
        rows = figure.add_subplot(grid[8], sharex=zoom)
        for axes in (difference, *below[:-1], zoom):
            axes.tick_params(labelbottom=False)
        t = seconds(signals)
        draw_difference(difference, t, signals)
        draw_strips(strips, t, signals)
        _zoom(zoom, rows, t, 1e3 * signals.values("v_d"), instants, (begin, end))
        mark((difference,), instants)
        if any(instants.slips_s().values()):
            difference.set_title("lines as in (g)", loc="left")
        t, pressing, sideways = seconds(force), force.values("F_n"), force.values("F_t")
        draw_forces(newtons, t, force)
        _ratio(ratio, t, pressing, sideways, wanted)
        _coefficients(ratio, run, number)
        draw_force_error(error, run, number, force, (begin, end))
        loading = run.header.settings.get("loading", "slide")
        shade((difference, *below), begin, end, f"the {loading}")
        for axes in (difference, *below):
            legend_above(axes)
        from_touch_on(error, t, pressing, wanted)
        rows.set_xlabel("Time since the record's start (s)")
        letter((difference, *below, zoom, rows))
        top = heading(figure, run, number, point) + 0.14
        set_margins(figure, top=top, gap_mm=4.0, left=ROWS_LEFT)
        figure.align_ylabels([difference, *below, zoom])
    return figure


def _zoom(
    axes: Axes, rows: Axes, t: Reals, v_d_mV: Reals, instants: SlipInstants,
    motion: tuple[float, float],
) -> None:  # fmt: skip
    """Draw v_d around the slip with what the paper's Figure 10 marks in it, and below it the
    accounts of the slip."""
    slid = (t >= motion[0]) & (t <= motion[1])
    largest = float(t[slid][np.abs(v_d_mV[slid]).argmax()]) if slid.any() else motion[0]
    at = instants.anchor_s(largest)
    seen = at - BEFORE_SLIP_S, at + AFTER_SLIP_S
    inside = (t >= seen[0]) & (t <= seen[1])
    draw_rows(rows, instants, seen)
    axes.plot(t[inside], v_d_mV[inside], linewidth=0.8)
    axes.set_ylabel("$v_d$ (mV)")
    what = f"the slip, {BEFORE_SLIP_S + AFTER_SLIP_S:g} s enlarged; lines as in (g)"
    axes.set_title(what, loc="left")
    if np.count_nonzero(inside) < 2:
        return
    scale_to(axes, [v_d_mV[inside]])
    _mark_as_figure_10(axes, t[inside], v_d_mV[inside], at, instants, motion[0])
    mark((axes,), instants, top=1 / (1 + BRACKETS))


def _mark_as_figure_10(
    axes: Axes, t: Reals, v_d_mV: Reals, slip_s: float, instants: SlipInstants, begin_s: float
) -> None:  # fmt: skip
    """Mark the phases P_A (low-frequency pattern before the slip) and P_B (impulse of the slip) by
    brackets above the signal, and on a simulated bench the slip of a neighbouring ridge. P_B is the
    steepest change of v_d near the slip: the slow pattern before it may be as high, and what comes
    later, of a further slip or a squeeze, steeper."""
    near = np.abs(t - slip_s) <= NEAR_SLIP_S
    peak = int(np.where(near, np.abs(np.gradient(v_d_mV)), -1.0).argmax())
    low, high = axes.get_ylim()
    room = BRACKETS * (high - low)
    height = high + 0.35 * room
    axes.set_ylim(low, high + room)
    p_a = max(begin_s, float(t[0])), float(t[peak]) - IMPULSE_S
    p_b = float(t[peak]) - IMPULSE_S, float(t[peak]) + IMPULSE_S
    for (begin, end), name in ((p_a, "$P_A$ (slow pattern)"), (p_b, "$P_B$")):
        if begin < end:
            axes.plot(
                [begin, end], [height, height], color=BLACK, linewidth=0.8, marker="|",
                markersize=4, solid_capstyle="butt",
            )  # fmt: skip
            axes.annotate(
                name, ((begin + end) / 2, height), (0, 2), textcoords="offset points",
                ha="center", va="bottom", fontsize=SMALLEST_PT,
            )  # fmt: skip
    for ridge, at_s in _neighbours(instants, p_a):
        value = float(np.interp(at_s, t, v_d_mV))
        # Above the line only where the two lines of the text do not reach the brackets.
        rises = v_d_mV[peak] >= 0 and value + 2.4 * room <= high
        towards = 1.0 if rises else -1.0
        axes.annotate(
            f"ridge {ridge} slips\n(true)", (at_s, value + towards * 0.1 * room),
            (at_s, value + towards * 1.6 * room), ha="center",
            va="center", fontsize=SMALLEST_PT, color=TRUE,
            arrowprops={"arrowstyle": "->", "color": TRUE, "linewidth": 0.7},
        )  # fmt: skip


def _neighbours(instants: SlipInstants, p_a: tuple[float, float]) -> list[tuple[int, float]]:
    """Return the neighbouring ridges that slip as a whole in the phase P_A, and when."""
    if instants.true is None:
        return []
    return [
        (slip.ridge, slip.whole_s)
        for slip in instants.true.ridges
        if slip.ridge != instants.true.watched
        and slip.whole_s is not None
        and p_a[0] <= slip.whole_s <= p_a[1]
    ]


def _ratio(axes: Axes, t: Reals, pressing: Reals, sideways: Reals, wanted: float) -> None:
    pressed = pressing > LEAST_FORCE * wanted
    values = np.where(pressed, sideways / np.where(pressed, pressing, 1.0), np.nan)
    axes.plot(t, values, linewidth=0.7, color=BLACK)
    axes.set_ylabel("$F_t/F_n$")


def _coefficients(axes: Axes, run: RunFile, number: int) -> None:
    for name, colour in (("static_friction", ORANGE), ("kinetic_friction", PURPLE)):
        found = float(run.column(name)[number])
        if np.isfinite(found):
            label = f"{name.replace('_friction', '')} {found:.3f}"
            axes.axhline(found, color=colour, linestyle="--", linewidth=0.8, label=label)
    why = str(run.column("no_friction")[number]) if "no_friction" in run.columns() else ""
    if why:
        # In the line of the panel's letter: a text in the panel would cover the ratio.
        text = f"no friction coefficients: {why.partition(' (')[0]}"
        if len(wrapped(text, SMALLEST_PT, TITLE_PT)) > 1:
            text = "no friction coefficients (`rig show --all` says why)"
        axes.set_title(text, loc="left")
