"""The tick loop keeps its grid, counts what was late, and lets everything else end it."""

from __future__ import annotations

import threading
import time

import pytest
from hand_clock import HandClock

from rig.control.tick_loop import BEHIND_FOR_S, Tick, TooSlowError, tick_loop
from rig.core.clock import WAIT_SLICE_S, Clock, WallClock
from rig.core.errors import ExitCode


class HandRun:
    """The part of a run that the loop uses."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.stopped_at: int | None = None
        self.looked = 0

    def check_stop(self) -> None:
        self.clock.sleep(0)

    def check_watchers(self) -> None:
        self.looked += 1
        if self.looked == self.stopped_at:
            raise RuntimeError("trip")


@pytest.fixture
def run() -> HandRun:
    clock = HandClock()
    clock.spend(3.7)
    return HandRun(clock)


def test_ticks_lie_on_the_grid_from_the_first_on(run: HandRun) -> None:
    ticks: list[Tick] = []

    def on_tick(tick: Tick) -> bool:
        ticks.append(tick)
        return True

    statistics = tick_loop(run, 100.0, 0.5, on_tick)
    assert [tick.number for tick in ticks] == list(range(50))
    assert [tick.due_s for tick in ticks] == pytest.approx([3.7 + k / 100 for k in range(50)])
    assert (statistics.ticks, statistics.late) == (50, 0)
    assert run.looked == 50


def test_work_within_a_period_and_late_wake_ups_do_not_add_up(run: HandRun) -> None:
    """A third of a thousandth a tick would be 0.3 s after a thousand ticks if it drifted."""
    run.clock.woken_late_s = 3e-4

    def on_tick(tick: Tick) -> bool:
        run.clock.spend(7e-3)
        return True

    statistics = tick_loop(run, 100.0, 10.0, on_tick)
    assert run.clock.now() == pytest.approx(3.7 + 9.99 + 3e-4 + 7e-3)
    assert statistics.largest_lateness_s == pytest.approx(3e-4)
    assert statistics.late == 0


def test_of_what_fell_due_while_a_tick_overran_the_latest_is_taken(run: HandRun) -> None:
    began: list[tuple[int, int, float]] = []

    def on_tick(tick: Tick) -> bool:
        began.append((tick.number, tick.missed, round(tick.began_s - 3.7, 6)))
        run.clock.spend(0.026 if tick.number == 2 else 0.001)
        return True

    statistics = tick_loop(run, 100.0, 0.08, on_tick)
    assert began == [
        (0, 0, 0.0),
        (1, 0, 0.01),
        (2, 0, 0.02),
        (4, 1, 0.046),
        (5, 0, 0.05),
        (6, 0, 0.06),
        (7, 0, 0.07),
    ]
    assert (statistics.ticks, statistics.missed) == (8, 1)
    assert statistics.late == 2  # 16 ms until the other was taken, and 6 ms
    assert statistics.largest_lateness_s == pytest.approx(0.016)


def test_the_first_tick_and_the_last_are_never_left_out(run: HandRun) -> None:
    """What begins a motion and what ends it stands in one of them."""
    done: list[int] = []
    run.check_watchers = lambda: run.clock.spend(0.0 if done else 0.035)

    def on_tick(tick: Tick) -> bool:
        done.append(tick.number)
        run.clock.spend(0.001 if tick.number < 5 else 0.5)
        return True

    statistics = tick_loop(run, 100.0, 0.1, on_tick)
    assert done == [0, 3, 4, 5, 9]
    assert (statistics.ticks, statistics.missed) == (10, 5)


def test_a_tick_may_end_the_loop(run: HandRun) -> None:
    statistics = tick_loop(run, 100.0, 1.0, lambda tick: tick.number < 4)
    assert statistics.ticks == 5


def test_a_watcher_ends_it_before_the_tick(run: HandRun) -> None:
    run.stopped_at = 4
    done: list[int] = []
    with pytest.raises(RuntimeError, match="trip"):
        tick_loop(run, 100.0, 1.0, lambda tick: done.append(tick.number) is None)
    assert done == [0, 1, 2]


def test_a_stop_request_is_seen_although_every_tick_overruns(run: HandRun) -> None:
    done: list[int] = []

    def stop() -> None:
        if len(done) == 7:
            raise KeyboardInterrupt

    run.clock.each_slice(stop)

    def on_tick(tick: Tick) -> bool:
        done.append(tick.number)
        run.clock.spend(0.05)
        return True

    with pytest.raises(KeyboardInterrupt):
        tick_loop(run, 100.0, 1.0, on_tick)
    assert len(done) == 7


def test_a_loop_that_is_late_all_the_time_gives_signs_of_life_and_ends_in_one_line(
    run: HandRun,
) -> None:
    lives: list[float] = []
    run.clock.each_slice(lambda: lives.append(run.clock.now()))
    began: list[float] = []

    def on_tick(tick: Tick) -> bool:
        began.append(run.clock.now())
        run.clock.spend(0.024)
        return True

    with pytest.raises(TooSlowError) as raised:
        tick_loop(run, 100.0, 10.0, on_tick)
    assert set(began) <= set(lives)
    second_s = 3.7 + 0.024  # the first that leaves one out
    assert second_s + BEHIND_FOR_S - 0.024 < began[-1] <= second_s + BEHIND_FOR_S
    assert raised.value.message == (
        "the computer or a link to an instrument cannot keep 100 Hz: for 1.0 s at least every "
        "second tick had to be left out, the latest came 22 ms late"
    )
    assert raised.value.code == ExitCode.INSTRUMENT


def test_a_stall_of_the_computer_is_followed_by_a_loop_on_time(run: HandRun) -> None:
    taken: list[Tick] = []

    def on_tick(tick: Tick) -> bool:
        taken.append(tick)
        run.clock.spend(1.5 if tick.number == 3 else 0.003)
        return True

    statistics = tick_loop(run, 100.0, 5.0, on_tick)
    assert statistics.ticks == 500
    assert [tick.number for tick in taken if tick.missed] == [153]
    assert statistics.missed == statistics.late == 149
    assert [tick.late_s for tick in taken[5:]] == pytest.approx([0.0] * (len(taken) - 5))
    assert run.clock.now() == pytest.approx(3.7 + 4.993)


def test_nothing_is_asked_of_a_loop_of_no_duration(run: HandRun) -> None:
    statistics = tick_loop(run, 100.0, 0.0, lambda tick: False)
    assert statistics.ticks == 0


@pytest.mark.parametrize(("rate", "duration"), [(0.0, 1.0), (501.0, 1.0), (100.0, -1.0)])
def test_impossible_loops_are_refused(run: HandRun, rate: float, duration: float) -> None:
    with pytest.raises(ValueError, match="must be"):
        tick_loop(run, rate, duration, lambda tick: True)


def test_in_real_time_every_tick_runs_once_and_none_before_its_time() -> None:
    """Unless the host left it no time: what that does to a tick is nobody's promise."""
    clock = WallClock()
    ticks: list[Tick] = []

    def on_tick(tick: Tick) -> bool:
        ticks.append(tick)
        return True

    statistics = tick_loop(HandRun(clock), 200.0, 0.2, on_tick)
    numbers = [n for tick in ticks for n in range(tick.number - tick.missed, tick.number + 1)]
    assert numbers == list(range(40))
    assert all(tick.began_s >= tick.due_s for tick in ticks)
    began = [tick.began_s for tick in ticks]
    assert began == sorted(began)
    assert statistics.ticks == 40
    assert clock.now() >= 39 / 200


