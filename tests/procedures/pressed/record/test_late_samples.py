"""Strips that are read so late that a grip cannot answer an alarm: longer blocks, and the verdict
of a trial whose alarms came too late all the same."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_pressed_reading import reading_of_record
from test_pressed_reading import record as a_record
from tiers import mostly_nightly

from procedures.pressed.grip_summary import grip_summary
from procedures.pressed.record.block_length import longer_block_s
from procedures.pressed.record.strips import StripRecorder
from procedures.pressed.record.trial_record import TrialRecord
from procedures.pressed.settings import PressedSettings
from procedures.pressed.trial import PressedTrial
from procedures.slip_trial.settings import SlipTrialSettings
from rig.files.journal.detections import SLIP, Detection
from rig.files.runfile.reader import RunFile
from rig.instruments.roles import Acquisition, Record, Scaling
from rig.run.points import RetakeError
from rig.run.streams.sample_stream import SlowStreamError

ALARM = Detection(SLIP, 1500, 1.5, 1.502, 0.9)
GRIP = SlipTrialSettings(regrip=True)
WEIGHT = (
    "--regrip", "--loading", "ramp", "--hold-at", "3N", "--speed", "2mm/s", "--distance", "2mm",
    "--rehearsal", "never", "--json", "--no-figures",
)  # fmt: skip


@pytest.mark.parametrize(
    ("block_s", "read_s", "longer_s"),
    [
        (0.002, 0.0021, 0.005),
        (0.002, 0.0029, 0.01),
        (0.005, 0.0034, 0.01),
        (0.002, 0.5, 0.02),  # not even these are long enough: the longest that there are
        (0.01, 0.012, 0.02),
        (0.02, 0.03, None),
    ],
)
def test_a_longer_block_takes_at_most_half_of_its_length_to_be_read(
    block_s: float, read_s: float, longer_s: float | None
) -> None:
    assert longer_block_s(block_s, read_s) == longer_s


class SlowClockDaq:
    """Samples at a rate that is 1 % lower than it says."""

    def __init__(self, now: Any):
        self._now, self._rows = now, 0

    def start(self, acquisition: Acquisition) -> Scaling:
        self._begun_s, self._block = self._now(), acquisition.samples
        names = tuple(channel.name for channel in acquisition.channels)
        ones = (1.0, 1.0)
        self._scaling = Scaling(names, acquisition.rate_S_s, ones, ones, ones, ones, -1, 1)
        return self._scaling

    def read(self) -> Record | None:
        sampled = 0.99 * self._scaling.rate_S_s * (self._now() - self._begun_s)
        if sampled < self._rows + self._block:
            return None
        first, self._rows = self._rows, self._rows + self._block
        return Record(np.zeros((self._block, 2), np.int16), self._scaling, first)


def test_a_daq_whose_clock_is_slow_is_not_read_late_where_it_has_no_further_block() -> None:
    bench_s = 5.0
    clock = SimpleNamespace(now=lambda: bench_s)
    run: Any = SimpleNamespace(
        settings=GRIP, clock=clock, bench=SimpleNamespace(daq=SlowClockDaq(clock.now))
    )
    links: Any = SimpleNamespace(add=lambda role: None, ask=lambda role, what, work: work())
    detection: Any = SimpleNamespace(begin=lambda: None, judge=lambda volts: None)
    strips = StripRecorder(run, TrialRecord(1, 100.0, 1000.0, 4.0), links, detection, 0.002)
    strips.start()
    for number in range(1, 10_000):
        bench_s = 5.0 + 0.001 * number
        strips.ask_block()
    assert strips.behind_s < 0.01
    bench_s += 0.2  # now nothing is read for a while
    assert strips.behind_s == pytest.approx(0.2, abs=0.01)


def doubts(settings: PressedSettings, *alarms: Detection) -> str:
    """Why a trial with these alarms is invalid."""
    record = a_record(0)
    record.detections = list(alarms)
    return str(reading_of_record(record, settings=settings)["invalid"])


def test_a_trial_whose_alarm_came_too_late_for_the_grip_is_invalid() -> None:
    late = replace(ALARM, decided_s=3.1)
    assert doubts(GRIP, ALARM) == ""
    assert "an alarm came 1.6 s after its sample, more than 0.1 s" in doubts(GRIP, ALARM, late)
    assert doubts(SlipTrialSettings(), late) == ""  # nothing was to answer it
    assert doubts(GRIP.model_copy(update={"regrip_on": "motion"}), late) == ""
    before = replace(late, time_s=0.5)
    assert doubts(GRIP, before) == ""  # it would not have been answered in time either
    last = replace(late, time_s=1.6)  # all steps have been made before
    assert doubts(GRIP, *[ALARM] * GRIP.regrip_times, last) == ""


def test_longer_blocks_are_proposed_only_where_their_length_is_fixed() -> None:
    late = replace(ALARM, decided_s=3.1)
    assert "--block" not in doubts(GRIP, late)
    assert "longer blocks (--block)" in doubts(GRIP.model_copy(update={"block_s": 0.002}), late)


def test_a_trial_whose_detector_has_ended_is_invalid_if_the_grip_needs_it() -> None:
    """Without alarms every weight is lost, and the grip would seem to have failed."""
    record = a_record(0)
    record.detection_ended = True
    judged = reading_of_record(record, settings=GRIP)["invalid"]
    assert judged == "detector paper-hp was dropped, so the grip got no alarms"
    assert reading_of_record(record)["invalid"] == ""
    on_motion = GRIP.model_copy(update={"regrip_on": "motion"})
    assert reading_of_record(record, settings=on_motion)["invalid"] == ""


def test_weights_of_invalid_trials_are_not_among_the_lost_ones() -> None:
    late, forces = "an alarm came 1.6 s after its sample", {"least_force_N": 4.0}
    trials = [
        {"outcome": "averted", "invalid": late, "force_used_N": 8.0, **forces},
        {"outcome": "lost", "invalid": "", "force_used_N": 4.0, **forces},
        {"outcome": "averted", "invalid": "", "force_used_N": 4.8, **forces},
    ]
    weights, force = grip_summary(trials)["grip"]
    assert weights == (
        "Weights: held 0, averted 1, lost 1 (averted: at rest after a squeeze); 1 invalid trial "
        "left out."
    )
    assert "about 1.20 or more by" in force


@pytest.mark.stages("festo", because="what is slow here is the DAQ")
@pytest.mark.parametrize("rest", mostly_nightly(["0.1s", "12s"], ["0.1s"]))
def test_a_daq_too_slow_for_short_blocks_is_read_in_longer_ones_before_the_motion(
    rig, rest: str
) -> None:
    """Every block takes 3 ms longer, of which there are 500 a second. A long rest is interrupted:
    at its end the DAQ's stream would have been so late that the run had ended."""
    plan = rig.fault(
        '[[fault]]\ndevice = "daq"\nkind = "late"\ncommand = "WAV:DATA"\nby_s = 0.003\ncount = 0\n'
    )
    with rig.served("--fixture", "plate", "--fault", plan, ways="as usual"):
        ended = rig.run("slip-trial", "--bench", "bench.toml", *WEIGHT, "--rest", rest)
    if "cannot keep" in ended.stderr:
        pytest.skip("the computer is too busy for a simulated bench in real time")
    first, *_ = [  # there are more where the computer is busy
        line
        for line in ended.stderr.splitlines()
        if "too late for the grip" in line and line.endswith("retaking it")
    ]
    assert "a block of 2 ms takes" in first
    assert re.search(r"blocks of (10|20) ms from here on", first)
    if ended.code == 3 and "blocks of 0.02 s take longer than that" in ended.stderr:
        return  # a busy computer reads the longest blocks too late as well
    assert ended.code in (0, 5), ended.stderr  # 5: it makes a trial invalid
    with RunFile.open(rig.only("*.h5")) as run:
        (reading,) = run.readings()
        assert reading["samples"] > 0


