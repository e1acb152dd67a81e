"""A recording is given to another package's detector as a trial would give it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rig.detector import registered
from rig.detector.blocks import BlockFeed
from rig.detector.contract import Detector
from rig.detector.events import SlipEvent
from rig.detector.notices import CutOff, HeldForce, XMove
from rig.detector.registered import chosen_detector


class Noting(Detector):
    """Notes the blocks and what the bench knows, and alarms at the largest v_1 of a block."""

    version = "1"

    def __init__(self, settings: Any, rate_Hz: float):
        self.given: list[Any] = []
        super().__init__(settings, rate_Hz)

    def reset(self) -> None:
        self.given.append("reset")

    def judge(self, volts: np.ndarray) -> list[SlipEvent]:
        self.given.append(len(volts))
        if not len(volts) or volts[:, 0].max() < 1:
            return []
        return [self.event("incipient slip", int(volts[:, 0].argmax()), 1.0)]

    def commanded(self, before_mm_s: float, after_mm_s: float) -> None:
        self.given.append(("x", after_mm_s))

    def commanded_force(self, before_N: float | None, after_N: float) -> None:
        self.given.append(("force", after_N))

    def cut_off(self, now: bool) -> None:
        self.given.append(("cut off", now))


@pytest.fixture
def feed(monkeypatch: pytest.MonkeyPatch) -> BlockFeed:
    """A detector of another package, with what the bench knew of ten rows."""
    monkeypatch.setattr(registered, "detector_class", lambda name: Noting)
    monkeypatch.setattr(registered, "_package_of", lambda name: ("lab", "1.0"))
    notices = [XMove(3, 0.5, 8), XMove(5, 0.0, 0), HeldForce(1, 4.0), CutOff(6, 7)]
    return BlockFeed(chosen_detector("lab"), 1000.0, notices)


def given(feed: BlockFeed) -> list[Any]:
    detector: Any = feed.detector
    return list(getattr(detector, "_inner", detector).given)


def test_no_block_shows_more_than_2_ms_and_every_notice_comes_before_its_rows(
    feed: BlockFeed,
) -> None:
    feed.add(np.zeros((10, 2)), first_sample=0)
    judged = [one for one in given(feed) if one != 0]
    assert judged == [
        "reset", 1, ("force", 4.0), 1, 1, ("x", 0.5), 1, 1, ("x", 0.0), 1,
        ("cut off", True), 1, ("cut off", False), 1, 2,
    ]  # fmt: skip


def test_rows_that_are_missing_stay_missing(feed: BlockFeed) -> None:
    feed.add(np.zeros((3, 2)), first_sample=0)
    events = feed.add(np.zeros((3, 2)), first_sample=7)
    assert [one.kind for one in events] == ["cannot judge", "judges again"]
    assert feed.detector.rows == 10


def test_an_alarm_is_not_dated_by_rows_that_come_later(feed: BlockFeed) -> None:
    volts = np.zeros((10, 2))
    volts[:, 0] = np.arange(1, 11)
    found = [one.sample for one in feed.add(volts, first_sample=0)]
    assert found[0] == 0, "the largest of the whole recording is the last"


def test_a_detector_of_this_project_gets_the_whole_recording() -> None:
    volts = 1e-4 * np.random.default_rng(1).standard_normal((700, 2))
    whole = BlockFeed(chosen_detector("paper-hp"), 1000.0, [CutOff(300, 310)])
    events = [*whole.add(volts, first_sample=0), *whole.finish()]
    assert [one.kind for one in events] == ["cannot judge", "judges again"]
    alone = chosen_detector("paper-hp").make(1000.0)
    alone.notice(CutOff(300, 310))
    assert events == [*alone.add(volts), *alone.finish()]
