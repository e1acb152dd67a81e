"""The figures of a grip that answers alarms: what was seen, when it squeezed, and how far it slid.

P_A is the low-frequency pattern of v_d that precedes a slip (motion under load begun), and P_B the
impulse of the slip itself (paper 4.1), here as the detector of the trial has found them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from rig.figures.pressed import TRIALS_SHOWN, heading, seconds, squeezes_of
from rig.figures.style import (
    BLUE,
    COLUMN_MM,
    GREEN,
    GREY,
    MM_PER_INCH,
    PURPLE,
    STYLE,
    VERMILLION,
    column_figure,
    legend_above,
    letter,
    save,
    set_heading,
    set_margins,
)
from rig.files.journal.detections import SLIP, from_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rig.files.runfile.reader import RunFile

BEFORE_S, AFTER_S = 0.1, 0.1
"""Time shown before the motion and after it."""
HEIGHTS = (1.6, 1.4, 1.4, 1.2)
HEIGHT_MM = 130.0


def draw_trials(run: RunFile) -> dict[str, Figure]:
    """Draw one figure per trial of a run whose grip could squeeze, or that held a weight."""
    points = run.point_ids()[:TRIALS_SHOWN] if has_grip(run) else []
    return {
        "" if number == 0 else f"-{point}": draw_trial(run, number, point)
        for number, point in enumerate(points)
    }


def has_grip(run: RunFile) -> bool:
    """Return whether a run is of slip trials with a grip or a weight."""
    if run.header.procedure != "slip-trial":
        return False
    return bool(run.settings.get("regrip")) or run.settings.get("hold_at_N") is not None


def draw_trial(run: RunFile, number: int, point: str) -> Figure:
    """Draw v_d with P_A and P_B, F_n with its set point and the squeezes, F_t, and the way slid."""
    with mpl.rc_context(STYLE):
        figure = column_figure(HEIGHT_MM)
        panels = figure.subplots(4, 1, sharex=True, gridspec_kw={"height_ratios": HEIGHTS})
        _draw_column(panels, run, number, point)
        for axes in panels:
            legend_above(axes)
        letter(panels)
        set_margins(figure, top=heading(figure, run, number, point) + 0.14, gap_mm=4.0)
        figure.align_ylabels(panels)
    return figure


def draw_beside(without: RunFile, with_: RunFile) -> Figure:
    """Draw the first trials of two runs beside each other, on the same axes."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(2 * COLUMN_MM / MM_PER_INCH, HEIGHT_MM / MM_PER_INCH))
        panels = figure.subplots(
            4, 2, sharex="col", sharey="row", gridspec_kw={"height_ratios": HEIGHTS}
        )
        for column, run in enumerate((without, with_)):
            _draw_column(panels[:, column], run, 0, run.point_ids()[0])
            kind = "with re-grip" if run.settings.get("regrip") else "without"
            panels[3, column].set_xlabel(f"Time since the motion began (s): {kind}")
        for row in panels:
            row[1].set_ylabel("")
            for axes in row:
                legend_above(axes)
        title = without.header.marked("A weight without and with re-grip")
        names = (f"left: {without.path.name}", f"right: {with_.path.name}")
        set_margins(figure, top=set_heading(figure, title, *names) + 0.14, gap_mm=4.0)
    return figure


def draw_pair(files: Sequence[Path], folder: Path | None, pdf: bool) -> list[Path]:
    """Draw two run files beside each other, that without re-grip first; return the pictures: none
    unless both have a grip or a weight and one trial at least."""
    from rig.files.runfile.reader import RunFile

    with RunFile.open(files[0]) as first, RunFile.open(files[1]) as second:
        runs = sorted((first, second), key=lambda run: bool(run.settings.get("regrip")))
        if not all(has_grip(run) and run.point_ids() for run in runs):
            return []
        place = files[0] if folder is None else folder / files[0].name
        simulated = any(bool(run.outcome.simulated) for run in runs)
        place.parent.mkdir(parents=True, exist_ok=True)
        return save(draw_beside(*runs), place.with_stem(place.stem + "-beside"), simulated, pdf)


