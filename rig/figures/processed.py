"""The figure of a detector's result in a trial: v_d, the predictive signal, and the events."""

from __future__ import annotations

from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np

from rig.detector.events import SHOWN_AS, EventKind, unjudged_s
from rig.figures.pressed import TRIALS_SHOWN
from rig.figures.style import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    STYLE,
    VERMILLION,
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

    from rig.files.processed.reader import ProcessedFile
    from rig.files.processed.values import DetectedTrial

MARKS: dict[EventKind, tuple[str, str]] = {
    "predictive": (ORANGE, ":"),
    "incipient slip": (VERMILLION, "-"),
    "roll": (GREEN, "--"),
    "rejected": (GREY, ":"),
}
"""Colour and line of each kind of event. Time that cannot be judged is shaded."""
AROUND_S = 0.5
"""Time shown before the first and after the last event; the file contains all of the trial."""


def draw_trials(processed: ProcessedFile) -> dict[str, Figure]:
    """Draw one figure per trial: the first has the file's name, the others append their own."""
    return {
        "" if number == 0 else f"-{trial.id}": draw_trial(processed, trial)
        for number, trial in enumerate(processed.trials()[:TRIALS_SHOWN])
    }


def draw_trial(processed: ProcessedFile, trial: DetectedTrial) -> Figure:
    """Draw both signals around the events, or over the whole trial if it has none, and the
    confidence of each event below."""
    with mpl.rc_context(STYLE):
        figure = column_figure(96)
        signal, low, confidence = figure.subplots(
            3, 1, sharex=True, gridspec_kw={"height_ratios": [2.0, 1.6, 1.0]}
        )
        t, v_d = _with_gaps(trial, trial.v_d)
        signal.plot(t, 1e3 * v_d, linewidth=0.6, color=BLUE, label="$v_d = v_1 - v_2$")
        signal.set_ylabel("Signal (mV)")
        t, predictive = _with_gaps(trial, trial.predictive)
        low.plot(t, 1e3 * predictive, linewidth=0.8, color=PURPLE, label="low-passed $v_d$")
        low.set_ylabel("Predictive (mV)")
        _mark_events((signal, low), confidence, trial)
        confidence.set_ylim(0.0, 1.15)  # the dot of a confidence of 1 is whole
        confidence.set_ylabel("Confidence")
        confidence.set_xlabel("Time since the record's start (s)")
        if trial.events:
            times = [event.time_s for event in trial.events]
            end = min(float(trial.time_s[-1]), max(times) + AROUND_S)
            signal.set_xlim(max(0.0, min(times) - AROUND_S), end)
        legend = legend_above(signal, columns=2)
        legend_above(low)
        mark = f"{processed.source.mark} " if processed.source.mark else ""
        letter((signal, low, confidence))
        top = set_heading(
            figure,
            f"{mark}slip detection, {trial.id}: {_in_words(trial)}",
            f"detector {processed.detector.name}, version {processed.version}, "
            f"{processed.path.name}",
        )
        set_margins(figure, top=top + legend, gap_mm=4.0)
        figure.align_ylabels((signal, low, confidence))
    return figure


def _mark_events(panels: tuple[Axes, Axes], confidence: Axes, trial: DetectedTrial) -> None:
    """Draw a line per event through the signals, with one label per kind, and its confidence
    below."""
    for kind, (colour, line) in MARKS.items():
        events = [event for event in trial.events if event.kind == kind]
        of_kind = "alarm of incipient slip" if kind == "incipient slip" else SHOWN_AS[kind]
        for number, event in enumerate(events):
            label = f"{of_kind} ({len(events)})" if number == 0 else None
            for axes, named in zip(panels, (label, None), strict=True):
                axes.axvline(event.time_s, color=colour, linestyle=line, linewidth=0.8, label=named)
        if events:
            times = [event.time_s for event in events]
            sure = [event.confidence for event in events]
            confidence.plot(times, sure, "o", markersize=4, color=colour)

    if trial.sample.size:
        record_s = (int(trial.sample[-1]) + 1) / trial.rate_Hz
        for number, (begin_s, end_s) in enumerate(unjudged_s(trial.events, record_s)):
            label = "cannot judge" if number == 0 else None
            for axes, named in zip(panels, (label, None), strict=True):
                axes.axvspan(begin_s, end_s, color="0.85", zorder=0, label=named)


def _in_words(trial: DetectedTrial) -> str:
    first = next((event for event in trial.events if event.kind == "incipient slip"), None)
    return "no slip found" if first is None else f"first slip at {first.time_s:.3f} s"


def _with_gaps(
    trial: DetectedTrial, values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return times and values with a NaN in every gap, so that no line is drawn across it."""
    behind = np.flatnonzero(np.diff(trial.sample) > 1) + 1
    return np.insert(trial.time_s, behind, np.nan), np.insert(values, behind, np.nan)
