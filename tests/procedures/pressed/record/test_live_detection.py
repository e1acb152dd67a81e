"""The detector in a trial under way: what it finds, and that nothing of it ends a trial."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import recorded_trials as trials
from pydantic import ValidationError

from procedures.pressed.record.commanded_x import CommandedX
from procedures.pressed.record.detection import (
    DetectionRecord,
    LiveDetection,
    slips_in_words,
    unjudged_motion_in_words,
)
from procedures.pressed.record.trial_record import TrialRecord
from procedures.slip_trial.settings import SlipTrialSettings
from rig.core.clock import WallClock
from rig.detector.events import unjudged_s
from rig.detector.notices import HeldForce, XMove, columns_of, notices_in
from rig.detector.registered import chosen_detector
from rig.files.journal.detections import (
    EVENT_CODES,
    SILENT_CODE,
    SLIP,
    Detection,
    from_text,
    to_text,
)


class Journal:
    """Stands for a run: its events."""

    def __init__(self) -> None:
        self.events: list[tuple[Any, ...]] = []
        self.clock = WallClock()

    def event(self, *event: Any) -> None:
        self.events.append(event)


def recorded(detection: LiveDetection) -> tuple[TrialRecord, Journal]:
    """What a trial has recorded of a detection so far."""
    record, journal = TrialRecord(1, 100.0, 1000.0, 4.0), Journal()
    DetectionRecord(journal, record, detection).take()  # type: ignore[arg-type]
    return record, journal


@pytest.mark.parametrize("name", ["paper-hp", "paper-literal", "rig", "impulse"])
def test_blocks_of_any_length_give_the_events_of_the_whole_record(name: str) -> None:
    volts = trials.slipping()
    whole = chosen_detector(name).make(trials.RATE_HZ)
    expected = [(e.kind, e.sample, e.confidence, e.reason) for e in whole.add(volts)]
    expected += [(e.kind, e.sample, e.confidence, e.reason) for e in whole.finish()]
    live = LiveDetection(name, WallClock())
    cuts = np.cumsum(np.random.default_rng(5).integers(0, 9, 1000))
    for rows in np.split(volts, cuts[cuts < len(volts)]):
        live.judge(rows)
    live.finish()
    record, journal = recorded(live)
    found = [(one.kind, one.sample, one.confidence, one.reason) for one in record.detections]
    assert found == expected
    if name == "paper-hp":
        assert "incipient slip" in [kind for kind, *_ in found]
    assert [event[1] for event in journal.events] == [EVENT_CODES[kind] for kind, *_ in found]
    assert from_text(to_text(record.detections)) == record.detections
    assert "of its record (sample " in journal.events[0][2]


def test_the_commands_of_a_record_are_those_that_the_detector_knew_and_find_the_same() -> None:
    volts = trials.slipping()
    live = LiveDetection("impulse", WallClock())
    live.begin()
    live.notice(XMove(100, 0.5, 900))
    live.notice(HeldForce(350, 4.0))
    live.judge(volts[:400])
    live.notice(XMove(380, 0.1, 4000))  # given 20 rows too late
    live.notice(HeldForce(390, 3.5))
    live.judge(volts[400:])
    live.notice(XMove(len(volts) + 5, 0.0, 0))
    live.finish()
    rows = len(volts)
    moves = [XMove(100, 0.5, 900), XMove(400, 0.1, 4000), XMove(rows + 5, 0.0, 0)]
    forces = [HeldForce(350, 4.0), HeldForce(400, 3.5)]
    assert notices_in(columns_of(live.notices)) == [*moves, *forces]
    again = chosen_detector("impulse").make(trials.RATE_HZ)
    for one in notices_in(columns_of(live.notices)):
        again.notice(one)
    expected = [(e.kind, e.sample, e.confidence) for e in again.add(volts) + again.finish()]
    record, _ = recorded(live)
    assert [(one.kind, one.sample, one.confidence) for one in record.detections] == expected != []
    live.begin()
    assert live.notices == [], "another record begins"


class Wall:
    """A clock that the test sets."""

    now_s = 10.0

    def now(self) -> float:
        return self.now_s


class Moves:
    """Stands for the detection: it keeps the moves of x that a trial passes on."""

    def __init__(self) -> None:
        self.moves: list[XMove] = []

    def notice(self, move: XMove) -> None:
        self.moves.append(move)


def x_by_commands(*commands: tuple[float, float, float]) -> list[tuple[int, float, int]]:
    """What the detector receives where x is commanded, at times in s of the record that begins with
    x at 10 mm, to go to a position in mm at a speed in mm/s."""
    clock, received, record = Wall(), Moves(), TrialRecord(1, 100.0, 1000.0, 4.0)
    x = CommandedX(clock, record, received)  # type: ignore[arg-type]
    x.command(10.0, 1.0)  # before the record
    record.begun_s = clock.now_s
    x.begin(10.0)
    for at_s, to_mm, speed_mm_s in commands:
        clock.now_s = record.begun_s + at_s
        x.command(to_mm, speed_mm_s)
    x.end()
    x.command(0.0, 1.0)  # after it
    return [(move.sample, move.speed_mm_s, move.until) for move in received.moves]


def test_a_move_of_x_ends_where_it_comes_to_its_target() -> None:
    assert x_by_commands((1.0, 9.5, 0.25)) == [(1000, -0.25, 3000)]


def test_a_move_that_is_changed_under_way_is_reckoned_from_where_x_is_then() -> None:
    # A second at 0.25 mm/s, then back.
    assert x_by_commands((1.0, 11.0, 0.25), (2.0, 10.0, 0.5)) == [
        (1000, 0.25, 5000),
        (2000, -0.5, 2500),
    ]
    # It had arrived, so that the same speed is a further move.
    assert x_by_commands((1.0, 10.25, 0.25), (3.0, 10.5, 0.25)) == [
        (1000, 0.25, 2000),
        (3000, 0.25, 4000),
    ]


def test_a_stop_is_reported_and_what_hardly_changes_the_motion_is_not() -> None:
    ramp = [(1.0 + 0.01 * tick, 20.0, 1.0 + 0.011 * tick) for tick in range(16)]
    reported = x_by_commands(*ramp, (2.0, 0.0, 0.0), (2.5, 0.0, 0.0))
    assert [round(speed_mm_s, 2) for _, speed_mm_s, _ in reported] == [1.0, 1.11, 0.0]
    assert reported[-1] == (2000, 0.0, 2000)


def test_a_detector_that_raises_ends_with_a_warning_and_blocks_continue() -> None:
    live = LiveDetection("paper-hp", WallClock())
    volts = trials.slipping()
    live.judge(volts[:700])
    assert not live.has_ended
    live.judge(np.full((5, 2), np.nan))
    assert live.has_ended
    live.judge(volts[700:])
    live.finish()
    record, journal = recorded(live)
    assert record.detections == []
    ((level, code, words),) = journal.events
    assert (level, code) == ("warning", SILENT_CODE)
    assert "detector paper-hp failed (ValueError: v_1 is nan V" in words
    assert "the trial continues" in words
    assert recorded(live)[1].events == [], "said once"


def test_without_a_detector_nothing_is_found() -> None:
    live = LiveDetection("none", WallClock())
    live.judge(trials.slipping())
    live.finish()
    assert not live.woken.is_set()
    assert not live.has_ended
    assert recorded(live)[0].detections == []


def test_an_unknown_detector_is_refused_with_those_that_there_are() -> None:
    with pytest.raises(
        ValidationError, match=r"'paper' is not a detector; choose one of .*paper-hp, .*none"
    ):
        SlipTrialSettings(detector="paper")


def test_a_wait_is_ended_by_a_detection_of_another_thread() -> None:
    clock, woken, begun = WallClock(), threading.Event(), threading.Event()

    def detect() -> None:
        begun.wait(10)
        woken.set()

    thread = threading.Thread(target=detect)
    thread.start()
    slices: list[float] = []
    clock.each_slice(lambda: (slices.append(clock.now()), begun.set()))  # type: ignore[func-returns-value]
    clock.sleep_unless(woken, 60.0)
    thread.join()
    assert clock.now() < 50.0
    assert slices, "a wait checks what every wait checks"


def test_a_detector_that_alarms_without_end_does_not_fill_the_terminal() -> None:
    """One that reports a slip in every row printed 3110 lines in a trial of 3 s."""
    record = TrialRecord(1, 100.0, 1000.0, 4.0)
    record.detections = [Detection(SLIP, n, n / 1000, n / 1000, 0.9) for n in range(3110)]
    lines = slips_in_words(record, "lab-jump")
    assert len(lines) == 11
    assert lines[9:] == [
        "trial-001: incipient slip at 0.009 s (lab-jump)",
        "trial-001: and 3100 further alarms of incipient slip (lab-jump)",
    ]
    del record.detections[10:]
    assert slips_in_words(record, "lab-jump") == lines[:10], "all that were found are shown"


def unjudged(*found: tuple[str, float, str]) -> str:
    """What is said of a motion from 1 to 3 s in which a detector reports these events."""
    record = TrialRecord(1, 100.0, 1000.0, 4.0, motion_from_s=1.0, motion_to_s=3.0)
    record.detections = [
        Detection(kind, round(1e3 * at_s), at_s, at_s, 0.0, reason) for kind, at_s, reason in found
    ]
    return unjudged_motion_in_words(record, "rig")


def test_what_was_not_judged_before_it_was_noticed_is_said_as_it_is_scored() -> None:
    """v_2 is dead from 1.6 s on, which is noticed half a second later."""
    rng = np.random.default_rng(0)
    volts = 1e-4 * rng.standard_normal((4000, 2))
    volts[500:800] -= (0.02 * np.sin(np.pi * np.arange(300) / 300))[:, None]
    volts[1600:3000, 1] = volts[1600, 1]
    volts[1800:3000, 0] += 0.012
    live = LiveDetection("paper-hp", WallClock())
    live.judge(volts)
    live.finish()
    record, _ = recorded(live)
    record.motion_from_s, record.motion_to_s = 1.5, 3.0
    whole = chosen_detector("paper-hp").make(1000.0)
    ((begin_s, end_s),) = unjudged_s([*whole.add(volts), *whole.finish()], 4.0)
    assert (begin_s, end_s > 3.0) == (1.6, True)
    said = unjudged_motion_in_words(record, "paper-hp")
    assert "could not judge 1.40 s of the 1.50 s of motion (v_2 is dead" in said
    record.detections = from_text(to_text(record.detections))
    assert unjudged_motion_in_words(record, "paper-hp") == said
    record.detections = [replace(one, unjudged_ms=None) for one in record.detections]
    assert "0.90 s" in unjudged_motion_in_words(record, "paper-hp"), "a file of an earlier version"


def test_how_much_of_the_motion_was_not_judged_is_said_with_the_reasons() -> None:
    cannot, again, slip = "cannot judge", "judges again", "incipient slip"
    assert unjudged((slip, 2.0, "")) == ""
    assert unjudged((cannot, 0.2, "noise"), (again, 0.9, "noise"), (cannot, 3.2, "noise")) == ""
    assert "0.50 s of the 2.00 s of motion (noise)" in unjudged((cannot, 2.5, "noise"))
    said = unjudged(
        (cannot, 0.5, "noise"), (cannot, 0.6, "hum"), (again, 1.25, "noise"), (slip, 2.0, ""),
        (cannot, 2.5, "cut off"), (again, 2.75, "cut off"), (cannot, 2.8, "noise"),
        (again, 2.9, "noise"),
    )  # fmt: skip
    assert said == (
        "trial-001: the detector rig could not judge 0.60 s of the 2.00 s of motion (noise; "
        "cut off): a slip there has no alarm"
    )
