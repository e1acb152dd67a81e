"""What every stage driver does alike, over its simulated stage: moving, stopping, being made safe,
and keeping to its limits, also where several threads call it at once."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from elsewhere import elsewhere
from stages.cases import CASES, StageCase

from rig.core.errors import InstrumentError, LimitError
from rig.instruments.roles import RemembersPosition

EVERY = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
PATIENCE_S = 10.0
CLOSE = 0.02
"""How near a motion ends to its target, mm or deg."""


@contextmanager
def running(case: Any, fault: dict[str, Any] | None = None) -> Iterator[StageCase]:
    """A connected stage that has been homed."""
    with case.running(fault) as it:
        it.home()
        yield it


def assert_stands(it: StageCase) -> None:
    """It is at rest and stays there."""
    it.let_pass(0.25)  # the time in which it brakes, and less than a communication time-out
    there = it.position
    assert it.speed == 0
    it.seen()
    it.let_pass(0.25)
    assert it.position == there
    it.seen()


def assert_can_move(it: StageCase) -> None:
    """A motion from where it stands ends at its target."""
    target = it.seen() + 1.0
    it.go(target, 10.0)
    assert it.position == pytest.approx(target, abs=CLOSE)


LINEAR = [case for case in CASES if case.quantities[0] == "position"]


@pytest.mark.parametrize("case", LINEAR, ids=lambda case: case.name)
def test_where_a_linear_stage_was_last_seen_is_known_without_asking_it(case: Any) -> None:
    with running(case) as it:
        it.go(20.0, 25.0)
        there = it.seen()
        asked_s = it.clock.now()
        it.let_pass(0.3)
        it.said()
        seen = it.stage.last_seen()
        assert isinstance(it.stage, RemembersPosition)
        assert not it.said(), "it is not asked"
        assert seen.position_mm == pytest.approx(there, abs=1e-6)
        assert seen.seen_s == pytest.approx(asked_s, abs=0.02)
        assert seen.answered_s == pytest.approx(asked_s, abs=0.02)


# --- moving ----------------------------------------------------------------------------------


@EVERY
def test_a_motion_ends_at_its_target_and_the_driver_says_the_same(case: Any) -> None:
    with running(case) as it:
        it.go(20.0, 25.0)
        assert it.position == pytest.approx(20.0, abs=CLOSE)
        assert it.seen() == pytest.approx(it.position, abs=2e-3)
        assert_stands(it)


@EVERY
def test_a_motion_changed_under_way_ends_at_its_new_target(case: Any) -> None:
    with running(case) as it:
        it.start(40.0, 20.0)
        it.clock.sleep(0.5)
        it.start(12.0, 20.0)
        while it.stage.moving():
            it.clock.sleep(0.02)
        assert it.position == pytest.approx(12.0, abs=CLOSE)


@EVERY
def test_a_stage_that_is_not_homed_refuses_to_move(case: Any) -> None:
    with case.running(None) as it:
        assert not it.stage.homed()
        before = it.position
        for act in (it.start, it.go):
            with pytest.raises(InstrumentError, match=r"not been homed|W[RH]") as caught:
                act(5.0, 5.0)
            assert "home it" in str(caught.value.hint)
        it.let_pass(1.0)
        assert it.position == before


@EVERY
@pytest.mark.parametrize(
    ("position", "speed", "what", "value"),
    [
        (95.0, 5.0, 0, "95"),
        (-6.0, 5.0, 0, "-6"),
        (float("nan"), 5.0, 0, "nan"),
        (5.0, 51.0, 1, "51"),
        (5.0, 0.0, 1, "0"),
        (5.0, -1.0, 1, "-1"),
        (5.0, float("nan"), 1, "nan"),
    ],
)
@pytest.mark.parametrize("under_way", [False, True])
def test_a_motion_outside_a_limit_sends_nothing(
    case: Any, position: float, speed: float, what: int, value: str, under_way: bool
) -> None:
    with running(case) as it:
        if under_way:
            it.start(40.0, 5.0)
            it.said()
        wanted = f"{it.quantities[what]} {value} .* is outside"
        with pytest.raises(LimitError, match=wanted) as caught:
            it.start(position, speed)
        assert caught.value.hint
        assert list(it.said()) == []


@EVERY
def test_a_stage_that_runs_past_its_target_is_stopped_and_reported(case: Any) -> None:
    with running(case, {"kind": "runaway", "move": 2, "after_s": 0.1}) as it:
        it.go(20.0, 20.0)
        with pytest.raises(InstrumentError, match=r"ran past its target: .* on the way to 15"):
            it.go(15.0, 10.0)
        it.stage.stop()
        assert it.speed == 0
        assert 12.5 < it.position < 14.9, "one poll, and the braking distance"


@EVERY
@pytest.mark.parametrize("changed", [False, True], ids=["one motion", "a target every tick"])
def test_a_slow_motion_whose_steps_are_far_apart_is_not_taken_for_a_standstill(
    case: Any, changed: bool
) -> None:
    with running(case) as it:
        begin, begun_s = it.seen(), it.clock.now()
        it.start(begin + 0.1, it.slow)
        for _ in range(150):
            it.clock.sleep(0.02)
            if changed:
                it.start(begin + 0.1, it.slow)
            it.seen()
        assert it.stage.moving()
        gone = it.slow * (it.clock.now() - begun_s)
        assert it.position == pytest.approx(begin + gone, rel=0.1, abs=2e-4)


@EVERY
@pytest.mark.parametrize("changed", [False, True], ids=["one motion", "a target every tick"])
def test_a_slow_stage_that_is_stuck_is_found(case: Any, changed: bool) -> None:
    with running(case, {"kind": "stuck", "move": 1}) as it:
        begin, begin_s = it.seen(), it.clock.now()

        def wait() -> None:
            it.start(begin + 0.1, it.slow)
            while it.clock.now() < begin_s + 20.0:
                it.clock.sleep(0.02)
                if changed:
                    it.start(begin + 0.1, it.slow)
                it.seen()

        with pytest.raises(InstrumentError):
            wait()
        assert it.clock.now() - begin_s < 5.0


# --- a target that the stage refuses ---------------------------------------------------------

REFUSED = "refused it|rejected with"


def refuse(it: StageCase, target: float) -> None:
    """The stage refuses this target."""
    with it.refusing(), pytest.raises(InstrumentError, match=REFUSED):
        it.start(target, 10.0)


@EVERY
def test_a_motion_whose_new_target_is_refused_ends_at_its_old_one(case: Any) -> None:
    with running(case) as it:
        it.start(20.0, 10.0)
        it.clock.sleep(0.5)
        refuse(it, 5.0)
        while it.stage.moving():
            it.clock.sleep(0.02)
        assert it.position == pytest.approx(20.0, abs=CLOSE)
        assert_can_move(it)


@EVERY
def test_a_motion_whose_new_target_is_refused_is_judged_by_its_old_one(case: Any) -> None:
    """It moves on to that one, and must not do so unwatched."""
    with running(case, {"kind": "runaway", "move": 2, "after_s": 0.1}) as it:
        it.go(20.0, 20.0)

        def wait() -> None:
            it.start(15.0, 10.0)
            refuse(it, 18.0)
            end_s = it.clock.now() + 3.0
            while it.clock.now() < end_s:
                it.clock.sleep(0.02)
                it.seen()

        with pytest.raises(InstrumentError, match=r"ran past its target: .* on the way to 15"):
            wait()
        it.stage.stop()
        assert it.speed == 0
        assert 12.5 < it.position < 14.9, "one poll, and the braking distance"


@EVERY
def test_a_stage_at_rest_that_refuses_a_motion_may_stand_there(case: Any) -> None:
    with running(case) as it:
        refuse(it, 20.0)
        for _ in range(60):
            it.clock.sleep(0.02)
            it.seen()
        assert not it.stage.moving()
        assert_can_move(it)


@EVERY
@pytest.mark.parametrize("moment", ["before", "within"])
def test_a_stop_that_meets_a_refusal_leaves_no_motion_to_be_judged(case: Any, moment: str) -> None:
    """By another thread, after the refusal: before the driver looks at what is under way, and
    between that look and its going back to the old target."""
    with running(case) as it:
        it.start(60.0, 10.0)
        it.clock.sleep(0.5)
        owner = it.watch_owner
        usual = owner.take_back

        def stop_first(refused: Any, before: Any, ticket: Any) -> None:
            elsewhere(it.stage.stop)
            if moment == "within":  # as if the stop had come after the look
                owner.motion = refused
            usual(refused, before, ticket)

        owner.take_back = stop_first
        refuse(it, 5.0)
        del owner.take_back
        assert owner.motion is None
        assert_stands(it)
        assert_can_move(it)


# --- stopping --------------------------------------------------------------------------------


@EVERY
def test_stop_waits_for_rest(case: Any) -> None:
    with running(case) as it:
        it.start(60.0, 40.0)
        it.clock.sleep(0.5)
        assert it.stage.moving()
        assert it.speed > 0
        it.stage.stop()
        assert it.speed == 0
        assert it.position < 59.0
        assert not it.stage.moving()
        assert_can_move(it)


@EVERY
@pytest.mark.parametrize("under_way", [False, True])
@pytest.mark.parametrize("act", ["stop", "make_safe"])
def test_a_target_on_its_way_is_not_sent_after_another_thread_has_stopped_the_stage(
    case: Any, under_way: bool, act: str
) -> None:
    """Between the driver's last look at the stage and its command."""
    with running(case) as it:
        if under_way:
            it.start(60.0, 10.0)
            it.let_pass(0.1)
        stopping = getattr(it.stage, act)
        words = {"stop": "stopped meanwhile", "make_safe": "made safe meanwhile"}[act]
        with (
            it.before_a_motion_is_sent(lambda: elsewhere(stopping)),
            pytest.raises(InstrumentError, match=words) as caught,
        ):
            it.start(61.0, 10.0)
        assert caught.value.hint
        assert_stands(it)
        it.stage.stop()
        assert_can_move(it)


