"""The bound on where an axis can be: what it says of positions, one by one."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from drivers.shared.stage import MotionWatch, TravelBound

DOWN = MotionWatch.towards(12.0, 5.0, speed=20.0, overtravel=0.1, longest_s=60.0, begun_at_s=0.0)


def bound(resolution: float = 0.001) -> TravelBound:
    return TravelBound("mm", highest_speed=20.0, low=0.0, high=14.0, resolution=resolution)


def at(speed: float, longest_s: float = 60.0) -> MotionWatch:
    """A motion at this speed."""
    return replace(DOWN, speed=speed, longest_s=longest_s)


def stands_s(motion: MotionWatch, resolution: float = 0.001) -> float:
    """How long an axis that does not move is let stand, asked every 10 ms."""
    one = bound(resolution)
    for n in range(10_000):
        if one.judge(6.0, 0.01 * n, 0.01 * n, motion) is not None:
            return 0.01 * n
    return math.inf


def said(*positions: tuple[float, float], motion: MotionWatch | None = DOWN) -> str | None:
    """What is said of the last of these positions, each with the time of its question; an answer
    takes 1 ms."""
    one = bound()
    words = [one.judge(mm, at_s, at_s + 0.001, motion) for mm, at_s in positions]
    assert words[:-1] == [None] * (len(words) - 1)
    return words[-1]


def test_a_motion_at_its_highest_speed_is_let_through() -> None:
    assert said(*((5.0 + 20.0 * 0.01 * n, 0.01 * n) for n in range(30))) is None


@pytest.mark.parametrize("to_mm", [5.4, 4.6])
def test_a_position_that_cannot_have_been_reached_is_named(to_mm: float) -> None:
    words = said((5.0, 0.0), (to_mm, 0.009))
    assert words is not None
    assert f"reads {to_mm:g} mm, 10 ms after 5 mm" in words
    assert "highest speed of 20 mm/s it cannot have gone farther than 0.3 mm" in words


def test_an_axis_past_its_target_is_named() -> None:
    assert said((11.9, 0.0), (12.2, 0.1)) == (
        "ran past its target: it is at 12.2 mm on the way to 12 mm"
    )


def test_an_axis_that_leaves_its_limits_is_named() -> None:
    up = MotionWatch.towards(0.0, 5.0, speed=20.0, overtravel=5.0, longest_s=2.0, begun_at_s=0.0)
    words = said((0.1, 0.0), (-0.2, 0.1), motion=up)
    assert words == "has left its limits of 0 to 14 mm: it is at -0.2 mm"


def test_an_axis_that_stands_before_its_target_is_named_after_a_while() -> None:
    words = said(*((6.0, 0.1 * n) for n in range(10)))
    assert words == (
        "does not do what its drive acknowledges: it has stood at 6 mm for 0.9 s on the way to "
        "12 mm: its torque limit holds it, or something in the way, or its encoder stands still"
    )
    assert said(*((12.0 - 0.005, 0.1 * n) for n in range(30))) is None, "it has arrived"


@pytest.mark.parametrize(
    ("resolution", "speed"),
    [(0.01, 0.01), (0.01, 0.001), (0.001, 0.001), (0.0005, 0.0005), (0.00016, 0.0003)],
)
def test_a_slow_axis_whose_steps_are_far_apart_is_let_through(
    resolution: float, speed: float
) -> None:
    """Each step takes a second or more; the target is sent again in every tick."""
    one = bound(resolution)
    for n in range(3000):
        seen = 5.0 + math.floor(speed * 0.01 * n / resolution) * resolution
        assert one.judge(seen, 0.01 * n, 0.01 * n, at(speed)) is None
    stuck_s = stands_s(at(speed), resolution)
    assert stuck_s == pytest.approx(3 * max(resolution, 0.0005) / speed, abs=0.02)


@pytest.mark.parametrize(
    ("motion", "found_s"),
    [
        (at(20.0), 0.8),
        (at(0.1), 0.8),
        (at(0.0), 0.8),
        (at(math.nan), 0.8),
        (at(1e-9), 60.0),
        (at(1e-9, longest_s=2.0), 2.0),
        (at(0.001, longest_s=0.1), 0.8),
    ],
)
def test_an_axis_that_stands_is_found_in_bounded_time(motion: MotionWatch, found_s: float) -> None:
    """However slow its motion is, and where its speed is not known."""
    assert stands_s(motion) == pytest.approx(found_s, abs=0.02)


def test_a_slow_axis_that_is_made_fast_has_the_time_to_begin() -> None:
    """What it has stood while it was slow counts as little as it should: a sound axis shows a step
    in a third of the time, so that more than half a second is left."""
    one = bound()
    assert one.judge(6.0, 0.0, 0.0, at(0.001)) is None
    for n in range(1, 16):
        now_s = 0.1 * n
        assert one.judge(6.0, now_s, now_s, at(0.001 if n <= 10 else 5.0)) is None
    assert one.judge(6.0, 1.6, 1.6, at(5.0)) is not None


def test_a_servo_that_slows_down_for_a_tick_does_not_hide_an_axis_that_stands() -> None:
    one, speeds = bound(), [1.0, 0.001] * 100
    words = [one.judge(6.0, 0.01 * n, 0.01 * n, at(v)) for n, v in enumerate(speeds)]
    first = next(n for n, said in enumerate(words) if said is not None)
    assert 0.01 * first < 1.6, "half of the time counts"


def test_an_axis_with_coarse_steps_may_stand_at_the_step_before_its_target() -> None:
    one = bound(resolution=0.01)
    positions = [one.judge(11.99, 0.1 * n, 0.1 * n, DOWN) for n in range(30)]
    assert positions == [None] * 30


def test_nothing_is_said_of_an_axis_without_a_motion_or_after_its_reference_has_changed() -> None:
    assert said((5.0, 0.0), (9.0, 0.01), motion=None) is None
    one = bound()
    assert one.judge(5.0, 0.0, 0.001, DOWN) is None
    one.forget()
    assert one.judge(9.0, 0.01, 0.011, DOWN) is None


@pytest.mark.parametrize(
    ("answers", "kept", "misreadings"),
    [((5.02,), 5.02, 0), ((117.3, 5.02), 5.02, 1), ((8.0, 8.0), 8.0, 0)],
    ids=["possible", "one flipped bit", "confirmed"],
)
def test_a_position_that_cannot_be_is_asked_for_again_and_counted_where_it_was_wrong(
    answers: tuple[float, ...], kept: float, misreadings: int
) -> None:
    one, left = bound(), list(answers)
    assert one.judge(5.0, 0.0, 0.001, DOWN) is None
    found = one.settled(lambda: left.pop(0), lambda mm: mm, lambda: 0.01, DOWN)
    assert (found, left, one.misreadings) == (kept, [], misreadings)
    wrong = one.judge(found, 0.009, 0.01, DOWN)
    assert (wrong is None) is (kept == 5.02), "what is confirmed is judged"
