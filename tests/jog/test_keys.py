"""What keys ask of an axis: steps within the limits, ended by silence, none after a stop."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.jog.keys import (
    CONFIRM_S,
    LONGEST_STEP_S,
    RETREAT,
    SILENCE_S,
    Action,
    AxisPosition,
    EndSession,
    HomeAxis,
    Jog,
    JogAxis,
    Key,
    MoveAxis,
    ShowMessage,
    StopAxes,
    WatchForce,
)

Z = JogAxis("stage_z", "mm", 0.0, 14.0, 0.1, 1.0, off=Key.LESS)
X = JogAxis("stage_x", "mm", 0.0, 40.0, 0.1, 1.0)
LARGEST_N = 5.0
REPEAT_S = 0.033


def jog(chosen: str = "stage_z") -> Jog:
    return Jog([Z, X], LARGEST_N, chosen)


def at(position: float, homed: bool = True) -> AxisPosition:
    return AxisPosition(position, homed)


def said(actions: list[Action]) -> list[str]:
    return [action.text for action in actions if isinstance(action, ShowMessage)]


def moves(actions: list[Action]) -> list[MoveAxis]:
    return [action for action in actions if isinstance(action, MoveAxis)]


def test_a_press_is_one_step_and_a_held_key_stays_a_step_ahead() -> None:
    person = jog()
    assert person.press(Key.MORE, 0.0, at(5.0)) == [MoveAxis(Z, 5.0, pytest.approx(5.1), True)]
    assert person.press(Key.MORE, 0.3, at(5.1)) == [MoveAxis(Z, 5.1, pytest.approx(5.2), False)]
    assert person.press(Key.MORE, 0.333, at(5.13)) == [
        MoveAxis(Z, 5.13, pytest.approx(5.23), False)
    ]


def test_silence_is_a_release_and_the_next_press_counts() -> None:
    person = jog()
    person.press(Key.LESS, 1.0, at(5.0))
    assert person.poll(1.0 + SILENCE_S - 1e-3, 0.0) == []
    assert person.poll(1.001 + SILENCE_S, 0.0) == [StopAxes(Z, "released")]
    person.stopped(1.21, released=True)
    assert person.poll(9.0, 0.0) == []
    assert moves(person.press(Key.LESS, 1.22, at(4.9)))


@pytest.mark.parametrize("key", [Key.STOP, Key.CONFIRM, Key.NEXT_AXIS, Key.HOME, Key.LEAVE])
def test_every_other_key_stops_everything(key: Key) -> None:
    person = jog()
    person.press(Key.MORE, 0.0, at(5.0))
    first, *further = person.press(key, 0.03, at(5.0))
    assert isinstance(first, StopAxes)
    assert first.axis is None
    assert (EndSession() in further) is (key is Key.LEAVE)


def test_the_other_direction_stops_before_it_moves() -> None:
    person = jog()
    person.press(Key.MORE, 0.0, at(5.0))
    (stop,) = person.press(Key.LESS, 0.03, at(5.0))
    assert isinstance(stop, StopAxes)


def test_a_key_that_is_still_held_after_a_stop_moves_nothing() -> None:
    person = jog()
    person.press(Key.MORE, 0.0, at(5.0))
    person.stopped(0.1)
    times = [0.1 + n * REPEAT_S for n in range(60)]
    assert [person.press(Key.MORE, t, at(5.0)) for t in times] == [[]] * 60
    assert moves(person.press(Key.MORE, times[-1] + SILENCE_S, at(5.0)))


def test_a_limit_clips_the_target_and_is_reported_once() -> None:
    person = jog()
    move, limit = person.press(Key.MORE, 0.0, at(13.95))
    assert isinstance(move, MoveAxis)
    assert move.target == Z.high
    assert said([limit]) == ["limit 14 mm of stage_z reached"]
    assert person.press(Key.MORE, 0.03, at(14.0)) == []
    assert moves(person.press(Key.LESS, 9.0, at(14.0))) == []  # the motion is stopped first
    person.stopped(9.0)
    assert moves(person.press(Key.LESS, 10.0, at(14.0)))


def test_an_axis_outside_its_limits_is_not_sent_farther_than_a_step() -> None:
    (refused,) = jog().press(Key.MORE, 0.0, at(-1.0))
    assert "is at -1 mm, outside 0 to 14 mm" in said([refused])[0]
    (back,) = moves(jog().press(Key.MORE, 0.0, at(-0.05)))
    assert back.target == pytest.approx(0.05)
    assert moves(jog().press(Key.LESS, 0.0, at(-0.05))) == []


def test_an_axis_that_is_not_homed_moves_only_to_its_reference_and_only_when_confirmed() -> None:
    person = jog()
    assert "is not homed" in said(person.press(Key.MORE, 0.0, at(5.0, homed=False)))[0]
    assert "Press y within" in said(person.press(Key.HOME, 1.0, at(5.0, homed=False)))[0]
    person.stopped(1.0)
    assert person.press(Key.CONFIRM, 2.0, at(5.0, homed=False)) == [HomeAxis(Z)]


@pytest.mark.parametrize("between", ["a trip", "a pause"])
def test_homing_that_was_asked_for_before_a_trip_or_a_pause_is_not_confirmed_after_it(
    between: str,
) -> None:
    """Found by an attack: h, Ctrl-Z, y homed an axis while everything had to stand still."""
    person = jog()
    person.press(Key.HOME, 1.0, at(5.0))
    person.stopped(1.0)
    if between == "a trip":
        person.trip(6.0)
    else:
        person.block("paused by the operator")
    person.stopped(1.5)
    assert person.press(Key.CONFIRM, 2.0, at(5.0)) == [StopAxes(None, "a key")]


@pytest.mark.parametrize(
    ("between", "confirmed_s"), [(Key.HOME, 1.0), (Key.STOP, 1.0), (None, CONFIRM_S + 0.1)]
)
def test_homing_is_not_confirmed_by_a_held_key_another_key_or_too_late(
    between: Key | None, confirmed_s: float
) -> None:
    person = jog()
    person.press(Key.HOME, 0.0, at(5.0))
    if between is Key.HOME:
        assert not any(isinstance(a, HomeAxis) for a in person.press(Key.HOME, 0.5, at(5.0)))
        return
    if between is not None:
        person.press(between, 0.5, at(5.0))
    assert HomeAxis(Z) not in person.press(Key.CONFIRM, confirmed_s, at(5.0))


def test_after_a_trip_only_the_way_off_moves_until_the_force_has_fallen() -> None:
    person = jog()
    person.press(Key.MORE, 0.0, at(12.5))
    watch, words = person.trip(6.0)
    person.stopped(0.1)
    assert watch == WatchForce(RETREAT * 6.0)
    assert said([words]) == ["only stage_z - moves until the force is below 4 N"]
    assert moves(person.press(Key.MORE, 1.0, at(12.5))) == []
    assert person.poll(1.5, 4.5) == []
    assert moves(person.press(Key.LESS, 2.0, at(12.5)))
    assert person.poll(2.1, 3.9)[0] == WatchForce(LARGEST_N)
    person.stopped(2.5)
    assert moves(person.press(Key.MORE, 3.0, at(12.4)))


def test_after_a_trip_no_other_axis_moves_either_way() -> None:
    person = jog("stage_x")
    person.trip(6.0)
    assert moves(person.press(Key.LESS, 1.0, at(20.0))) == []
    assert moves(person.press(Key.MORE, 2.0, at(20.0))) == []
    assert "not homed now" in said(person.press(Key.HOME, 3.0, at(20.0)))[0]


def test_nothing_moves_while_it_is_blocked() -> None:
    person = jog()
    person.press(Key.MORE, 0.0, at(5.0))
    assert isinstance(person.block("the force sensor is silent")[0], StopAxes)
    person.stopped(0.1)
    assert moves(person.press(Key.MORE, 1.0, at(5.0))) == []
    person.unblock()
    assert moves(person.press(Key.MORE, 2.0, at(5.0)))


@given(
    begin=st.floats(0.0, 14.0),
    story=st.lists(
        st.tuples(
            st.floats(0.005, 0.4),
            st.none() | st.sampled_from(list(Key)),
            st.sampled_from([0.0, 0.0, 0.0, 4.5, 6.0]),
        ),
        max_size=60,
    ),
)
def test_whatever_is_pressed_no_limit_is_passed_and_nothing_moves_in_silence_or_under_force(
    begin: float, story: list[tuple[float, Key | None, float]]
) -> None:
    """A stage that follows at its speed: how far it gets is what the keys can do."""
    person, now = jog(), 0.0
    places = {"stage_z": begin, "stage_x": 20.0}
    target: dict[str, float] = {}
    last_key = float("-inf")
    for wait, key, force in story:
        for _ in range(round(wait / 0.02)):
            now += 0.02
            for name, end in target.items():
                way = max(-0.02, min(0.02, end - places[name]))
                assert abs(way) < 1e-9 or now - last_key <= LONGEST_STEP_S + 0.02
                places[name] += way
            carry_out(person, person.poll(now, force), target, now)
        if force > LARGEST_N and not person.pressed:
            target.clear()
            carry_out(person, person.trip(force), target, now)
            person.stopped(now)
        if key is not None:
            chosen = person.chosen
            actions = person.press(key, now, at(places[chosen.name]))
            for move in moves(actions):
                last_key = now
                assert move.axis.low <= move.target <= move.axis.high
                assert abs(move.target - places[chosen.name]) <= move.axis.step * 1.02
                assert not person.pressed or (move.axis is Z and key is Key.LESS)
            carry_out(person, actions, target, now)
        assert all(axis.low <= places[axis.name] <= axis.high for axis in (Z, X))


def carry_out(person: Jog, actions: list[Action], target: dict[str, float], now: float) -> None:
    """As a bench would."""
    for action in actions:
        if isinstance(action, MoveAxis):
            target[action.axis.name] = action.target
        elif isinstance(action, StopAxes):
            target.clear()
            person.stopped(now, released=action.axis is not None)