@EVERY
def test_a_motion_that_waits_for_its_link_is_checked_when_its_turn_comes(case: Any) -> None:
    """Another thread uses the link while a stop begins; the stop's command comes after that."""
    with running(case) as it:
        in_use, free = threading.Event(), threading.Event()
        failures: list[InstrumentError] = []

        def use_the_link() -> None:
            with it.link_lock:
                in_use.set()
                assert free.wait(PATIENCE_S)

        user = threading.Thread(target=use_the_link)

        def wait_until_in_use() -> None:
            user.start()
            assert in_use.wait(PATIENCE_S)

        def move() -> None:
            try:
                with it.before_a_motion_is_sent(wait_until_in_use):
                    it.start(40.0, 10.0)
            except InstrumentError as error:
                failures.append(error)

        procedure = threading.Thread(target=move)
        procedure.start()
        assert in_use.wait(PATIENCE_S)
        time.sleep(0.2)  # until the procedure waits for the link as well
        with it.stage._interlock.stopping():
            pass
        free.set()
        for thread in (user, procedure):
            thread.join(PATIENCE_S)
        assert ["stopped meanwhile" in failure.message for failure in failures] == [True]
        assert_stands(it)
        assert_can_move(it)


@EVERY
@pytest.mark.parametrize(
    ("act", "words"), [("stop", "stopped meanwhile"), ("make_safe", "made safe meanwhile")]
)
def test_a_motion_that_another_thread_ends_has_not_arrived(case: Any, act: str, words: str) -> None:
    """A procedure must not take the stage to be where it wanted it."""
    with running(case) as it:
        it.after(0.5, lambda: elsewhere(getattr(it.stage, act)))
        with pytest.raises(InstrumentError, match=words):
            it.go(60.0, 10.0)
        assert_stands(it)
        assert it.position < 10.0
        it.stage.stop()
        assert_can_move(it)


