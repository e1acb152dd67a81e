"""When a batch may use the bench, in local time by the rules of the zone."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rig.batch.execute import batch_clock
from rig.batch.execute.batch_clock import (
    PASSED_S,
    WallBatchClock,
    clock_of,
    renew_window,
    window_of,
)
from rig.batch.execute.between_runs import BetweenRuns
from rig.batch.folder import BatchFolder
from rig.batch.plan.conditions import BatchPlan
from rig.batch.plan.settings import BatchFile, BatchSettings
from rig.batch.plan.window import does_not_fit, fault_of, how_to_continue, window
from rig.batch.queue import Queue
from rig.batch.queue_records import TIME_OVER
from rig.run.stopping import StopFlag

TEN = datetime(2026, 11, 21, 22, 0, tzinfo=timezone(timedelta(hours=1)))


@pytest.fixture(autouse=True)
def zurich(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """This process is in a zone that has summer time."""
    monkeypatch.setenv("TZ", "Europe/Zurich")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


def batch(**given: Any) -> BatchSettings:
    return BatchSettings.model_validate({"name": "night", **given})


def test_a_time_of_the_day_is_the_next_one_and_the_end_comes_after_the_beginning() -> None:
    night = batch(not_before="23:30:00", stop_by="07:00:00")
    first, last = window(night, TEN)
    assert first == TEN.replace(hour=23, minute=30)
    assert last == datetime(2026, 11, 22, 7, 0, tzinfo=TEN.tzinfo)
    after_midnight, _ = window(night, TEN + timedelta(hours=2))
    assert after_midnight == TEN.replace(hour=23, minute=30) + timedelta(days=1)


@pytest.mark.parametrize(
    ("given", "utc_hour"),
    [("2026-11-22T20:00:00", 19), ("2026-07-22T20:00:00", 18), ("2026-07-22T20:00:00-05:00", 25)],
)
def test_a_date_is_local_time_of_its_day_unless_it_has_an_offset(given: str, utc_hour: int) -> None:
    first, last = window(batch(not_before=given), TEN)
    day = datetime.fromisoformat(given[:10]).replace(tzinfo=UTC)
    assert first == day + timedelta(hours=utc_hour)
    assert last is None


@pytest.mark.parametrize(
    ("begun", "hours", "utc_hour"),
    [
        ("2026-03-28T22:00:00+01:00", 8, 5),  # one hour is left out in this night
        ("2026-10-24T22:00:00+02:00", 10, 6),  # one comes twice
        ("2026-10-25T22:00:00+01:00", 9, 6),
    ],
)
def test_seven_in_the_morning_is_seven_on_the_clock_after_a_change_of_summer_time(
    begun: str, hours: int, utc_hour: int
) -> None:
    evening = datetime.fromisoformat(begun)
    _, last = window(batch(stop_by="07:00:00"), evening)
    assert last == evening + timedelta(hours=hours)
    assert last.astimezone(UTC).hour == utc_hour
    assert f"{last.astimezone():%H:%M}" == "07:00"


def test_of_a_time_that_the_clock_leaves_out_or_shows_twice_the_earlier_instant_counts() -> None:
    evening = datetime.fromisoformat("2026-03-28T22:00:00+01:00")
    _, left_out = window(batch(stop_by="02:30:00"), evening)
    assert left_out == datetime(2026, 3, 29, 0, 30, tzinfo=UTC), "an hour earlier, 01:30"
    evening = datetime.fromisoformat("2026-10-24T22:00:00+02:00")
    _, twice = window(batch(stop_by="02:30:00"), evening)
    assert twice == datetime(2026, 10, 25, 0, 30, tzinfo=UTC), "the first of the two"


def test_a_run_begins_only_if_it_would_be_over_with_two_standard_deviations_to_spare() -> None:
    until = TEN + timedelta(seconds=100)
    assert not does_not_fit(TEN, until, 80.0, 10.0)
    assert "stop_by is 22:01:40" in does_not_fit(TEN, until, 80.0, 10.1)
    assert not does_not_fit(TEN, None, 1e9, 0.0)


def test_a_batch_with_a_date_to_begin_at_gets_the_next_morning_when_it_is_resumed_later() -> None:
    _, last = window(batch(not_before="2026-11-14T22:00:00", stop_by="07:00:00"), TEN)
    assert last == TEN + timedelta(hours=9)


def test_a_run_that_would_end_on_another_day_than_stop_by_is_refused_with_both_days() -> None:
    why = does_not_fit(TEN, TEN - timedelta(days=7), 80.0, 0.0)
    assert why == (
        "the next run would last until 2026-11-21 22:01:20, stop_by is 2026-11-14 22:00:00"
    )


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"stop_by": "2026-11-14T07:00:00"}, "has passed: it is 2026-11-21 22:00:00"),
        (
            {"not_before": "2026-11-22T22:00:00", "stop_by": "2026-11-22T07:00:00"},
            "is not after not_before, 2026-11-22 22:00:00",
        ),
        ({"not_before": "23:00:00", "stop_by": "2026-11-21T22:30:00"}, "is not after not_before"),
        ({"not_before": "23:00:00", "stop_by": "2026-11-22T07:00:00"}, ""),
        ({"not_before": "22:00:00", "stop_by": "22:00:00"}, ""),
        ({}, ""),
    ],
)
def test_a_stop_by_that_leaves_no_time_is_found_before_the_night_is_waited_for(
    given: dict[str, str], words: str
) -> None:
    found = fault_of(batch(**given), TEN)
    assert words in found
    assert bool(found) == bool(words)


def test_a_batch_whose_date_has_passed_is_not_sent_to_a_resume_that_cannot_help() -> None:
    assert how_to_continue(batch(stop_by="07:00:00")) == "continue with rig batch resume"
    assert "begin a new batch" in how_to_continue(batch(stop_by="2026-11-14T07:00:00"))


def queue_of(folder: Path, begun: datetime, bench: str, **given: Any) -> Queue:
    """An empty queue of a batch that was begun then."""
    file = BatchFile.model_validate(
        {"batch": {"name": "night", **given}, "experiment": [{"procedure": "sweep"}]}
    )
    meta = {"file": file.model_dump_json(), "begun": begun.isoformat(), "bench": bench}
    return Queue.create(folder / "queue.sqlite", BatchPlan({}, ()), {}, meta)


@pytest.mark.parametrize(
    ("jump_s", "waited_s"), [(-3600.0, 4200.0), (300.0, 300.0), (3600.0, 100.0)]
)
def test_a_clock_that_is_set_while_the_batch_waits_moves_its_beginning_with_it(
    jump_s: float, waited_s: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Set back by an hour: nothing begins an hour too early, with people still at the bench."""
    passed_s = 0.0

    class SetClock(WallBatchClock):
        def now(self) -> datetime:
            return TEN + timedelta(seconds=passed_s + (jump_s if passed_s >= 100.0 else 0.0))

    def sleep(seconds: float) -> None:
        nonlocal passed_s
        passed_s += max(seconds, 0.1)

    monkeypatch.setattr(batch_clock, "sleep", sleep)
    monkeypatch.setattr(batch_clock, "monotonic", lambda: passed_s)
    commands: Any = SimpleNamespace(
        heard_s=math.inf, stop_after_run=False, paused=threading.Event()
    )
    benches: Any = SimpleNamespace(lasting=None)
    with queue_of(tmp_path, TEN, "bench.toml", not_before="22:10:00") as queue:
        BetweenRuns(
            *(BatchFolder(tmp_path), queue, "wait", SetClock(), benches, StopFlag(), commands),
            send=lambda *_, **__: None,
        ).wait_for_the_window()
    assert passed_s == pytest.approx(waited_s, abs=0.5)


def test_a_batch_that_is_resumed_in_its_night_keeps_its_window_and_later_gets_the_next(
    tmp_path: Path,
) -> None:
    night = {"not_before": "22:00:00", "stop_by": "07:00:00"}
    with queue_of(tmp_path, TEN - timedelta(hours=4), "", **night) as queue:
        before = window_of(queue)
        queue.set_meta(PASSED_S, str(8 * 3600))
        renew_window(queue)
        assert window_of(queue) == before, "02:00, the bench may be used"
        queue.set_meta(TIME_OVER, "yes")
        renew_window(queue)
        later = window_of(queue)
        assert clock_of(queue).now() == before[1], "virtual time stood still in the day"
        assert [end - start for start, end in zip(before, later, strict=True) if start and end] == [
            timedelta(days=1)
        ] * 2


def test_a_date_stays_the_end_of_a_batch_that_is_resumed_after_it(tmp_path: Path) -> None:
    with queue_of(tmp_path, TEN, "bench.toml", stop_by="2026-11-22T07:00:00") as queue:
        renew_window(queue)
        assert window_of(queue)[1] == TEN + timedelta(hours=9)