@pytest.mark.parametrize(("longer", "raised"), [("", SlowStreamError), ("5 ms", RetakeError)])
def test_a_stream_that_ends_because_it_is_slow_has_the_trial_retaken_if_blocks_can_be_longer(
    monkeypatch: pytest.MonkeyPatch, longer: str, raised: type[Exception]
) -> None:
    """It is lifted first; where the blocks are the longest already, or fixed, the run ends."""
    lifted: list[bool] = []
    monkeypatch.setattr(PressedTrial, "__init__", lambda trial: None)
    monkeypatch.setattr(PressedTrial, "abandon", lambda trial: lifted.append(True))
    trial: Any = PressedTrial()  # type: ignore[call-arg]
    trial._late_samples = SimpleNamespace(lengthen_blocks=lambda beyond_s: longer or None)
    with pytest.raises(raised), trial.longer_blocks_if_too_slow():
        raise SlowStreamError("daq", "stream", "its blocks of 0.002 s take longer than that")
    assert lifted == [True] * bool(longer)


@pytest.mark.thorough
@pytest.mark.stages("festo", because="what is slow here is the DAQ")
def test_a_daq_that_becomes_too_slow_in_the_motion_is_read_in_longer_blocks(rig) -> None:
    """From the motion on every block takes 8 ms longer: no longer blocks were needed before it, and
    the DAQ's stream ends within the hold."""
    plan = rig.fault(
        '[[fault]]\ndevice = "daq"\nkind = "late"\ncommand = "WAV:DATA"\nby_s = 0.008\ncount = 0\n'
        'move = 2\nof = "stage_x"\nafter_s = 0.2\n'
    )
    hold = ("--hold-for", "8s", "--hold-at", "1N")
    with rig.served("--fixture", "plate", "--fault", plan, ways="as usual"):
        ended = rig.run("slip-trial", "--bench", "bench.toml", *WEIGHT, *hold)
    assert "blocks of 0.002 s take longer than that" not in ended.stderr
    if ended.code == 3:
        pytest.skip("the computer is too busy for a simulated bench in real time")
    assert ended.code in (0, 5), ended.stderr  # 5: it makes a trial invalid
    assert re.search(r"blocks of (10|20) ms from here on; retaking it", ended.stderr)
    with RunFile.open(rig.only("*.h5")) as run:
        (reading,) = run.readings()
        assert reading["samples"] > 0
