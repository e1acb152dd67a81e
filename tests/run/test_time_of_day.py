"""A computer's clock that is set while a run is under way."""

from __future__ import annotations

import time
from datetime import datetime, timedelta

import pytest

from rig.core.clock import suspended_s
from rig.run.time_of_day import TimeOfDay


def test_a_clock_that_is_set_back_is_noticed_once_and_time_continues(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    real = time.time
    now = TimeOfDay()
    before = now.now_iso()
    assert now.jump_s() == 0.0
    monkeypatch.setattr(time, "time", lambda: real() - 3600)
    assert now.jump_s() == pytest.approx(-3600, abs=0.5)
    assert now.jump_s() == 0.0
    after = now.now_iso()
    passed = datetime.fromisoformat(after) - datetime.fromisoformat(before)
    assert timedelta() <= passed < timedelta(seconds=60)


def test_a_suspended_computer_is_noticed_once_and_is_not_taken_for_a_clock_that_was_set(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    real, asleep_s = time.time, suspended_s()
    now = TimeOfDay()
    before = now.now_iso()
    assert now.sleep_s() == 0.0
    monkeypatch.setattr(time, "time", lambda: real() + 600)
    monkeypatch.setattr("rig.run.time_of_day.suspended_s", lambda: asleep_s + 600)
    assert now.jump_s() == 0.0
    assert now.sleep_s() == pytest.approx(600, abs=0.5)
    assert now.sleep_s() == 0.0
    passed = datetime.fromisoformat(now.now_iso()) - datetime.fromisoformat(before)
    assert timedelta(seconds=600) <= passed < timedelta(seconds=660)


def test_a_run_that_is_resumed_with_a_clock_set_back_begins_after_its_latest_time() -> None:
    later = datetime.now().astimezone() + timedelta(hours=1)
    assert datetime.fromisoformat(TimeOfDay(later).now_iso()) >= later - timedelta(milliseconds=1)
    earlier = later - timedelta(hours=2)
    assert datetime.fromisoformat(TimeOfDay(earlier).now_iso()) < later
