"""The figure of a series of pressed trials: what each trial gave, and how it scatters."""

from __future__ import annotations

from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np
from matplotlib.ticker import MaxNLocator

from rig.analysis.estimate import with_error
from rig.figures.circumstances import circumstances
from rig.figures.style import (
    PALETTE,
    STYLE,
    column_figure,
    legend_above,
    letter,
    set_heading,
    set_margins,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from rig.files.runfile.reader import RunFile

    Reals = NDArray[np.float64]

PANELS: tuple[tuple[str, tuple[tuple[str, str], ...]], ...] = (
    ("Friction", (("static_friction", "static"), ("kinetic_friction", "kinetic"))),
    ("Touch gain (mV s/N)", (("touch_gain_1", "strip 1"), ("touch_gain_2", "strip 2"))),
    ("$F_n$ error (%)", (("force_error_rms", "rms"), ("force_error_peak", "peak"))),
)
"""Label of each panel, and the columns that it shows with their names."""
IN_MILLI = "touch_gain"
"""Columns whose values are shown in thousandths of their unit."""
FEWEST = 2
"""Trials of which there is a figure."""


def draw_series(run: RunFile) -> dict[str, Figure]:
    """Draw friction, touch gains and force errors over the trials of a series with their
    distribution beside; invalid trials are open circles. A quantity that no trial has is left out.
    Returns an empty dict for fewer than `FEWEST` trials, or if nothing is left."""
    invalid = np.array([bool(why) for why in run.column("invalid")])
    if len(invalid) < FEWEST:
        return {}
    shown = [(label, columns) for label, columns in PANELS if _has_values(run, columns)]
    if not shown:
        return {}
    with mpl.rc_context(STYLE):
        figure = column_figure(26 + 29 * len(shown))
        panels = figure.subplots(
            len(shown),
            2,
            squeeze=False,
            sharex="col",
            sharey="row",
            gridspec_kw={"width_ratios": [2.6, 1.0]},
        )
        for (over_trials, distribution), (label, columns) in zip(panels, shown, strict=True):
            for number, (column, name) in enumerate(columns):
                values = np.array(run.column(column), dtype=float)
                values *= 1e3 if column.startswith(IN_MILLI) else 1.0
                _plot(over_trials, distribution, values, invalid, PALETTE[number], name)
            over_trials.set_ylabel(label)
            over_trials.xaxis.set_major_locator(MaxNLocator(integer=True))
            legend_above(over_trials, columns=1)
        panels[-1][0].set_xlabel("Trial")
        panels[-1][1].set_xlabel("Valid trials")
        panels[-1][1].xaxis.set_major_locator(MaxNLocator(3, integer=True))
        of = f"{int((~invalid).sum())} of {len(invalid)} trials valid"
        kind = run.header.procedure.removesuffix("-trial")
        title = run.header.marked(f"{kind} series, {of}, {run.settings['normal_force_N']:g} N")
        letter(over_trials for over_trials, _ in panels)
        top = set_heading(figure, title, circumstances(run), run.path.name, _note(invalid))
        set_margins(figure, top=top + 0.22, gap_mm=8.0)
        figure.subplots_adjust(wspace=0.1)
        figure.align_ylabels([over_trials for over_trials, _ in panels])
    return {"": figure}


def _has_values(run: RunFile, columns: tuple[tuple[str, str], ...]) -> bool:
    """Return whether any trial has a value in one of the columns: weights that did not slide away
    have no friction."""
    known = set(run.columns())
    return any(
        name in known and np.isfinite(np.array(run.column(name), dtype=float)).any()
        for name, _ in columns
    )


def _note(invalid: NDArray[np.bool_]) -> str:
    """Return what the numbers in the legends are, and the open circles if there are any."""
    numbers = "numbers: mean ± standard deviation of the valid trials"
    return f"{numbers}; open circles: invalid trials" if invalid.any() else numbers


def _plot(
    over_trials: Axes, distribution: Axes, values: Reals, invalid: NDArray[np.bool_],
    colour: str, name: str,
) -> None:  # fmt: skip
    """Plot a column over the trials, and the distribution of its valid ones."""
    trials, found = np.arange(1, len(values) + 1), np.isfinite(values)
    valid, doubtful = found & ~invalid, found & invalid
    if valid.any():
        spread = float(values[valid].std(ddof=1)) if valid.sum() > 1 else 0.0
        mean = with_error(float(values[valid].mean()), spread) if spread else ""
        name = f"{name}: {mean.lstrip('+') or format(values[valid].mean(), '.4g')}"
        distribution.hist(
            values[valid], bins="auto", orientation="horizontal", color=colour, alpha=0.5
        )
    over_trials.plot(trials[valid], values[valid], "o", markersize=2.5, color=colour, label=name)
    over_trials.plot(
        trials[doubtful], values[doubtful], "o", markersize=3, color=colour, fillstyle="none"
    )
