"""The analysed sweep in pictures, in the manner of the paper's figures 5 and 7, and its linearity.

The functions draw arrays and an analysis; they open no file, and `rig.figures.style.save` marks
simulated data. Gains in dB re 1 V/N.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from rig.analysis.film.circuit import READING_NAMES, READINGS
from rig.analysis.film.model import FIRST_ORDER_SLOPE, SLOPE_BAND_HZ
from rig.analysis.response.complex_response import DB_PER_RELATIVE
from rig.figures.style import STYLE, decades, set_margins
from rig.physics.pvdf import SKIN_STRIP, CircuitSettings

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rig.analysis.film.gain_curve import ResponseCurve, SweepAnalysis
    from rig.analysis.film.linearity import LoadLinearity
    from rig.analysis.response.complex_response import Reals

ERROR_BARS = 2.0
"""Half length of an error bar in standard errors."""
CURVE_POINTS = 2000
DROP_LABEL_SHARE = 0.18
"""Height of a notch's label with its line, as a fraction of the axes' height."""
_EXPLAINED = {
    "printed": "eq. (4) as printed (adds Ω and S)",
    "ohmic": "eq. (4) with units corrected (1/A4 for A4)",
    "circuit": "circuit analysis of the circuit as drawn",
}
_COLOURS = {"printed": "C3", "ohmic": "C2", "circuit": "C1"}


def draw_gain(curve: ResponseCurve, analysis: SweepAnalysis, title: str = "") -> Figure:
    """Draw Figure 5: measured gain, fitted curve, notches, the line of eq. (2), and residuals
    below."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 6.2))
        gain, residual = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": [3.4, 1]})
        _points(gain, curve.frequencies, curve.gains_dB, curve.gain_errors_dB, "measured")
        f = _fine(curve, analysis)
        model = analysis.fit.model
        gain.plot(f, _dB(model.response(f)), color="C1", linewidth=1, label=_fitted(analysis))
        if analysis.plain is not None:
            _plain_line(gain, curve, analysis.plain.level_dB)
        _mark_drops(gain, analysis)
        gain.set_ylabel("Gain (dB re 1 V/N)")
        gain.legend(loc="upper left", frameon=False)
        _residuals(residual, curve, analysis)
        _frequency_axis(residual, curve.frequencies)
        set_margins(figure, top=0.5)
        if title:
            figure.suptitle(title, fontsize=9, parse_math=False)
    return figure


def draw_readings(
    curve: ResponseCurve,
    analysis: SweepAnalysis,
    given: CircuitSettings = SKIN_STRIP,
    title: str = "",
) -> Figure:
    """Draw Figure 7: three predictions from eq. (4) with the circuit ``given``, absolute and
    shifted."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 6.6))
        plain, shifted = figure.subplots(2, 1, sharex=True)
        f = _fine(curve, analysis)
        for axes in (plain, shifted):
            _points(axes, curve.frequencies, curve.gains_dB, curve.gain_errors_dB, "measured")
            axes.set_ylabel("Gain (dB re 1 V/N)")
        for name, reading in READINGS.items():
            offset = analysis.circuit.offsets[name].value
            computed = _dB(reading(f, given))
            line = {"color": _COLOURS[name], "linewidth": 1}
            plain.plot(f, computed, label=_EXPLAINED[name], **line)
            label = f"{READING_NAMES[name]}, {_signed(-offset, 1)} dB"
            shifted.plot(f, computed - offset, label=label, **line)
        _mark_corners(shifted, analysis)
        plain.set_title("Predictions from eq. (4), absolute", fontsize=9)
        shifted.set_title("Predictions from eq. (4), shifted to match the measurement", fontsize=9)
        plain.legend(loc="lower right", frameon=False, fontsize=8)
        shifted.legend(loc="upper left", frameon=False)
        _frequency_axis(shifted, curve.frequencies)
        set_margins(figure, top=0.68, between=0.14)
        if title:
            figure.suptitle(title, fontsize=9, parse_math=False)
    return figure


def draw_linearity(linearity: LoadLinearity, title: str = "") -> Figure:
    """Draw the change of gain per decade of load at each frequency; it is zero for a linear film
    (data2)."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 3.4), layout="constrained")
        axes = figure.subplots()
        _points(
            axes,
            linearity.frequencies,
            linearity.slopes,
            linearity.slope_errors,
            "each frequency",
        )
        mean = linearity.slope
        axes.axhline(mean.value, color="C1", linewidth=1, label=f"mean: {mean} of load")
        axes.axhspan(mean.low, mean.high, color="C1", alpha=0.25, linewidth=0)
        axes.axhline(0, color="0.3", linestyle="--", linewidth=0.9, label="linear film")
        axes.set_ylabel("Change of gain per decade of load (dB)")
        figure.legend(loc="outside lower center", ncols=2, frameon=False)
        _frequency_axis(axes, linearity.frequencies)
        if title:
            figure.suptitle(title, fontsize=9, parse_math=False)
    return figure


