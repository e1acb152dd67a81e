"""Figures of what a detector found, and of its low-pass."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from rig.analysis.low_pass_curves import low_pass_curves, low_pass_summary
from rig.detector.events import SlipEvent
from rig.detector.low_pass import NAMED_LOW_PASSES, design_low_pass
from rig.figures.low_pass import draw_low_pass
from rig.figures.processed import draw_trial, draw_trials
from rig.files.processed.values import DetectedTrial

PROCESSED = SimpleNamespace(
    title="SIMULATED Slips detected: slide",
    version="1",
    source=SimpleNamespace(mark="SIMULATED"),
    detector=SimpleNamespace(name="paper-hp"),
    path=Path("r001.paper-hp-1-0123.h5"),
)


def trial(*events, name="trial-001", sample=None):
    sample = np.arange(3000) if sample is None else sample
    v_d = 1e-3 * np.sin(sample / 50.0)
    return DetectedTrial(name, 1000.0, sample, v_d, v_d / 2, tuple(events))


def at(kind, time_s):
    return SlipEvent(kind, round(1000 * time_s), time_s, 0.75)


def legend(axes):
    return [text.get_text() for text in axes.get_legend().get_texts()]


def test_events_are_marked_where_they_were_decided_and_counted():
    events = [at("predictive", 1.2), at("incipient slip", 1.3), at("incipient slip", 1.6)]
    figure = draw_trial(PROCESSED, trial(*events))
    signal, low, confidence = figure.axes
    assert legend(signal)[1:] == ["motion under load begun (1)", "alarm of incipient slip (2)"]
    marked = sorted(line.get_xdata()[0] for line in low.get_lines()[1:])
    assert marked == [1.2, 1.3, 1.6]
    assert [line.get_ydata().tolist() for line in confidence.get_lines()] == [[0.75], [0.75, 0.75]]
    assert signal.get_xlim() == pytest.approx((0.7, 2.1))
    reported = figure.get_suptitle()
    assert reported.startswith("SIMULATED")
    assert "first slip at 1.300 s" in reported
    assert f", version {PROCESSED.version}, " in " ".join(one.get_text() for one in figure.texts)


def test_the_dot_of_an_event_that_is_certain_is_whole():
    certain = SlipEvent("incipient slip", 1300, 1.3, 1.0)
    figure = draw_trial(PROCESSED, trial(certain))
    confidence = figure.axes[2]
    figure.draw_without_rendering()
    _, y = confidence.transData.transform((1.3, 1.0))
    radius = confidence.get_lines()[0].get_markersize() / 2 * figure.dpi / 72
    assert y + radius <= confidence.bbox.y1


def test_a_trial_without_events_is_shown_whole():
    figure = draw_trial(PROCESSED, trial())
    low, high = figure.axes[0].get_xlim()
    assert low <= 0.0
    assert high >= 2.999
    assert "no slip found" in figure.get_suptitle()


def test_no_line_is_drawn_across_a_gap():
    figure = draw_trial(PROCESSED, trial(sample=np.r_[0:1000, 2000:3000]))
    for axes in figure.axes[:2]:
        drawn = axes.get_lines()[0].get_ydata()
        assert np.flatnonzero(np.isnan(drawn)).tolist() == [1000]


def test_every_trial_has_a_figure_of_its_own():
    several = [trial(name=f"trial-{number:03d}") for number in (1, 2, 3)]
    processed = SimpleNamespace(**vars(PROCESSED), trials=lambda: several)
    assert list(draw_trials(processed)) == ["", "-trial-002", "-trial-003"]


def test_the_low_pass_shows_four_curves_and_hides_what_means_nothing():
    low_pass = design_low_pass(NAMED_LOW_PASSES["paper"], 1000.0)
    summary = low_pass_summary(low_pass)
    figure = draw_low_pass("paper", 73.5, low_pass_curves(low_pass), summary)
    gain, phase, delay, step = figure.axes
    assert legend(gain) == [
        "-73.5 dB from 57.5 Hz, largest lobe -68.5 dB", "-3 dB at 28.00 Hz",
    ]  # fmt: skip
    assert legend(phase) == ["-9.00 deg at 1 Hz"]
    for axes in (phase, delay):
        line = axes.get_lines()[0]
        shown = line.get_xdata()[~np.isnan(line.get_ydata())]
        assert shown.max() < summary.lobes_from_Hz
    assert step.get_lines()[0].get_ydata()[-1] == pytest.approx(1.0)
