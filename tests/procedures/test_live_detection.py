"""The detector in a trial under way: what it finds, and that nothing of it ends a trial."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pytest
import recorded_trials as trials
from pydantic import ValidationError

from procedures.pressed.detection import DetectionRecord, LiveDetection
from procedures.pressed.reading import TrialRecord
from procedures.slip_trial.settings import SlipTrialSettings
from rig.core.clock import WallClock
from rig.detector.registered import chosen_detector
from rig.files.journal.detections import EVENT_CODES, SILENT_CODE, from_text, to_text


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


@pytest.mark.parametrize("name", ["paper-hp", "paper-literal", "rig"])
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


def test_a_detector_that_raises_ends_with_a_warning_and_blocks_continue() -> None:
    live = LiveDetection("paper-hp", WallClock())
    volts = trials.slipping()
    live.judge(volts[:700])
    live.judge(np.full((5, 2), np.nan))
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
