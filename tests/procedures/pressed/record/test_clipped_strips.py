"""Strips whose voltage leaves the range of the DAQ during a trial."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from procedures.pressed.settings import PressedSettings
from rig.detector.events import unjudged_s
from rig.detector.registered import chosen_detector
from rig.files.journal.detections import from_text
from rig.files.runfile.reader import RunFile
from rig.processing.detection import detect_trials

LOUD = "[transducer.circuit]\ngain = 200000.0\n"
"""An amplifier with 200 times the usual gain: both strips reach either end of 1.25 V."""


def test_a_strip_that_leaves_the_range_of_the_daq_is_reported(rig: Any) -> None:
    done = rig.run(
        "slip-trial", "--no-figures", "--world", rig.world(LOUD), "--rest", "0.1",
        "--distance", "0.2", "--speed", "1", "--detector", "rig",
    )  # fmt: skip
    assert done.code == 0, done.stderr
    with RunFile.open(rig.only("*.h5")) as run:
        strips = next(run.waveforms("trial-001", stream="strips"))
        volts = {strip: strips.values(strip) for strip in ("strip_1", "strip_2")}
    range_V = PressedSettings().range_V
    for strip, values in volts.items():
        clipped = int((abs(values) > 0.9999 * range_V).sum())
        assert clipped > 0
        said = (
            f"trial-001: {clipped} of {len(values)} samples of {strip} are at the end of the range"
        )
        assert said in done.stderr
    assert "choose a larger --range" in done.stderr
    assert "the detector rig could not judge" in done.stderr
    _the_detector_does_not_judge_what_was_cut_off(rig.only("*.h5"), range_V)


def _the_detector_does_not_judge_what_was_cut_off(file: Path, range_V: float) -> None:
    """Neither beside the trial nor from its file, from the first cut-off sample to 50 ms after."""
    with RunFile.open(file) as run:
        (reading,) = run.readings()
        strips = next(run.waveforms("trial-001", stream="strips"))
        ends = [abs(strips.values(name)) > 0.9999 * range_V for name in ("strip_1", "strip_2")]
        (judged,) = detect_trials(run, chosen_detector("rig"))
        factor = round(strips.rate_Hz / 1000.0)
    rows = np.unique(np.ceil(np.flatnonzero(np.logical_or(*ends)) / factor).astype(int))
    cut_off = json.loads(reading["cut_off_rows"])
    stored = np.concatenate([np.arange(*one) for one in cut_off])
    assert set(rows) <= set(stored)
    assert set(stored) <= set(np.concatenate([rows + k for k in range(-20, 21)]))
    live = [(one.kind, one.sample, one.reason) for one in from_text(reading["detections"])]
    assert live == [(one.kind, one.sample, one.reason) for one in judged.events]
    first = next((kind, sample) for kind, sample, reason in live if reason.startswith("cut off"))
    assert first == ("cannot judge", rows[0])
    unjudged = unjudged_s(judged.events, float(judged.sample[-1]) / judged.rate_Hz)
    for row in rows:
        assert any(begin <= row / 1000.0 <= end for begin, end in unjudged), row
