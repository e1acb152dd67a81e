"""The figures of a score: ROC, detection rate by noise, friction ratio and speed, and delays."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rig.evaluation.scoring.outcomes import EARLY_WITHIN_S, FOUND_WITHIN_S, SLIPS
from rig.evaluation.scoring.results import ContenderResult
from rig.evaluation.scoring.roc import AXES, ROLL_ALARMS
from rig.figures.style import (
    GREY,
    PALETTE,
    SMALLEST_PT,
    STYLE,
    TEXT_PT,
    column_figure,
    wrapped,
)

COLOURS = (*PALETTE, GREY)
MARKERS = ("o", "s", "^")
"""Of contenders beyond the colours, which come a second and a third time."""
SHOWN_TRAITS = {
    "noise_mV": "Noise, rms (mV)",
    "friction_ratio": "Friction ratio, $μ_k / μ_s$",
    "speed_mm_s": "Speed (mm/s)",
}
MOST_SHOWN_ALARMS, FEWEST_SHOWN_ALARMS = 0.5, 0.05
"""Bounds of the end of the ROC's axis of false alarms, which fits the curves' own thresholds; a
detector with more than the first is useless."""
TITLE_PT = 225.0
"""Width of a title."""
DELAYS_MS = (-1e3 * EARLY_WITHIN_S, 1e3 * FOUND_WITHIN_S)
"""Range of the histograms: the time in which a slip is found."""
BAR_MS = 2.0
ROOM_ABOVE_BARS = 1.5
"""Height of a histogram's axis relative to its highest bar, with room for what is written in it."""
SHARES = (-0.04, 1.04)
"""Range of an axis of shares, with room for the whole marker at 0 and at 1."""


def draw_roc(results: Sequence[ContenderResult], title: str) -> Figure:
    """Draw detected slips over false alarms at thresholds from 1/8 to 8 times a contender's own."""
    with mpl.rc_context(STYLE):
        figure = _column(14 + 58 * len(AXES), f"Slips found over false alarms, {title}")
        panels = list(np.atleast_1d(figure.subplots(len(AXES), 1, sharey=True)))
        for axes, (name, among) in zip(panels, AXES.items(), strict=True):
            ends = [FEWEST_SHOWN_ALARMS]
            for one, colour, marker in _looks(results):
                if name not in one.rocs:
                    continue
                curve = one.rocs[name]
                order = np.lexsort((curve.found, curve.alarms))
                axes.plot(
                    curve.alarms[order], curve.found[order], f"{marker}-", ms=1.5, lw=1.0,
                    color=colour, label=one.contender.name,
                )  # fmt: skip
                own = int(np.abs(curve.threshold - 1).argmin())
                axes.plot(
                    curve.alarms[own], curve.found[own], marker, ms=6, mfc="none", color=colour
                )
                ends.append(1.5 * float(curve.alarms[own]))
            end = min(MOST_SHOWN_ALARMS, max(ends))
            axes.set_xlim(-0.02 * end, end)
            axes.set_ylim(*SHARES)
            axes.set_xlabel(f"False alarms, share of trials: {', '.join(among)}")
        panels[0].axvline(ROLL_ALARMS, color=GREY, lw=0.8, ls="--")
        panels[0].annotate(f" {100 * ROLL_ALARMS:g} %", (ROLL_ALARMS, 0.01), color=GREY)
        for axes in panels:
            axes.set_ylabel("Share of slips found")
        figure.legend(
            *panels[-1].get_legend_handles_labels(), loc="outside lower center", ncols=2,
            title="large marker: own threshold",
        )  # fmt: skip
    return figure


def draw_found(results: Sequence[ContenderResult], title: str) -> Figure:
    """Draw the detection rate by noise, friction ratio and speed, with 95 % intervals."""
    with mpl.rc_context(STYLE):
        figure = _column(
            20 + 44 * len(SHOWN_TRAITS),
            f"Detection rate by noise, friction ratio and speed, 95 % intervals, {title}",
        )
        panels = figure.subplots(len(SHOWN_TRAITS), 1, sharey=True)
        for axes, (trait, name) in zip(panels, SHOWN_TRAITS.items(), strict=True):
            bins: list[str] = []
            for at, (one, colour, marker) in enumerate(_looks(results)):
                groups = [g for g in one.groups if g.trait == trait and "found" in g.score]
                bins = [group.bin for group in groups]
                shift = 0.6 * ((at + 0.5) / len(results) - 0.5)
                found = [group.score["found"] for group in groups]
                value = np.array([each.value for each in found])
                axes.errorbar(
                    np.arange(len(groups)) + shift, value,
                    [value - [each.low for each in found], [each.high for each in found] - value],
                    fmt=marker, ms=4, lw=1.0, color=colour, label=one.contender.name,
                )  # fmt: skip
            axes.set_xticks(range(len(bins)), [each.replace(" and ", "\nand ") for each in bins])
            axes.set_xlabel(name)
            axes.grid(axis="x", visible=False)
            axes.set_ylabel("Share of slips found")
        panels[0].set_ylim(*SHARES)
        handles, labels = panels[0].get_legend_handles_labels()
        if handles:
            figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


def draw_delays(results: Sequence[ContenderResult], title: str) -> Figure:
    """Draw the delay of each detection after the full-ridge slip, in one panel per contender."""
    with mpl.rc_context(STYLE):
        figure = _column(22 + 18 * len(results), f"Delay of the alarms that found a slip, {title}")
        panels = figure.subplots(len(results), 1, sharex=True, squeeze=False)[:, 0]
        edges = np.arange(DELAYS_MS[0], DELAYS_MS[1] + BAR_MS, BAR_MS)
        for axes, (one, colour, _) in zip(panels, _looks(results), strict=True):
            slips = [each for each in one.outcomes if each.label in SLIPS]
            delays = np.array([1e3 * each.after_ridge_s for each in slips if each.found])
            counts, _, _ = axes.hist(np.clip(delays, *DELAYS_MS), edges, color=colour)
            axes.set_ylim(0, ROOM_ABOVE_BARS * max(1.0, float(np.max(counts))))
            axes.axvline(0, color="0.3", lw=0.8)
            axes.annotate(
                f"{one.contender.name}: {delays.size} of {len(slips)} found", (0.99, 0.8),
                xycoords="axes fraction", ha="right", fontsize=SMALLEST_PT,
                bbox={"facecolor": "white", "alpha": 0.7, "edgecolor": "none"},
            )  # fmt: skip
            _whole_numbers(axes)
        figure.supylabel("Slips", fontsize=TEXT_PT)
        panels[-1].set_xlim(*DELAYS_MS)
        panels[-1].set_xlabel("Detection delay after full-ridge slip (ms)")
    return figure


def _column(height_mm: float, title: str) -> Figure:
    """Return a figure of one column with a title, whose axes are placed by their contents."""
    figure = column_figure(height_mm)
    figure.set_layout_engine("constrained", w_pad=0.03, h_pad=0.03)
    figure.suptitle("\n".join(wrapped(title, TEXT_PT, TITLE_PT)))
    return figure


def _looks(results: Sequence[ContenderResult]) -> list[tuple[ContenderResult, str, str]]:
    """Return each contender with its colour and its marker: no two look alike."""
    looks = [(colour, marker) for marker in MARKERS for colour in COLOURS]
    return [(one, *looks[at % len(looks)]) for at, one in enumerate(results)]


def _whole_numbers(axes: Axes) -> None:
    from matplotlib.ticker import MaxNLocator

    axes.yaxis.set_major_locator(MaxNLocator(3, integer=True))
