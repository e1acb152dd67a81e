"""The simulated axis: whatever is asked of it, it moves as something with a mass does."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.simulated.world.axis import (
    AxisCommand,
    AxisEvent,
    Mechanics,
    SimulatedAxis,
    stopping_distance,
)

MECHANICS = Mechanics(start_mm=10.0, low_switch_mm=-1000.0, high_switch_mm=1000.0)
RATES = st.floats(200.0, 5000.0)
"""From 200 mm/s the slowest stops within 100 mm: it never meets a limit switch by overshooting."""
COMMANDS = st.builds(AxisCommand, st.floats(-50.0, 50.0), st.floats(10.0, 200.0), RATES, RATES)
SCRIPTS = st.lists(st.tuples(COMMANDS, st.integers(1, 200_000)), min_size=1, max_size=5)
SOON_us = 10_000_000


def free(position_mm: float, t_us: int) -> float:
    return 0.0


def axis(load: object = free, **mechanics: float) -> SimulatedAxis:
    return SimulatedAxis(Mechanics(**{"start_mm": 10.0, **mechanics}), load)  # type: ignore[arg-type]


def go(target_mm: float, speed_mm_s: float = 50.0, rate_mm_s2: float = 500.0) -> AxisCommand:
    return AxisCommand(target_mm, speed_mm_s, rate_mm_s2, rate_mm_s2)


def wall(at_mm: float, stiffness_N_mm: float = 100.0) -> object:
    """Something elastic that pushes back beyond a position."""
    return lambda position_mm, t_us: -stiffness_N_mm * max(0.0, position_mm - at_mm)


@settings(max_examples=20, deadline=None)
@given(SCRIPTS)
def test_no_speed_or_acceleration_is_ever_exceeded_and_nothing_jumps(
    script: list[tuple[AxisCommand, int]],
) -> None:
    moved, now = SimulatedAxis(MECHANICS, free), 0
    fastest = 0.0
    for command, for_us in script:
        before = moved.position(now), moved.velocity(now)
        moved.move(now, command)
        after = moved.position(now), moved.velocity(now)
        assert after == pytest.approx(before, abs=1e-9), "a new target changes nothing at once"
        fastest = max(abs(before[1]), command.speed_mm_s)
        rate = max(command.acceleration_mm_s2, command.deceleration_mm_s2)
        last_t, (last_x, last_v) = now, after
        for part in range(1, 11):
            t = now + for_us * part // 10
            if t == last_t:
                continue
            x, v, dt = moved.position(t), moved.velocity(t), (t - last_t) * 1e-6
            assert abs(v) <= fastest * (1 + 1e-9) + 1e-9
            assert abs(moved.acceleration(t)) <= rate * (1 + 1e-9)
            assert abs(v - last_v) <= rate * dt + 1e-7
            assert abs(x - last_x) <= fastest * dt + 1e-7
            last_t, last_x, last_v = t, x, v
        now += for_us


@settings(max_examples=20, deadline=None)
@given(SCRIPTS)
def test_the_last_target_is_reached_exactly_whatever_came_before(
    script: list[tuple[AxisCommand, int]],
) -> None:
    moved, now = SimulatedAxis(MECHANICS, free), 0
    for command, for_us in script:
        moved.move(now, command)
        now += for_us
    target = script[-1][0].target_mm
    end = now + 60_000_000
    assert moved.finished(end)
    assert moved.position(end) == target
    assert moved.velocity(end) == 0


@settings(max_examples=20, deadline=None)
@given(COMMANDS, st.integers(0, 3_000_000), RATES)
def test_a_stop_takes_v_squared_over_2a_and_not_more(
    command: AxisCommand, after_us: int, deceleration: float
) -> None:
    moved = SimulatedAxis(MECHANICS, free)
    moved.move(0, command)
    position, velocity = moved.position(after_us), moved.velocity(after_us)
    moved.stop(after_us, deceleration)
    end = after_us + math.ceil(abs(velocity) / deceleration * 1e6) + 1
    assert moved.finished(end)
    expected = position + stopping_distance(velocity, deceleration)
    assert moved.position(end) == pytest.approx(expected, abs=1e-9)


@settings(max_examples=15, deadline=None)
@given(SCRIPTS, st.lists(st.integers(0, 2_000_000), min_size=1, max_size=20))
def test_the_past_does_not_depend_on_when_it_was_asked_for(
    script: list[tuple[AxisCommand, int]], asked: list[int]
) -> None:
    def run(meanwhile: bool) -> SimulatedAxis:
        moved, now = axis(wall(20.0)), 0
        for command, for_us in script:
            moved.move(now, command)
            now += for_us
            if meanwhile:
                for t in sorted(asked):
                    moved.position(min(t, now))
        moved.settle(now)
        return moved

    curious, blind = run(True), run(False)
    last = sum(for_us for _, for_us in script)
    for t in asked:
        assert curious.position(min(t, last)) == blind.position(min(t, last))
    assert curious.happenings(last) == blind.happenings(last)


def test_many_positions_at_once_are_those_asked_for_one_by_one() -> None:
    """To the bit: what is computed from them must not depend on how many were asked for."""
    moved = axis(wall(20.0))
    moved.force_limit_N = 50.0
    for begin, command in ((0, go(18.0, 30.0)), (150_000, go(40.0, 2.0)), (2_000_500, go(5.0))):
        moved.move(begin, command)
    times = np.arange(0, 4_000_000, 730)
    assert (moved.positions(times) == [moved.position(int(t)) for t in times]).all()
    assert (moved.positions(times[700:]) == moved.positions(times)[700:]).all()
    assert moved.positions(times[:0]).size == 0


def test_the_highest_position_of_any_stretch_of_time_is_known_without_looking_at_all() -> None:
    """Of a motion that comes back and one that is called back before it has come to rest."""
    moved = axis()
    for at_ms, target_mm in ((0, 12.0), (300, 10.0), (500, 11.5), (520, 9.0)):
        moved.settle(1000 * at_ms)
        moved.move(1000 * at_ms, AxisCommand(target_mm, 10.0, 200.0, 200.0))
    times = np.arange(0, 1_200_001, 100)
    positions = moved.positions(times)
    rng = np.random.default_rng(6)
    for first, last in np.sort(rng.integers(0, times.size, (200, 2)), axis=1):
        highest = moved.highest_mm(int(times[first]), int(times[last]))
        seen = positions[first : last + 1].max()
        assert seen - 1e-12 <= highest <= seen + 1e-6


def test_a_trapezoid_takes_its_time() -> None:
    moved = axis()
    moved.move(0, go(60.0))  # 50 mm: 0.1 s up, 0.9 s at 50 mm/s, 0.1 s down
    assert moved.position(100_000) == pytest.approx(12.5)
    assert moved.velocity(500_000) == pytest.approx(50.0)
    assert not moved.finished(1_099_999)
    assert moved.finished(1_100_001)
    assert moved.position(1_100_001) == 60.0


def test_a_slower_speed_in_motion_brakes_to_it() -> None:
    moved = axis()
    moved.move(0, go(100.0, 50.0))
    moved.move(500_000, go(100.0, 10.0))
    assert moved.velocity(500_000) == pytest.approx(50.0)
    assert moved.velocity(600_000) == pytest.approx(10.0)


def test_turning_back_in_motion_stops_first() -> None:
    moved = axis()
    moved.move(0, go(60.0))
    moved.move(500_000, go(0.0))
    furthest = max(moved.position(500_000 + 1000 * k) for k in range(200))
    assert furthest == pytest.approx(10 + 50 * 0.45 + 2.5 + 50**2 / 1000 - 2.5, abs=0.01)
    assert moved.position(SOON_us) == 0.0


@pytest.mark.parametrize("speed", [0.0, -1.0, math.nan])
def test_a_speed_of_nothing_is_refused(speed: float) -> None:
    with pytest.raises(ValueError, match="cannot move at"):
        axis().move(0, go(1.0, speed))


@pytest.mark.parametrize(
    ("target", "event", "switch"),
    [(-50.0, AxisEvent.LOW_SWITCH, -5.0), (200.0, AxisEvent.HIGH_SWITCH, 105.0)],
)
def test_a_limit_switch_stops_the_axis_hard(target: float, event: AxisEvent, switch: float) -> None:
    moved = axis()
    moved.move(0, go(target))
    (met,) = moved.happenings(SOON_us)
    assert met.event is event
    assert abs(met.position_mm - switch) <= 50.0 * 1e-3 + 1e-9, "found within a cycle"
    rest = moved.position(SOON_us)
    quick = MECHANICS.quick_deceleration_mm_s2
    assert abs(rest - switch) <= 50.0 * 1e-3 + stopping_distance(50.0, quick) + 1e-9
    moved.move(SOON_us, go(10.0))
    assert moved.position(2 * SOON_us) == 10.0, "the way back is free"


def test_a_load_beyond_the_force_limit_holds_the_axis_until_it_lags_too_far() -> None:
    moved = axis(wall(20.0))
    moved.force_limit_N = 50.0
    moved.move(0, go(40.0, 10.0))
    (met,) = moved.happenings(SOON_us)
    assert met.event is AxisEvent.FOLLOWING_ERROR
    assert 20.5 < met.position_mm <= 20.5 + 0.01, "50 N at 100 N/mm, found within a cycle"
    assert moved.position(SOON_us) == met.position_mm
    assert moved.following_error(SOON_us) == 0


def test_travel_to_a_fixed_stop_ends_there_and_lets_go() -> None:
    moved = axis(wall(20.0))
    moved.force_limit_N, moved.seeks_fixed_stop = 30.0, True
    moved.move(0, go(40.0, 10.0))
    (met,) = moved.happenings(SOON_us)
    assert met.event is AxisEvent.FIXED_STOP
    assert 20.3 < met.position_mm <= 20.31
    moved.move(SOON_us, go(5.0))
    assert moved.position(2 * SOON_us) == 5.0


def test_an_axis_that_is_held_follows_again_when_its_setpoint_comes_back() -> None:
    moved = axis(wall(20.0))
    moved.force_limit_N = 50.0
    moved.move(0, go(40.0, 2.0))
    t = 5_300_000
    lag = moved.following_error(t)
    assert 0 < lag < 0.5
    held = moved.position(t)
    moved.move(t, go(15.0, 2.0))
    positions = [moved.position(t + 1000 * k) for k in range(4000)]
    assert positions[0] == held
    assert positions[-1] == 15.0
    steps = [abs(b - a) for a, b in itertools.pairwise(positions)]
    assert max(steps) <= 2.0 * 1e-3 + 1e-9, "no jump when it is let go"
    assert not moved.happenings(SOON_us)


def test_a_stop_while_held_brings_the_setpoint_back() -> None:
    moved = axis(wall(20.0))
    moved.force_limit_N = 50.0
    moved.move(0, go(40.0, 2.0))
    moved.stop(5_300_000, 100.0)
    assert moved.following_error(5_300_000) == 0
    assert moved.finished(5_300_000)


def test_a_jammed_axis_does_not_move_at_all() -> None:
    moved = axis()
    moved.jammed = True
    moved.move(0, go(40.0))
    (met,) = moved.happenings(SOON_us)
    assert met.event is AxisEvent.FOLLOWING_ERROR
    assert moved.position(SOON_us) == pytest.approx(10.0, abs=1e-3)


@pytest.mark.parametrize("surge_mm_s", [0.5, 10.0, 80.0])
def test_what_another_axis_does_to_the_load_is_never_felt_too_late(surge_mm_s: float) -> None:
    """Both press on one spring: as if it were asked for in every cycle, also where the other axis,
    slow so far, comes fast."""

    def pair(known: bool) -> tuple[SimulatedAxis, SimulatedAxis]:
        def load(_: float, t_us: int) -> float:
            return -150.0 * max(0.0, z.position(t_us) + x.position(t_us) - 20.05)

        z, x = axis(load), axis(load)
        if known:
            z.stiffest_load_N_mm = x.stiffest_load_N_mm = 150.0
            z.other_axis, x.other_axis = x, z
        z.force_limit_N, x.force_limit_N = 40.0, 90.0
        z.move(0, go(10.2, 0.5))
        x.move(0, go(10.1, 1.0))
        for now in range(0, 300_001, 10_000):
            if now == 200_000:
                x.move(now, go(11.0, surge_mm_s))
            for moved in (z, x):
                moved.settle(now)
        return z, x

    for seldom, always in zip(pair(True), pair(False), strict=True):
        instants = range(0, 300_001, 7_000)
        assert [seldom.position(t) for t in instants] == [always.position(t) for t in instants]
        assert seldom.happenings(300_000) == always.happenings(300_000)


def test_a_load_may_ask_where_the_axis_is() -> None:
    """Two axes that move the same thing ask for each other's positions."""
    moved: SimulatedAxis

    def load(position_mm: float, t_us: int) -> float:
        return -moved.position(t_us)

    moved = axis(load)
    moved.move(0, go(20.0))
    assert moved.position(SOON_us) == 20.0


@pytest.mark.parametrize("speed_mm_s", [0.5, 5.0, 50.0])
def test_a_force_far_below_the_limit_is_seldom_asked_for_and_never_too_late(
    speed_mm_s: float,
) -> None:
    """As if it were asked for in every cycle, against the stiffest load that was announced."""
    asked: list[int] = []

    def stiff(position_mm: float, t_us: int) -> float:
        asked.append(t_us)
        return -300.0 * max(0.0, position_mm - 10.05)

    seldom, always = axis(stiff), axis(wall(10.05, 300.0))
    seldom.stiffest_load_N_mm = 300.0
    for moved in (seldom, always):
        moved.move(0, go(30.0, speed_mm_s))
    instants = range(0, SOON_us, 7_000)
    assert [seldom.position(t) for t in instants] == [always.position(t) for t in instants]
    assert [h.t_us for h in seldom.happenings(SOON_us)] == [
        h.t_us for h in always.happenings(SOON_us)
    ]
    stopped_us = next(
        t for t in range(0, SOON_us, 1000) if seldom.position(t) == seldom.position(SOON_us)
    )
    assert len(asked) < 0.7 * stopped_us / 1000
