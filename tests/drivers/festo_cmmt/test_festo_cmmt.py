"""The CMMT driver as a linear stage against the simulated drive: motions, torque and faults."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from stages.festo import service

from drivers.festo_cmmt.driver import FestoAxis
from drivers.simulated.faults.plan import AxisFault, SlowAxis
from rig.core.clock import Clock
from rig.core.errors import InstrumentError

# --- the role --------------------------------------------------------------------------------


def test_who_it_is_and_what_it_may() -> None:
    with service() as it:
        axis = it.connect()
        assert axis.identity.simulated
        assert axis.identity.serial_number == "SIMZ1"
        limits = axis.limits()
        assert (limits["position"].low, limits["position"].high) == (0.0, 80.0)
        assert limits["speed"].high == 50.0


def test_a_servo_follows_a_moving_target_without_ever_stopping() -> None:
    with service() as it:
        axis = it.homed()
        speeds = []
        for tick in range(300):
            axis.start_move(5 + 0.05 * tick, 20.0)
            it.clock.sleep(0.01)
            speeds.append(it.speed)
        assert it.bench.reported("move") == [{"target_mm": 5.0, "speed_mm_s": 20.0}]
        assert it.truth_mm == pytest.approx(5 + 0.05 * 299, abs=0.5)
        assert max(speeds) <= 20.0 + 1e-9


def test_a_stale_target_reached_bit_is_no_arrival() -> None:
    with service() as it:
        axis = it.homed()
        axis.start_move(10.0, 50.0)
        it.clock.sleep(2)
        shown = list(it.drive.read(100, 28, "test"))
        assert not axis.moving()
        axis.start_move(40.0, 50.0)
        it.wire.forged[100] = shown  # the drive's cycle has not come round yet
        assert axis.moving()


def test_a_motion_whose_position_does_not_change_is_reported() -> None:
    with service() as it:
        axis = it.homed()
        axis.start_move(40.0, 50.0)
        it.wire.forged[100] = list(it.drive.read(100, 28, "test"))
        stands = r"it has stood at 0 mm for 0\.[89] s on the way to 40 mm"
        with pytest.raises(InstrumentError, match=stands):
            it.clock.sleep(3)


def test_a_motion_that_never_arrives_is_reported() -> None:
    """It crawls: its position changes all the time."""
    slow = SlowAxis(device="stage_z", kind="slow", move=1, share=0.01)
    with service(drive={"faults": (slow,)}) as it:
        axis = it.homed()
        axis.start_move(40.0, 50.0)
        it.clock.sleep(3)
        with pytest.raises(InstrumentError, match="has not arrived at 40 mm"):
            axis.moving()


@pytest.mark.parametrize("next_act", ["update", "look"])
def test_a_motion_that_another_client_stopped_is_not_started_again(next_act: str) -> None:
    with service() as it:
        axis = it.homed()
        axis.start_move(60.0, 10.0)
        it.clock.sleep(0.5)
        it.connect()  # another program, which stops what moves
        it.clock.sleep(0.5)
        stands = it.truth_mm
        act = axis.moving if next_act == "look" else lambda: axis.start_move(61.0, 10.0)
        with pytest.raises(InstrumentError, match="stopped, not by this run"):
            act()
        it.clock.sleep(1)
        assert it.truth_mm == stands
        axis.move_to(10.0, 10.0)
        assert it.truth_mm == 10.0


# --- faults ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (109, "negative software limit"),
        (110, "positive software limit"),
        (113, "contradict"),
        (114, "negative limit switch"),
        (115, "positive limit switch"),
        (118, "both limit switches"),
        (126, "following error"),
        (56, "homing method"),
        (58, "whole path"),
        (391, "no request reached"),
        (4711, "manual"),
    ],
)
def test_a_fault_has_number_meaning_and_remedy(number: int, words: str) -> None:
    with service() as it:
        axis = it.homed()
        axis.start_move(40.0, 10.0)
        it.drive.trip(number)
        with pytest.raises(InstrumentError, match=f"{number} .*{words}") as caught:
            axis.moving()
        assert caught.value.hint
        assert caught.value.device == "stage_z"


def test_a_keep_alive_tells_a_fault_once() -> None:
    with service() as it:
        axis = it.homed()
        it.drive.trip(126)
        with pytest.raises(InstrumentError, match="126"):
            it.clock.sleep(1)
        it.clock.sleep(1)
        axis.stop()


def test_stopping_works_in_spite_of_a_fault_that_is_not_reported_yet() -> None:
    with service() as it:
        axis = it.homed()
        axis.start_move(60.0, 40.0)
        it.clock.sleep(0.5)
        it.drive.trip(126)
        axis.stop()
        assert it.speed == 0


def test_the_torque_limit_ends_a_motion_into_something() -> None:
    with service() as it:
        axis = it.homed()
        it.bench.wall_mm = 10.0
        with pytest.raises(InstrumentError, match=r"torque limit at 10\.3") as caught:
            axis.move_to(40.0, 5.0)
        assert "torque_limit_percent" in str(caught.value.hint)
        assert it.truth_mm == pytest.approx(10.3, abs=0.01), "30 N against 100 N/mm"
        assert it.drive.enabled
        axis.stop()
        axis.move_to(5.0, 5.0)


def test_the_torque_is_read_by_three_requests_and_shows_what_is_pressed() -> None:
    with service() as it:
        axis = it.homed()
        it.bench.wall_mm = 10.0
        axis.move_to(9.0, 5.0)
        assert axis.torque_percent() == pytest.approx(0.0, abs=1e-6)
        axis.move_to(10.1, 5.0)
        it.wire.heard()
        assert axis.torque_percent() == pytest.approx(10.0, abs=0.2), "10 N of 100 N"
        assert it.wire.heard() == ["write 503: 1", "read 500 x5", "read 510 x2"]


def test_a_parameter_that_another_client_has_chosen_is_not_taken_for_the_torque() -> None:
    with service() as it:
        axis = it.homed()
        it.drive.write(500, [12168], "another client")
        assert axis.torque_percent() == pytest.approx(0.0, abs=1e-6), "and not 30"


def test_a_fault_is_reported_by_number_and_meaning_before_anything_acknowledges_it() -> None:
    with service() as it:
        axis = it.connect()
        assert axis.fault() is None
        it.drive.trip(126)
        assert axis.fault() == "126 (following error: the axis did not follow)"
        assert it.drive.fault == 126


def test_a_drive_that_reports_no_torque_has_none_to_watch() -> None:
    with service() as it:
        del it.drive.parameters.values[11704]
        assert it.homed().torque_percent() is None


def creep(axis: FestoAxis, clock: Clock, from_mm: float) -> None:
    """A servo that only ever tells the next target."""
    for tick in range(1000):
        axis.start_move(from_mm + 0.01 * tick, 10.0)
        clock.sleep(0.02)


def move_and_sleep(axis: FestoAxis, clock: Clock) -> None:
    axis.start_move(60.0, 10.0)
    clock.sleep(30.0)


WAYS: dict[str, Callable[[FestoAxis, Clock], None]] = {
    "move": lambda axis, clock: axis.move_to(60.0, 10.0),
    "servo": lambda axis, clock: creep(axis, clock, 60.0),
    "wait": move_and_sleep,
}


def test_the_torque_limit_ends_a_servo_and_a_wait() -> None:
    with service() as it:
        axis = it.homed()
        it.bench.wall_mm = 10.0
        with pytest.raises(InstrumentError, match=r"torque limit at 10\.3"):
            creep(axis, it.clock, 9.0)
        axis.stop()
        axis.move_to(5.0, 5.0)
        axis.start_move(40.0, 5.0)
        with pytest.raises(InstrumentError, match=r"torque limit at 10\.3"):
            it.clock.sleep(30.0)
        assert it.truth_mm == pytest.approx(10.3, abs=0.01)
        it.clock.sleep(1.0)


def test_a_new_motion_is_not_ended_by_the_last_ones_fixed_stop() -> None:
    with service() as it:
        axis = it.homed()
        it.bench.wall_mm = 10.0
        with pytest.raises(InstrumentError, match="torque limit"):
            axis.move_to(40.0, 5.0)
        assert it.drive.read(100, 28, "test")[2] >> 12 & 1, "the bit still stands"
        axis.move_to(2.0, 5.0)
        assert it.truth_mm == 2.0


@pytest.mark.parametrize(
    ("kind", "own", "reported"),
    [
        ("limit-switch", {}, "115 .*positive limit switch"),
        ("reference-lost", {}, "lost its reference"),
        ("stuck", {"torque_limit_percent": None}, "126 .*following error"),
        ("stuck", {}, "torque limit"),
    ],
)
@pytest.mark.parametrize("way", ["move", "servo", "wait"])
def test_a_disturbed_motion_is_one_error_however_it_is_watched(
    kind: Any, own: dict[str, Any], reported: str, way: str
) -> None:
    fault = AxisFault(device="stage_z", kind=kind, move=2, after_s=0.5)
    with service(drive={"faults": (fault,)}, **own) as it:
        axis = it.homed()
        axis.move_to(5.0, 20.0)
        begun = it.clock.now()
        with pytest.raises(InstrumentError, match=reported) as caught:
            WAYS[way](axis, it.clock)
        assert caught.value.device == "stage_z"
        assert caught.value.hint
        assert it.clock.now() - begun < 1.0, "at once"
        it.clock.sleep(0.5)  # reported once
        axis.make_safe()
        axis.stop()
        assert it.speed == 0


def go_and_sleep(axis: FestoAxis, clock: Clock) -> None:
    axis.start_move(15.0, 10.0)
    clock.sleep(5.0)


@pytest.mark.parametrize("go", [lambda axis, clock: axis.move_to(15.0, 10.0), go_and_sleep])
def test_an_axis_that_runs_past_its_target_is_stopped_and_reported(
    go: Callable[[FestoAxis, Clock], None],
) -> None:
    runaway = AxisFault(device="stage_z", kind="runaway", move=2, after_s=0.1)
    with service(drive={"faults": (runaway,)}) as it:
        axis = it.homed()
        axis.move_to(20.0, 20.0)
        with pytest.raises(InstrumentError, match=r"ran past its target: .* on the way to 15 mm"):
            go(axis, it.clock)
        axis.stop()
        assert it.speed == 0
        assert 13.5 < it.truth_mm < 14.9, "one look at it, and the way of braking"
        axis.move_to(15.0, 10.0)


def test_a_target_behind_a_motion_under_way_is_passed_and_come_back_to() -> None:
    with service() as it:
        axis = it.homed()
        axis.start_move(40.0, 20.0)
        it.clock.sleep(1.0)
        axis.start_move(it.truth_mm + 0.1, 20.0)
        wanted = it.truth_mm + 0.1
        while axis.moving():
            it.clock.sleep(0.005)
        assert it.truth_mm == pytest.approx(wanted, abs=0.02)


def test_without_a_torque_limit_the_drive_reports_a_following_error() -> None:
    with service(torque_limit_percent=None) as it:
        axis = it.homed()
        it.bench.wall_mm = 10.0
        with pytest.raises(InstrumentError, match="126"):
            axis.move_to(40.0, 5.0)


def test_keep_alives_feed_the_time_out_and_nothing_else_does() -> None:
    with service() as it:
        axis = it.homed()
        axis.start_move(60.0, 1.0)
        it.clock.sleep(5.0)
        assert axis.moving()
        begun = it.bench.now_us
        it.bench.now_us += 2_000_000  # the procedure hangs
        assert it.drive.velocity_mm_s(begun + 490_000) == pytest.approx(1.0)
        assert it.drive.velocity_mm_s(begun + 510_000) == 0
        with pytest.raises(InstrumentError, match="no request reached the drive"):
            axis.moving()


def test_keep_alives_only_read() -> None:
    with service() as it:
        axis = it.homed()
        axis.start_move(60.0, 10.0)
        it.wire.heard()
        it.clock.sleep(1.0)
        assert it.wire.heard() == ["read 100 x28"]


def test_power_lost_in_motion_is_reported() -> None:
    with service() as it:
        axis = it.homed()
        axis.start_move(60.0, 10.0)
        it.drive.write(0, [0] * 28, "somebody")
        with pytest.raises(InstrumentError, match="switched its power off"):
            axis.moving()