def test_a_stop_request_is_seen_between_ticks_that_are_far_apart() -> None:
    clock = WallClock()
    done, looks = list[int](), list[float]()

    def stop() -> None:
        looks.append(clock.now())
        if len(looks) == 4:
            raise KeyboardInterrupt

    clock.each_slice(stop)
    with pytest.raises(KeyboardInterrupt):
        tick_loop(HandRun(clock), 0.01, 1000.0, lambda tick: done.append(tick.number) is None)
    assert done == [0]


def test_ticks_run_in_the_thread_that_calls_and_one_that_hangs_gives_no_sign_of_life() -> None:
    """In real time: what feeds the drives and the guard must stop where the procedure stops."""
    clock = WallClock()
    lives, during, by = list[float](), list[int](), list[int]()
    clock.each_slice(lambda: lives.append(clock.now()))

    def on_tick(tick: Tick) -> bool:
        by.append(threading.get_ident())
        if len(by) == 3:
            earlier = len(lives)
            time.sleep(5 * WAIT_SLICE_S)
            during.append(len(lives) - earlier)
        return len(by) < 5

    before = threading.active_count()
    tick_loop(HandRun(clock), 200.0, 10.0, on_tick)
    assert by == [threading.get_ident()] * 5
    assert during == [0]
    assert threading.active_count() == before
