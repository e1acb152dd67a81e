"""A stage that answers late where it is: the file says how old a position is; the trial is invalid.

Virtual time stops while an instrument answers. So the late answer is put in where a trial takes it
from the link's worker; everything else is the real command.
"""

from __future__ import annotations

import numpy as np
import pytest

from rig.files.runfile.reader import RunFile
from rig.files.verify import verify

pytestmark = pytest.mark.thorough
LATE_S = 0.4
LATE = """
import {module} as module
looks = module.{axis}.ask_poll
def ask_poll(axis):
    now_s = axis.{clock}.now()
    if axis.role != "{role}":
        return looks(axis)
    begun_s = axis.__dict__.setdefault("begun_s", now_s)
    if now_s < begun_s + 0.2 or hasattr(axis, "answered"):
        return looks(axis)
    if not hasattr(axis, "asked_s"):
        axis.asked_s, before = now_s, axis.latest
        looks(axis)  # the stage answers at once; its answer is on its way
        axis.on_its_way, axis.latest = axis.latest, before
    elif now_s >= axis.asked_s + {late_s}:
        axis.latest = axis.on_its_way.__class__(axis.asked_s, now_s, *astuple(axis.on_its_way)[2:])
        axis.answered = True
from dataclasses import astuple
module.{axis}.ask_poll = ask_poll
"""
OF_X = {
    "module": "procedures.pressed.axes", "axis": "PolledStage", "clock": "clock",
    "role": "stage_x", "late_s": LATE_S,
}  # fmt: skip
OF_THE_ANGLE = {
    "module": "procedures.roll_trial.trial", "axis": "PolledRotary", "clock": "_clock",
    "role": "rotary", "late_s": LATE_S,
}  # fmt: skip


def take(rig, what, *given, late):
    """A trial in whose motion one answer comes late."""
    arguments = (what, "--json", "--no-figures", "--rest", "100ms", *given)
    return rig.start(*arguments, before=LATE.format(**late)).finish()


def taken(rig):
    """The reading of the trial, and its streams."""
    file = rig.only("*.h5")
    assert verify(file) == []
    with RunFile.open(file) as run:
        (reading,) = run.readings()
        return reading, {waveform.stream: waveform for waveform in run.waveforms("trial-001")}


def assert_repeated_and_said(values, ages_s):
    """The same number again and again while the answer was under way; each time it is older."""
    oldest = int(np.argmax(ages_s))
    assert ages_s[oldest] == pytest.approx(LATE_S, abs=0.1)
    begun = int(np.flatnonzero(ages_s[:oldest] < 0.02)[-1])
    assert oldest - begun >= 5
    assert np.ptp(values[begun : oldest + 1]) == 0.0
    assert np.all(np.diff(ages_s[begun : oldest + 1]) > 0)


def test_a_trial_in_which_x_answered_late_says_how_old_its_positions_are_and_does_not_count(rig):
    ended = take(rig, "slip-trial", "--distance", "0.5mm", "--speed", "0.5mm/s", late=OF_X)
    assert ended.code == 5, ended.stderr
    reading, streams = taken(rig)
    assert "stage_x was not seen for 0.4" in reading["invalid"]
    assert "its answers, or the computer's ticks, came late" in reading["invalid"]
    assert reading["oldest_look_s"] == pytest.approx(LATE_S, abs=0.1)
    elapsed = streams["ticks"].values("elapsed")
    slides = (elapsed > reading["slide_from_s"] + 0.05) & (elapsed < reading["slide_to_s"])
    x_mm, ages_s = (streams[name].values("x") for name in ("position", "ages"))
    assert len(elapsed) == len(x_mm) == len(ages_s)
    assert_repeated_and_said(x_mm[slides], ages_s[slides])


def test_a_roll_whose_angle_was_answered_late_does_not_count(rig):
    ended = take(rig, "roll-trial", "--stay", "100ms", late=OF_THE_ANGLE)
    assert ended.code == 5, ended.stderr
    reading, streams = taken(rig)
    assert "rotary was not seen for 0.4" in reading["invalid"]
    elapsed = streams["ticks"].values("elapsed")
    rolls = (elapsed > reading["roll_from_s"] + 0.05) & (elapsed < reading["roll_to_s"])
    angles, ages_s = streams["rotation"].values("angle"), streams["ages"].values("angle")
    assert_repeated_and_said(angles[rolls], ages_s[rolls])


def test_a_trial_whose_stages_answer_in_time_has_new_positions_and_counts(rig):
    ended = rig.run(
        "slip-trial", "--json", "--no-figures", "--rest", "100ms", "--distance", "0.5mm",
        "--speed", "0.5mm/s",
    )  # fmt: skip
    assert ended.code == 0, ended.stderr
    reading, streams = taken(rig)
    assert reading["oldest_look_s"] < 0.1
    elapsed = streams["ticks"].values("elapsed")
    slides = (elapsed > reading["slide_from_s"] + 0.05) & (elapsed < reading["slide_to_s"])
    assert streams["ages"].values("z")[slides].max() < 0.1
    assert streams["ages"].values("x")[slides].max() < 0.1
