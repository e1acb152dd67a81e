"""Gain of a PVDF film against frequency, in the manner of the paper's Figure 5."""

from __future__ import annotations

from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np

from rig.figures.circumstances import circumstances, film_of, loads_of
from rig.figures.style import (
    BLACK,
    GREY,
    PALETTE,
    STYLE,
    column_figure,
    decades,
    legend_above,
    letter,
    set_heading,
    set_margins,
    show_at_least,
)
from rig.physics.pvdf import SKIN_STRIP

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from rig.analysis.film.gain_curve import SweepAnalysis
    from rig.analysis.response.curve import ResponseCurve
    from rig.analysis.verdict import Bounds
    from rig.files.runfile.reader import RunFile

PAPER = "paper: Yamada, Maeno et al."
"""Whose equations the figures name."""
REFERENCE_SLOPE_DB_DECADE = 20.0
"""First-order (stress-rate) characteristic of the paper's eq. (2), drawn for comparison."""
REFERENCE_TO_HZ, DRAWN_TO_HZ = 200.0, 1000.0
"""Highest frequency of the points that determine the level of the reference line, and its end:
eq. (2) holds well below the corner, which lowers the gain by 0.1 dB at a seventh of it, and below
the notches."""
LARGEST_MARKER, SMALLEST_MARKER = 4.5, 2.0
"""Sizes of the points of the first and the last load: equal gains do not hide each other."""
LEAST_SPAN_DB, LEAST_SPAN_DEG, LEAST_DEVIATION_PERCENT = 1.0, 2.0, 0.1
"""Smallest spans of the axes, so that noise does not fill the panel of a single point."""


def draw_fitted_gain(run: RunFile) -> dict[str, Figure]:
    """Draw the measured gain with the fitted curve; empty for a sweep that is too short for a
    fit."""
    from rig.figures.gain_curve import draw_gain

    curve, analysis = _analysed(run)
    if curve is None or analysis is None:
        return {}
    return {"": draw_gain(curve, analysis, *_heading(run), PAPER)}


def draw_circuit_readings(run: RunFile) -> dict[str, Figure]:
    """Draw the three predictions of the film's circuit; empty for a sweep that is too short for a
    fit."""
    from rig.figures.gain_curve import draw_readings

    curve, analysis = _analysed(run)
    if curve is None or analysis is None:
        return {}
    return {"": draw_readings(curve, analysis, SKIN_STRIP, *_heading(run), PAPER)}


def draw_load_linearity(run: RunFile) -> dict[str, Figure]:
    """Draw the dependence of the gain on the load; empty for a sweep of one load or too short for a
    fit."""
    from rig.figures.gain_curve import draw_linearity

    _, analysis = _analysed(run) if _several_loads(run) else (None, None)
    if analysis is None or analysis.linearity is None:
        return {}
    return {"": draw_linearity(analysis.linearity, *_heading(run))}


def _several_loads(run: RunFile) -> bool:
    return len(set(run.column("load_set").tolist())) > 1


def _bounds(run: RunFile) -> Bounds:
    """Return the bounds of the verdicts that the run was asked for."""
    from rig.analysis.verdict import Bounds

    usual = Bounds()
    return Bounds(
        float(run.settings.get("slope_bound_dB_decade", usual.slope_dB_decade)),
        float(run.settings.get("gain_bound_dB", usual.gain_dB)),
    )


def _analysed(run: RunFile) -> tuple[ResponseCurve | None, SweepAnalysis | None]:
    """Return the responses and their analysis; (None, None) for a sweep that is too short."""
    from rig.analysis.film.gain_curve import analyse
    from rig.analysis.response.curve import CurveError, points_of

    column = run.column
    several = _several_loads(run)
    try:
        found = analyse(
            *points_of(column),
            degrees=column("degrees"),
            preloads=column("preload"),
            # Files of older versions lack the column and the bounds.
            preload_errors=column("preload_error") if "preload_error" in run.columns() else None,
            bounds=_bounds(run),
            loads=column("load_amplitude") if several else None,
            load_distortion=column("load_distortion") if several else None,
            film_distortion=column("voltage_distortion") if several else None,
        )
    except CurveError:
        return None, None
    return found.curve, found


