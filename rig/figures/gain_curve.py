"""The analysed sweep in pictures, in the manner of the paper's figures 5 and 7, and its linearity.

The functions draw arrays and an analysis; they open no file, and `rig.figures.style.save` marks
simulated data. Gains in dB re 1 V/N.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np
from matplotlib.transforms import offset_copy

from rig.analysis.film.circuit import READING_NAMES, READINGS
from rig.analysis.film.model import FIRST_ORDER_SLOPE
from rig.analysis.response.complex_response import DB_PER_RELATIVE
from rig.figures.style import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    SMALLEST_PT,
    STYLE,
    VERMILLION,
    column_figure,
    decades,
    legend_above,
    letter,
    set_heading,
    set_margins,
)
from rig.physics.pvdf import SKIN_STRIP, CircuitSettings

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from rig.analysis.film.gain_curve import ResponseCurve, SweepAnalysis
    from rig.analysis.film.linearity import LoadLinearity
    from rig.analysis.response.complex_response import Reals

ERROR_BARS = 2.0
"""Half length of an error bar in standard errors."""
LEAST_RESIDUAL_SPAN = 4.0
"""Residual up to which their axis extends in any case, in standard errors."""
CURVE_POINTS = 2000
LEGEND_SHARE = 0.2
"""Room for a legend below the curves, as a share of their span."""
DROP_LABEL_SHARE = 0.28
"""Height of a notch's lowered label with its line, as a fraction of the axes' height."""
LABEL_PT, LOWERED_PT = 10.0, 30.0
"""Distances of labels from the bottoms of notches; the lower one clears a label of two lines."""
CORNER_LABEL_SHARE = 0.15
"""Width of the label of a corner, as a share of the axis of frequency."""
LABEL_RATIO = 6.0
"""Ratio of the frequencies of two notches below which their labels would touch."""
_EXPLAINED = {
    "printed": "eq. (4) as printed (adds Ω and S)",
    "ohmic": "eq. (4) with units corrected (1/A4 for A4)",
    "circuit": "analysis of the circuit as drawn",
}
_LINES = {"printed": (VERMILLION, "-"), "ohmic": (GREEN, "--"), "circuit": (ORANGE, "-.")}
"""Colours and dashes of the three readings of eq. (4)."""


def draw_gain(
    curve: ResponseCurve, analysis: SweepAnalysis, title: str = "", *details: str
) -> Figure:
    """Draw Figure 5: measured gain, fitted curve, notches, the line of eq. (2), and residuals
    below."""
    with mpl.rc_context(STYLE):
        figure = column_figure(104)
        gain, residual = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [3.4, 1]})
        _points(gain, curve.frequencies, curve.gains_dB, curve.gain_errors_dB, "measured")
        f = _fine(curve, analysis)
        model = analysis.fit.model
        gain.plot(f, _dB(model.response(f)), color=VERMILLION, label=_fitted(analysis))
        _first_order_line(gain, curve, analysis)
        _mark_drops(gain, analysis)
        gain.set_ylabel("Gain (dB re 1 V/N)")
        legend = legend_above(gain, columns=1)
        _residuals(residual, curve, analysis)
        _frequency_axis(residual, curve.frequencies)
        letter((gain, residual))
        top = set_heading(figure, title, *details)
        set_margins(figure, top=top + legend, gap_mm=4.0)
        figure.align_ylabels((gain, residual))
    return figure


def draw_readings(
    curve: ResponseCurve,
    analysis: SweepAnalysis,
    given: CircuitSettings = SKIN_STRIP,
    title: str = "",
    *details: str,
) -> Figure:
    """Draw Figure 7: three predictions from eq. (4) with the circuit ``given``, absolute and
    shifted."""
    with mpl.rc_context(STYLE):
        figure = column_figure(140)
        plain, shifted = figure.subplots(2, 1, sharex=True)
        f = _fine(curve, analysis)
        for axes in (plain, shifted):
            _points(axes, curve.frequencies, curve.gains_dB, curve.gain_errors_dB, "measured")
            axes.set_ylabel("Gain (dB re 1 V/N)")
        for name, reading in READINGS.items():
            offset = analysis.circuit.offsets[name].value
            computed = _dB(reading(f, given))
            colour, dashes = _LINES[name]
            plain.plot(f, computed, dashes, color=colour, label=_EXPLAINED[name])
            label = f"{READING_NAMES[name]}, {_signed(-offset, 1)} dB"
            shifted.plot(f, computed - offset, dashes, color=colour, label=label)
        _mark_corners(shifted, curve.frequencies, analysis)
        plain.set_title("predictions from the paper's eq. (4), absolute", loc="left")
        shifted.set_title("the same, shifted to match the measurement", loc="left")
        # Below the lowest curve there is nothing, above the shifted ones to the left neither.
        low, high = plain.get_ylim()
        plain.set_ylim(low - LEGEND_SHARE * (high - low), high)
        plain.legend(loc="lower right")
        shifted.legend(loc="upper left")
        _frequency_axis(shifted, curve.frequencies)
        letter((plain, shifted))
        top = set_heading(figure, title, *details)
        set_margins(figure, top=top + 0.14, gap_mm=5.0)
    return figure


def draw_linearity(linearity: LoadLinearity, title: str = "", *details: str) -> Figure:
    """Draw the change of gain per decade of load at each frequency; it is zero for a linear film
    (data2)."""
    with mpl.rc_context(STYLE):
        figure = column_figure(76)
        axes = figure.subplots()
        _points(
            axes,
            linearity.frequencies,
            linearity.slopes,
            linearity.slope_errors,
            "each frequency",
        )
        mean = linearity.slope
        axes.axhline(mean.value, color=VERMILLION, label=f"mean: {mean} of load")
        axes.axhspan(mean.low, mean.high, color=VERMILLION, alpha=0.25, linewidth=0)
        axes.axhline(0, color=GREY, linestyle="--", linewidth=0.9, label="linear film")
        axes.set_ylabel("Change of gain (dB/decade of load)")
        legend = legend_above(axes, columns=1)
        _frequency_axis(axes, linearity.frequencies)
        top = set_heading(figure, title, *details)
        set_margins(figure, top=top + legend, left=0.6)
    return figure


def _points(axes: Axes, frequencies: Reals, values: Reals, errors: Reals, what: str) -> None:
    """Draw one point per frequency with its error bars."""
    axes.errorbar(
        frequencies,
        values,
        ERROR_BARS * errors,
        fmt=".",
        markersize=2.5,
        elinewidth=0.5,
        color=BLUE,
        label=f"{what}, ± {ERROR_BARS:g} standard errors",
        zorder=3,
    )


def _fitted(analysis: SweepAnalysis) -> str:
    b, corner = analysis.level, analysis.corner.value
    pole = f"corner {corner:.0f} Hz" if np.isfinite(corner) else "no corner"
    drops = f"{len(analysis.drops)} notch{'es' * (len(analysis.drops) != 1)}"
    found = f"fit: b = {_signed(b.value, 2)} dB, {pole}, {drops}"
    if analysis.slopes is None:
        return found
    low, high = analysis.slopes.band_Hz
    slope = f"{analysis.slopes.slope.value:.2f} dB/decade"
    return f"{found},\nslope {low:g} to {high:g} Hz: {slope}"


def _first_order_line(axes: Axes, curve: ResponseCurve, analysis: SweepAnalysis) -> None:
    """Draw eq. (2) with the fitted level b, up to the corner: it holds below that. A line through
    all points up to 2 kHz would lie above them, because the corner bends them down."""
    level_dB, corner_Hz = analysis.level.value, analysis.corner.value
    # NaN where no corner was found: fmin leaves it out.
    ends = np.array([curve.frequencies[0], np.fmin(corner_Hz, curve.frequencies[-1])])
    axes.plot(
        ends,
        FIRST_ORDER_SLOPE * np.log10(ends) + level_dB,
        "--",
        color=BLACK,
        linewidth=0.8,
        label=f"paper, eq. (2): 20 dB/decade, b = {_signed(level_dB, 2)} dB",
        zorder=4,
    )


def _mark_drops(axes: Axes, analysis: SweepAnalysis) -> None:
    """Write frequency and depth under each notch, with room for them above the axis; lower where
    they would touch those of the notch before."""
    if not analysis.drops:
        return
    lowest = float(_dB(analysis.fit.model.response(_bottoms(analysis))).min())
    low, high = axes.get_ylim()
    share = DROP_LABEL_SHARE
    axes.set_ylim(min(low, (lowest - share * high) / (1 - share)), high)
    before_Hz, before_dB, lowered = 0.0, 0.0, False
    for drop in sorted(analysis.drops, key=lambda drop: drop.frequency.value):
        at = drop.frequency.value
        bottom = float(_dB(analysis.fit.model.response(np.array([at])))[0])
        lowered = at < LABEL_RATIO * before_Hz and not lowered
        below = offset_copy(
            axes.transData,
            axes.get_figure(root=True),
            y=-LOWERED_PT if lowered else -LABEL_PT,
            units="points",
        )
        axes.annotate(
            f"{_hertz(at)}\n{drop.depth.value:.1f} dB",
            (at, bottom),
            (at, min(bottom, before_dB) if lowered else bottom),
            textcoords=below,
            ha="center",
            va="top",
            fontsize=SMALLEST_PT,
            arrowprops={"arrowstyle": "-", "linewidth": 0.5, "color": GREY},
        )
        before_Hz, before_dB = at, bottom


def _residuals(axes: Axes, curve: ResponseCurve, analysis: SweepAnalysis) -> None:
    """Draw the residuals of the gain in the standard errors of the points alone, as the fit judges
    them: without the effects of preload and load, which it leaves free. The model error, with which
    every fit would look good, is named instead."""
    fit = analysis.fit
    freed = curve.freed(curve.log_ratio(fit.model.response(curve.frequencies)))
    residuals = DB_PER_RELATIVE * freed.real / curve.gain_errors_dB
    axes.plot(curve.frequencies, residuals, ".", markersize=2.5)
    axes.axhspan(-ERROR_BARS, ERROR_BARS, color=GREY, alpha=0.15, linewidth=0)
    span = max(LEAST_RESIDUAL_SPAN, 1.1 * float(np.abs(residuals).max()))
    axes.set_ylim(-span, span)
    axes.set_ylabel("Residual (s.e.)")
    model = f"; model error {fit.gain_error_dB:.2g} dB" if fit.gain_error else ""
    axes.set_title(f"shaded: ± {ERROR_BARS:g} standard errors of a point{model}", loc="left")


def _mark_corners(axes: Axes, frequencies: Reals, analysis: SweepAnalysis) -> None:
    """Mark the measured corner and the one that R_PV C_PV predicts."""
    bottom, top = axes.get_ylim()
    first_Hz, last_Hz = float(frequencies[0]), float(frequencies[-1])
    # A label on the right of a line near the right end would run over the frame.
    end_Hz = last_Hz * (first_Hz / last_Hz) ** CORNER_LABEL_SHARE
    film_Hz = analysis.circuit.film_corner_Hz
    for value, name, place in (
        (analysis.corner.value, "corner, measured:", "right"),
        (film_Hz, "$R_{PV}C_{PV}$:", "right" if film_Hz > end_Hz else "left"),
    ):
        if not np.isfinite(value):
            continue
        axes.axvline(value, color=GREY, linestyle=":", linewidth=0.9)
        axes.annotate(
            f"{name}\n{_hertz(value)}",
            (value, bottom),
            (-3 if place == "right" else 3, 3),
            textcoords="offset points",
            ha=place,
            va="bottom",
            fontsize=SMALLEST_PT,
        )
    axes.set_ylim(bottom, top)


def _frequency_axis(axes: Axes, frequencies: Reals) -> None:
    decades(axes, frequencies[0], frequencies[-1])


def _fine(curve: ResponseCurve, analysis: SweepAnalysis) -> Reals:
    """Return the frequencies of a smooth line, including the bottoms of the notches."""
    grid = np.geomspace(curve.frequencies[0], curve.frequencies[-1], CURVE_POINTS)
    return np.unique(np.concatenate([grid, _bottoms(analysis)]))


def _bottoms(analysis: SweepAnalysis) -> Reals:
    """Return the frequencies of the notches' bottoms, (notches,)."""
    return np.array([drop.frequency.value for drop in analysis.drops])


def _hertz(frequency: float) -> str:
    """Return a frequency with four figures and without an exponent."""
    digits = max(0, 3 - int(np.floor(np.log10(frequency))))
    return f"{frequency:.{digits}f} Hz"


def _signed(number: float, digits: int) -> str:
    """Return a number with its sign and a true minus."""
    return f"{number:+.{digits}f}".replace("-", "−")


def _dB(response: np.ndarray) -> Reals:  # noqa: N802
    gains: Reals = 20 * np.log10(np.abs(response))
    return gains
