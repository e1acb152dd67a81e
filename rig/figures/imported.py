"""The figure of an imported recording: both strips, their difference, and its forces.

Long recordings are drawn as the band between the smallest and largest of every few samples, which
looks the same on paper and makes no file of a hundred megabytes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np

from rig.figures.circumstances import circumstances
from rig.figures.pressed import seconds
from rig.figures.style import (
    BLUE,
    ORANGE,
    SKY,
    STYLE,
    VERMILLION,
    column_figure,
    legend_above,
    letter,
    set_heading,
    set_margins,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from rig.files.runfile.reader import RunFile

MOST_DRAWN = 8000
"""Largest number of points of a curve: several for each dot of the picture's width."""
MILLIVOLTS_BELOW_V = 1.0


def draw_recording(run: RunFile) -> Figure:
    """Draw both strips, their difference, and the forces if there are any, over time."""
    series = {waveform.stream: waveform for waveform in run.waveforms()}
    signals, force = series["signals"], series.get("force")
    volts = {name: signals.values(name) for name in ("v_d", "v_1", "v_2")}
    small = max(float(np.abs(v).max()) for v in volts.values()) < MILLIVOLTS_BELOW_V
    factor, unit = (1e3, "mV") if small else (1.0, "V")
    panels = 2 if force is None else 3
    with mpl.rc_context(STYLE):
        figure = column_figure(24 + 34 * panels)
        axes = list(figure.subplots(panels, 1, sharex=True))
        t = seconds(signals)
        axes[0].plot(
            *thinned(t, factor * volts["v_d"]), linewidth=0.7, color=BLUE, label="$v_d = v_1 - v_2$"
        )
        for colour, name, label in ((ORANGE, "v_1", "$v_1$"), (SKY, "v_2", "$v_2$")):
            axes[1].plot(
                *thinned(t, factor * volts[name]), linewidth=0.6, color=colour, label=label
            )
        for panel in axes[:2]:
            panel.set_ylabel(f"Signal ({unit})")
        if force is not None:
            for colour, name, label in ((BLUE, "F_n", "$F_n$"), (VERMILLION, "F_t", "$F_t$")):
                if name in force.counts:
                    values = force.values(name)
                    axes[2].plot(*thinned(t, values), color=colour, label=label)
            axes[2].set_ylabel("Force (N)")
        axes[-1].set_xlabel("Time since the recording's start (s)")
        for panel in axes:
            legend_above(panel)
        letter(axes)
        title = run.header.marked(run.header.title)
        top = set_heading(figure, title, circumstances(run), run.path.name)
        set_margins(figure, top=top + 0.14, gap_mm=4.0)
        figure.align_ylabels(axes)
    return figure


def thinned(
    t: NDArray[np.float64], values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a curve of at most MOST_DRAWN points with the same extremes: the smallest and the
    largest of every group of samples, in their order.

    Both are (m,).
    """
    size = -(-2 * len(values) // MOST_DRAWN)
    if size <= 2:
        return t, values
    whole = len(values) // size * size
    groups = values[:whole].reshape(-1, size)
    kept = np.sort(np.stack([groups.argmin(axis=1), groups.argmax(axis=1)], axis=1), axis=1)
    index = (kept + size * np.arange(len(groups))[:, None]).reshape(-1)
    index = np.concatenate([index, np.arange(whole, len(values))])
    return t[index], values[index]