def draw_measured(run: RunFile) -> Figure:
    """Draw gain, phase and deviation of the load over frequency, with one colour per load; error
    bars are two standard errors."""
    frequency, gains, wanted = run.column("frequency"), run.column("gain"), run.column("load_set")
    deviation = 100 * (run.column("load_amplitude") / wanted - 1)
    loads = np.unique(wanted)
    sizes = np.linspace(LARGEST_MARKER, SMALLEST_MARKER, loads.size) if loads.size > 1 else [2.5]
    with mpl.rc_context(STYLE):
        figure = column_figure(112)
        gain, phase, load = figure.subplots(
            3, 1, sharex=True, gridspec_kw={"height_ratios": [3, 1.4, 1]}
        )
        for number, (level, size) in enumerate(zip(loads, sizes, strict=True)):
            at = wanted == level
            marker = {
                "fmt": ".",
                "markersize": size,
                "elinewidth": 0.5,
                "color": PALETTE[number % len(PALETTE)],
                "label": f"{level:g} N peak load",
            }
            gain.errorbar(frequency[at], gains[at], 2 * run.column("gain_error")[at], **marker)
            phase.errorbar(
                frequency[at], run.column("phase")[at], 2 * run.column("phase_error")[at], **marker
            )
            load.plot(frequency[at], deviation[at], ".", markersize=size, color=marker["color"])
        _reference(gain, frequency, gains)
        gain.set_ylabel("Gain (dB re 1 V/N)")
        legend = legend_above(gain, columns=2)
        phase.set_ylabel("Phase (deg)")
        show_at_least(gain, LEAST_SPAN_DB)
        show_at_least(phase, LEAST_SPAN_DEG)
        _tolerance(load, run, deviation)
        decades(load, frequency.min(), frequency.max())
        letter((gain, phase, load))
        set_margins(figure, top=set_heading(figure, *_heading(run), PAPER) + legend, gap_mm=4.0)
        figure.align_ylabels((gain, phase, load))
    return figure


def _heading(run: RunFile) -> tuple[str, ...]:
    """Return the mark with the film and the load of the sweep, its circumstances, and the file."""
    film = film_of(run)
    # With "at": films may be numbered, and "film 0, 0.5, 2 N" would read as three loads.
    of = f" of {film if 'film' in film else f'film {film}'} at" if film else ", film not named,"
    peak = ", ".join(f"{load:g}" for load in loads_of(run))
    title = run.header.marked(f"sweep{of} {peak} N peak load")
    return title, circumstances(run), run.path.name


def _tolerance(axes: mpl.axes.Axes, run: RunFile, deviation: np.ndarray) -> None:
    """Draw the allowed deviation of the load as a band, with limits of y around all deviations."""
    allowed = float(run.settings.get("load_tolerance_percent", 0.0))
    axes.axhspan(-allowed, allowed, color=GREY, alpha=0.15, linewidth=0)
    axes.set_ylabel("Load error (%)")
    if allowed:
        axes.set_title(f"shaded: ± {allowed:g} % allowed at each point", loc="left")
    largest = max(1.3 * allowed, 1.1 * float(np.abs(deviation).max()), LEAST_DEVIATION_PERCENT)
    axes.set_ylim(-largest, largest)


def _reference(axes: mpl.axes.Axes, frequency: np.ndarray, gain: np.ndarray) -> None:
    """Draw a line of 20 dB/decade through the median of the points up to 200 Hz, unless there is
    only one."""
    inside = frequency <= REFERENCE_TO_HZ
    if not inside.any() or frequency.min() == frequency.max():
        return
    level = np.median(gain[inside] - REFERENCE_SLOPE_DB_DECADE * np.log10(frequency[inside]))
    ends = np.array([frequency.min(), min(frequency.max(), DRAWN_TO_HZ)])
    axes.plot(
        ends,
        level + REFERENCE_SLOPE_DB_DECADE * np.log10(ends),
        "--",
        color=BLACK,
        linewidth=0.8,
        label=f"paper, eq. (2), fitted up to {REFERENCE_TO_HZ:g} Hz",
    )
