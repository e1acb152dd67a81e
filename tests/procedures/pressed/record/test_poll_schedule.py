"""Which ticks of a trial poll the stages."""

from __future__ import annotations

from collections.abc import Iterable

import pytest

from procedures.pressed.record.recorder import PollSchedule
from rig.control.tick_loop import Tick


def due(schedule: PollSchedule, numbers: Iterable[int]) -> list[int]:
    """Those of these ticks that poll."""
    return [number for number in numbers if schedule.is_due(Tick(number, 0.0, 0.0))]


@pytest.mark.parametrize(
    ("tick_Hz", "ticks"), [(500.0, [0, 5, 10]), (100.0, list(range(12))), (40.0, list(range(12)))]
)
def test_the_stages_are_polled_at_most_so_often(tick_Hz: float, ticks: list[int]) -> None:
    schedule = PollSchedule(100.0)
    schedule.begin_loop(tick_Hz)
    assert due(schedule, range(12)) == ticks
    assert schedule.interval_s == pytest.approx(max(1 / tick_Hz, 0.01))


def test_missed_ticks_postpone_a_poll_and_drop_none() -> None:
    schedule = PollSchedule(100.0)
    schedule.begin_loop(500.0)
    assert due(schedule, [0, 1, 7, 8, 9, 10, 21, 22]) == [0, 7, 10, 21]
    assert [n for n in range(12) if schedule.is_last(Tick(n, 0.0, 0.0))] == [4, 9]


def test_every_loop_begins_with_a_poll() -> None:
    schedule = PollSchedule(100.0)
    for _ in range(2):
        schedule.begin_loop(500.0)
        assert due(schedule, range(3)) == [0]