@EVERY
@pytest.mark.parametrize(
    ("act", "words"), [("stop", "stopped meanwhile"), ("make_safe", "made safe meanwhile")]
)
def test_homing_that_another_thread_ends_is_over_and_not_taken_for_found(
    case: Any, act: str, words: str
) -> None:
    with case.running(None) as it:
        it.clock.each_slice(it.stage.keep_alive)
        it.after(0.1, lambda: elsewhere(getattr(it.stage, act)))
        began_s = it.clock.now()
        with pytest.raises(InstrumentError, match=f"home: the {it.noun} was {words}"):
            it.stage.home()
        assert it.clock.now() - began_s < 2.0, "it does not wait for a reference any more"
        assert_stands(it)
        it.stage.stop()
        assert not it.stage.homed()
        it.stage.home()
        assert_can_move(it)


# --- making safe -----------------------------------------------------------------------------


@EVERY
def test_make_safe_needs_no_bench_time_and_stops_the_stage(case: Any) -> None:
    with running(case) as it:
        it.start(60.0, 40.0)
        it.clock.sleep(0.5)
        it.clock.slept = lambda: pytest.fail("the bench's clock stands while a watcher acts")
        now = it.clock.now()
        it.stage.make_safe()
        it.stage.make_safe()
        assert it.clock.now() == now
        it.clock.slept = None
        assert_stands(it)


