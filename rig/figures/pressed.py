"""What the figures of trials with the skin pressed on an object have in common."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from rig.files.runfile.reader import RunFile, Waveform

TRIALS_SHOWN = 20
"""Trials that get a figure of their own; the file holds them all."""
BEFORE_S = 0.3
"""What is shown before the force is felt; the file holds all of it."""
LEAST_FORCE = 0.1
"""Share of the normal force from which the object counts as touched."""


def seconds(waveform: Waveform) -> NDArray[np.float64]:
    """Times of an equally spaced record's rows, since its start."""
    first = next(iter(waveform.counts.values()))
    return np.arange(len(first)) / (waveform.rate_Hz or 1.0)


def shade(panels: Iterable[Axes], begin_s: float, end_s: float, what: str) -> None:
    """Mark the motion in every panel, named in the first."""
    for number, axes in enumerate(panels):
        label = None if number else what
        axes.axvspan(begin_s, end_s, color="C2", alpha=0.07, linewidth=0, label=label)


def show_allowed_error(axes: Axes, run: RunFile) -> None:
    """The rms error beyond which a trial does not count, as a band."""
    allowed = float(run.settings.get("force_error_rms_percent", 0.0))
    if allowed:
        label = f"rms up to {allowed:g} % counts"
        axes.axhspan(-allowed, allowed, color="0.5", alpha=0.12, linewidth=0, label=label)


def from_touch_on(
    axes: Axes, t: NDArray[np.float64], pressing_N: NDArray[np.float64], wanted_N: float
) -> None:
    """Begin the time axis shortly before the object is touched."""
    touched = t[pressing_N > LEAST_FORCE * wanted_N]
    if touched.size:
        axes.set_xlim(max(0.0, float(touched[0]) - BEFORE_S), float(t[-1]))


def heading(figure: Figure, run: RunFile, number: int, point: str) -> int:
    """Title, file, and why the trial does not count if it does not; how many lines that is."""
    doubt = str(run.column("invalid")[number])
    invalid = f"\ndoes not count: {doubt}" if doubt else ""
    figure.suptitle(f"{run.header.title}: {point}\n{run.path.name}{invalid}", fontsize=9)
    return 3 if doubt else 2
