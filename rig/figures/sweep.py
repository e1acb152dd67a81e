"""Gain of a PVDF film against frequency, in the manner of the paper's Figure 5."""

from __future__ import annotations

from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from rig.figures.style import STYLE, decades, set_margins
from rig.model.pvdf import SKIN_STRIP

if TYPE_CHECKING:
    from rig.analysis.gain_curve import SweepAnalysis
    from rig.analysis.response_curve import ResponseCurve
    from rig.recording.runfile import RunFile

REFERENCE_SLOPE_DB_DECADE = 20.0
"""First-order (stress-rate) characteristic of the paper's eq. (2), drawn for comparison."""


def draw_data(run: RunFile) -> dict[str, Figure]:
    """What was measured."""
    return {"": draw_measured(run)}


def draw_model(run: RunFile) -> dict[str, Figure]:
    """The fitted curve, the three readings of the circuit and the linearity over load, where the
    sweep is long enough to tell them."""
    curve, analysis = _analysed(run)
    if curve is None or analysis is None:
        return {}
    from rig.figures.gain_curve import draw_gain, draw_linearity, draw_readings

    title = run.header.title
    figures = {
        "-gain": draw_gain(curve, analysis, title),
        "-readings": draw_readings(curve, analysis, SKIN_STRIP, title),
    }
    if analysis.linearity is not None:
        figures["-linearity"] = draw_linearity(analysis.linearity, title)
    return figures


def _analysed(run: RunFile) -> tuple[ResponseCurve | None, SweepAnalysis | None]:
    """The responses and what the analysis makes of them; nothing for a sweep too short for it."""
    from rig.analysis.gain_curve import analyse
    from rig.analysis.response_curve import CurveError, points_of

    column = run.column
    several = len(set(column("load_set").tolist())) > 1
    try:
        found = analyse(
            *points_of(column),
            degrees=column("degrees"),
            preloads=column("preload"),
            loads=column("load_amplitude") if several else None,
            load_distortion=column("load_distortion") if several else None,
            film_distortion=column("voltage_distortion") if several else None,
        )
    except CurveError:
        return None, None
    return found.curve, found


def draw_measured(run: RunFile) -> Figure:
    """Gain, phase and load over frequency; error bars are two standard errors."""
    frequency = run.column("frequency")
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 6.4))
        gain, phase, load = figure.subplots(
            3, 1, sharex=True, gridspec_kw={"height_ratios": [3, 1.4, 1]}
        )
        marker = {"fmt": ".", "markersize": 3, "elinewidth": 0.6, "color": "C0"}
        gain.errorbar(frequency, run.column("gain"), 2 * run.column("gain_error"), **marker)
        _reference(gain, frequency, run.column("gain"))
        gain.set_ylabel("Gain (dB re 1 V/N)")
        gain.legend(loc="lower right", frameon=False)
        phase.errorbar(frequency, run.column("phase"), 2 * run.column("phase_error"), **marker)
        phase.set_ylabel("Phase (°)")
        load.plot(frequency, run.column("load_amplitude"), ".", markersize=3, color="C1")
        load.set_ylabel("Load, peak (N)")
        load.set_ylim(bottom=0)
        decades(load)
        set_margins(figure, top=0.5)
        figure.suptitle(f"{run.header.title}\n{run.path.name}", fontsize=9)
    return figure


def _reference(axes: mpl.axes.Axes, frequency: np.ndarray, gain: np.ndarray) -> None:
    """A line of 20 dB/decade through the median of the points from 2 to 1000 Hz."""
    inside = frequency <= 1000
    if not inside.any():
        return
    level = np.median(gain[inside] - REFERENCE_SLOPE_DB_DECADE * np.log10(frequency[inside]))
    ends = np.array([frequency.min(), frequency.max()])
    axes.plot(
        ends,
        level + REFERENCE_SLOPE_DB_DECADE * np.log10(ends),
        "--",
        color="0.4",
        linewidth=0.8,
        label="20 dB/decade",
    )