@EVERY
def test_a_procedure_behind_its_watcher_cannot_set_the_stage_going_again(case: Any) -> None:
    late: list[Callable[[StageCase], object]] = [
        lambda it: it.start(61.0, 10.0),
        lambda it: it.go(61.0, 10.0),
        lambda it: it.stage.home(),
        lambda it: it.stage.moving(),
    ]
    with running(case) as it:
        it.start(60.0, 10.0)
        it.let_pass(0.1)
        it.stage.make_safe()
        for act in late:
            with pytest.raises(InstrumentError, match="made safe meanwhile") as caught:
                act(it)
            assert caught.value.hint == "stop it before the next motion"
        assert_stands(it)
        it.stage.stop()
        it.go(10.0, 10.0)
        assert it.position == pytest.approx(10.0, abs=CLOSE)


@EVERY
def test_the_stop_that_ends_a_motion_does_not_answer_a_make_safe(case: Any) -> None:
    """The watcher acts just as the stage arrives: only a stop that is called for it answers it."""
    with running(case) as it:
        usual = it.stage.moving

        def arrive_and_be_made_safe() -> bool:
            moving = usual()
            if not moving:
                elsewhere(it.stage.make_safe)
            return moving

        it.stage.moving = arrive_and_be_made_safe
        with pytest.raises(InstrumentError, match="made safe meanwhile"):
            it.go(5.0, 10.0)
        it.stage.moving = usual
        with pytest.raises(InstrumentError, match="made safe meanwhile"):
            it.start(20.0, 10.0)
        assert_stands(it)
        it.stage.stop()
        assert_can_move(it)


@EVERY
def test_a_make_safe_while_another_thread_stops_the_stage_is_not_answered_by_that_stop(
    case: Any,
) -> None:
    with running(case) as it:
        it.start(60.0, 40.0)
        it.clock.sleep(0.5)
        it.after(0.0, lambda: elsewhere(it.stage.make_safe))
        it.stage.stop()
        with pytest.raises(InstrumentError, match="made safe meanwhile"):
            it.start(20.0, 10.0)
        assert_stands(it)
        it.stage.stop()
        assert_can_move(it)