def _points(axes: Axes, frequencies: Reals, values: Reals, errors: Reals, what: str) -> None:
    """Draw one point per frequency with its error bars."""
    axes.errorbar(
        frequencies,
        values,
        ERROR_BARS * errors,
        fmt=".",
        markersize=3,
        elinewidth=0.6,
        color="C0",
        label=f"{what}, ± {ERROR_BARS:g} standard errors",
        zorder=3,
    )


def _fitted(analysis: SweepAnalysis) -> str:
    b, corner = analysis.level, analysis.corner.value
    pole = f"corner {corner:.0f} Hz" if np.isfinite(corner) else "no corner"
    drops = f"{len(analysis.drops)} notch{'es' * (len(analysis.drops) != 1)}"
    if analysis.slopes is None:
        return f"fit: b = {_signed(b.value, 2)} dB, {pole}, {drops}"
    low, high = analysis.slopes.band_Hz
    slope = f"slope {low:g} to {high:g} Hz {analysis.slopes.slope.value:.2f} dB/decade"
    return f"fit: b = {_signed(b.value, 2)} dB, {pole}, {drops},\n{slope}"


def _plain_line(axes: Axes, curve: ResponseCurve, level_dB: float) -> None:
    ends = np.array([curve.frequencies[0], min(SLOPE_BAND_HZ[1], curve.frequencies[-1])])
    axes.plot(
        ends,
        FIRST_ORDER_SLOPE * np.log10(ends) + level_dB,
        "--",
        color="0.3",
        linewidth=0.9,
        label=f"20 dB/decade line fitted without corner\n(paper, eq. 2): {_signed(level_dB, 2)} dB",
        zorder=4,
    )


def _mark_drops(axes: Axes, analysis: SweepAnalysis) -> None:
    """Write frequency and depth under each notch, with room for them above the axis."""
    if not analysis.drops:
        return
    lowest = float(_dB(analysis.fit.model.response(_bottoms(analysis))).min())
    low, high = axes.get_ylim()
    axes.set_ylim(min(low, (lowest - DROP_LABEL_SHARE * high) / (1 - DROP_LABEL_SHARE)), high)
    for drop in analysis.drops:
        at = drop.frequency.value
        bottom = float(_dB(analysis.fit.model.response(np.array([at])))[0])
        axes.annotate(
            f"{_hertz(at)}\n{drop.depth.value:.1f} dB",
            (at, bottom),
            (0, -24),
            textcoords="offset points",
            ha="center",
            va="top",
            fontsize=8,
            arrowprops={"arrowstyle": "-", "linewidth": 0.5, "color": "0.4"},
        )


def _residuals(axes: Axes, curve: ResponseCurve, analysis: SweepAnalysis) -> None:
    expected = analysis.fit.model.response(curve.frequencies)
    error = DB_PER_RELATIVE * np.sqrt(
        np.square(curve.gain_errors_dB / DB_PER_RELATIVE) + analysis.fit.gain_error**2
    )
    axes.plot(curve.frequencies, (curve.gains_dB - _dB(expected)) / error, ".", markersize=3)
    axes.axhspan(-2, 2, color="0.5", alpha=0.12, linewidth=0)
    largest = np.abs((curve.gains_dB - _dB(expected)) / error).max()
    axes.set_ylim(-max(4.0, 1.1 * largest), max(4.0, 1.1 * largest))
    axes.set_ylabel("Residual\n(standard errors)")


def _mark_corners(axes: Axes, analysis: SweepAnalysis) -> None:
    """Mark the measured corner and the one that R_PV C_PV predicts."""
    bottom, top = axes.get_ylim()
    for value, name, place in (
        (analysis.corner.value, "corner, measured:", "right"),
        (analysis.circuit.film_corner_Hz, "corner of\n$R_{PV}C_{PV}$:", "left"),
    ):
        if not np.isfinite(value):
            continue
        axes.axvline(value, color="0.3", linestyle=":", linewidth=0.9)
        axes.annotate(
            f"{name}\n{_hertz(value)}",
            (value, bottom),
            (-3 if place == "right" else 3, 3),
            textcoords="offset points",
            ha=place,
            va="bottom",
            fontsize=8,
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