def _draw_column(panels: Sequence[Axes], run: RunFile, number: int, point: str) -> None:
    """Draw one trial, in s since its motion began."""
    series = {w.stream: w for w in run.waveforms(point)}
    reading = run.readings()[number]
    begin_s, end_s = float(reading["slide_from_s"]), float(reading["slide_to_s"])
    difference, pressing, dragging, way = panels
    t = seconds(series["signals"]) - begin_s
    v_d = 1e3 * series["signals"].values("v_d")
    difference.plot(t, v_d, linewidth=0.7, color=BLUE, label="$v_d$")
    difference.set_ylabel("$v_d$ (mV)")
    detections = from_text(str(reading.get("detections") or ""))
    begin = int(np.searchsorted(t, 0.0))
    for kind, label, marker in (
        ("predictive", "$P_A$, motion begun", "^"), (SLIP, "$P_B$, alarm", "v"),
    ):  # fmt: skip
        at = [one.sample for one in detections if one.kind == kind and one.sample < len(v_d)]
        before, at = [n for n in at if n < begin], [n for n in at if n >= begin]
        # One that the detector has found in the press is in force as the motion begins, unless
        # it finds a further one.
        if kind == "predictive" and before and not at and begin < len(v_d):
            at = [begin]
        if at:
            difference.plot(t[at], v_d[at], marker, color=VERMILLION, markersize=4, label=label)
    force = series["force"]
    t = seconds(force) - begin_s
    squeezes = squeezes_of(run, number)
    pressing.plot(t, force.values("F_n"), color=BLUE, label="$F_n$")
    set_N = float(reading["set_normal_force_N"])
    steps_s = [-BEFORE_S, *(one["decided_s"] - begin_s for one in squeezes), end_s - begin_s]
    levels_N = [set_N, *(one["to_N"] for one in squeezes)]
    pressing.step(
        steps_s, [*levels_N, levels_N[-1]], where="post", color=GREY, linewidth=0.7,
        linestyle="--", label="set point",
    )  # fmt: skip
    pressing.set_ylabel("$F_n$ (N)")
    dragging.plot(t, force.values("F_t"), color=VERMILLION, label="$F_t$")
    if (load_N := reading.get("load_N")) is not None and np.isfinite(float(load_N)):
        sign = np.sign(force.values("F_t")[np.argmax(np.abs(force.values("F_t")))])
        dragging.axhline(sign * float(load_N), color=GREY, linewidth=0.7, label="weight")
    dragging.set_ylabel("$F_t$ (N)")
    ticks = series["ticks"].values("elapsed") - begin_s
    x_mm = series["position"].values("x")
    at_rest = float(np.interp(0.0, ticks, x_mm))
    way.plot(ticks, np.abs(x_mm - at_rest), color=GREEN, label="travel of x")
    if outcome := str(reading.get("outcome") or ""):
        way.plot([], [], " ", label=f"outcome: {outcome}")
    way.set_ylabel("Travel (mm)")
    way.set_xlabel("Time since the motion began (s)")
    for axes in panels:
        for n, one in enumerate(squeezes):
            named = "squeeze" if n == 0 and axes is pressing else None
            axes.axvline(one["decided_s"] - begin_s, color=PURPLE, linewidth=0.7, label=named)
    shown = (t >= -BEFORE_S) & (t <= end_s - begin_s + AFTER_S)
    way.set_xlim(-BEFORE_S, end_s - begin_s + AFTER_S)
    force_N = force.values("F_n")[shown]
    if force_N.size:
        room_N = 0.15 * max(float(np.ptp(force_N)), 0.1 * set_N)
        pressing.set_ylim(float(force_N.min()) - room_N, float(force_N.max()) + room_N)
