"""Strips whose voltage leaves the range of the DAQ during a trial."""

from __future__ import annotations

from typing import Any

from procedures.pressed.settings import PressedSettings
from rig.files.runfile.reader import RunFile

LOUD = "[transducer.circuit]\ngain = 200000.0\n"
"""An amplifier with 200 times the usual gain: both strips reach either end of 1.25 V."""


def test_a_strip_that_leaves_the_range_of_the_daq_is_reported(rig: Any) -> None:
    done = rig.run(
        "slip-trial", "--no-figures", "--world", rig.world(LOUD), "--rest", "0.1",
        "--distance", "0.2", "--speed", "1", "--detector", "none",
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
