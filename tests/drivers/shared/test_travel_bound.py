"""The bound on where an axis can be: what it says of positions, one by one."""

from __future__ import annotations

import pytest

from drivers.shared.stage import MotionWatch, TravelBound

DOWN = MotionWatch.towards(12.0, 5.0, overtravel=0.1, longest_s=2.0, begun_at_s=0.0)


def bound() -> TravelBound:
    return TravelBound("mm", highest_speed=20.0, low=0.0, high=14.0)


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
    up = MotionWatch.towards(0.0, 5.0, overtravel=5.0, longest_s=2.0, begun_at_s=0.0)
    words = said((0.1, 0.0), (-0.2, 0.1), motion=up)
    assert words == "has left its limits of 0 to 14 mm: it is at -0.2 mm"


def test_an_axis_that_stands_before_its_target_is_named_after_a_while() -> None:
    words = said(*((6.0, 0.1 * n) for n in range(10)))
    assert words == (
        "does not do what its drive acknowledges: it has stood at 6 mm for 0.9 s on the way to "
        "12 mm: its torque limit holds it, or something in the way, or its encoder stands still"
    )
    assert said(*((12.0 - 0.005, 0.1 * n) for n in range(30))) is None, "it has arrived"


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
