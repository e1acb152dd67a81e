"""The CMMT driver against the simulated drive, through pymodbus and a real socket."""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import pytest
from pydantic import ValidationError
from simulated.axis_bench import AxisBench
from stages.festo import OWN, TIMEOUT_S, Service, service

from drivers.festo_cmmt import driver as festo_cmmt
from drivers.festo_cmmt.driver import FestoAxis, FestoCmmtSettings
from drivers.simulated.faults.plan import AxisFault, FaultPlan, SlowAxis
from drivers.simulated.transports.modbus_tcp import ModbusError
from rig.core.clock import Clock
from rig.core.errors import InstrumentError, InstrumentTimeoutError

# --- what goes over the wire -----------------------------------------------------------------


def mailbox_read(number: int, words: int, elements: int = 1) -> list[str]:
    return [
        f"write 500: {number}", "write 501: 0", f"write 502: {elements}", "write 503: 1",
        "read 503 x1", "read 504 x1", f"read 510 x{words}",
    ]  # fmt: skip


def mailbox_write(number: int, *words: int) -> list[str]:
    return [
        f"write 500: {number}", "write 501: 0", "write 502: 1", f"write 504: {2 * len(words)}",
        "write 510: " + " ".join(str(word) for word in words), "write 503: 2", "read 503 x1",
        *mailbox_read(number, len(words)),
    ]  # fmt: skip


def test_connecting_word_for_word() -> None:
    with service() as it:
        it.connect()
        assert it.wire.heard() == [
            "identify",  # codes 1 and 2
            *mailbox_read(2021, 3, elements=5),
            "write 400: 500 0",
            "read 400 x1",
            *mailbox_read(3490, 1),
            *mailbox_read(12698, 2),
            *mailbox_read(12699, 2),
            "read 100 x28",
            *mailbox_read(11584, 4),
            *mailbox_write(11584, 0, 0, 0, 0),
            *mailbox_read(11585, 4),
            *mailbox_write(11585, 0x3880, 1, 0, 0),
            *mailbox_read(12168, 2),
            *mailbox_write(12168, 0, 0x41F0),
            *mailbox_read(11704, 2),
            *mailbox_read(11070, 2),
        ]
        assert not any(said.startswith("write 0:") for said in it.wire.said), "control is not taken"


def test_connecting_again_writes_no_parameter() -> None:
    with service() as it:
        it.connect()
        it.wire.heard()
        it.connect()
        assert not any(said.startswith("write 510") for said in it.wire.heard())


def test_homing_word_for_word() -> None:
    with service() as it:
        axis = it.connect()
        it.wire.heard()
        axis.home()
        assert it.wire.heard() == [
            "read 100 x28",
            "write 0: 042e 0000 c000 0100 0 at 0",  # control, no stops, ON low
            "read 100 x28",
            "write 0: 042f 0000 c000 0100 0 at 0",  # ON rises
            "read 100 x28",
            "write 0: 042f 0000 c000 0100 0 at 0",  # stop: the homing bit is low
            "read 100 x28",
            "write 0: 0c3f 0000 c000 0100 0 at 0",  # homing
            "read 100 x28",
            "write 0: 042f 0000 c000 0100 0 at 0",  # stop
            "read 100 x28",
        ]
        assert axis.homed()
        assert it.truth_mm == 0.0


def test_homing_at_the_reference_is_over_at_once() -> None:
    """The homing bit may have come and gone before anybody looked."""
    with service(drive={"home_mm": 10.0}) as it:
        axis = it.connect()
        assert it.truth_mm == 10.0
        axis.home()
        assert axis.homed()
        assert it.truth_mm == pytest.approx(10.0)


def test_a_move_word_for_word() -> None:
    with service() as it:
        axis = it.connect()
        axis.home()
        it.wire.heard()
        axis.move_to(20.0, 25.0)
        assert it.wire.heard() == [
            "read 100 x28",
            "write 0: 047f 9100 c000 0100 20000 at 25000",  # absolute, continuous, MDI
            "read 100 x28",
            "write 0: 042f 0000 c000 0100 0 at 0",
            "read 100 x28",
        ]
        assert axis.position_mm() == it.truth_mm == 20.0


def test_a_retarget_is_one_read_and_one_write() -> None:
    with service() as it:
        axis = it.homed()
        axis.start_move(20.0, 25.0)
        it.wire.heard()
        for target in (21.0, 22.5, 5.0):
            it.clock.sleep(0.01)
            axis.start_move(target, 25.0)
        image = "047f 9100 c000 0100"
        assert it.wire.heard() == [
            "read 100 x28",
            f"write 0: {image} 21000 at 25000",
            "read 100 x28",
            f"write 0: {image} 22500 at 25000",
            "read 100 x28",
            f"write 0: {image} 5000 at 25000",
        ]


def test_a_retarget_right_after_a_look_is_one_write() -> None:
    with service() as it:
        axis = it.homed()
        axis.start_move(20.0, 25.0)
        it.clock.sleep(0.01)
        it.wire.heard()
        axis.position_mm()
        axis.start_move(21.0, 25.0)
        assert it.wire.heard() == [
            "read 100 x28",
            "write 0: 047f 9100 c000 0100 21000 at 25000",
        ]


def test_targets_at_500_hz_are_read_before_at_100_hz() -> None:
    with service() as it:
        axis = it.homed()
        axis.start_move(20.0, 25.0)
        it.clock.sleep(0.01)
        it.wire.heard()
        for tick in range(11):
            axis.start_move(21.0 + 0.1 * tick, 25.0)
            it.clock.sleep(0.002)
        said = [line.split(" ")[0] for line in it.wire.heard()]
        assert said == 2 * ["read", *5 * ["write"]] + ["read", "write"]


def test_an_old_fault_is_acknowledged_once_on_taking_charge() -> None:
    with service() as it:
        axis = it.connect()
        it.drive.trip(126)
        it.wire.heard()
        axis.home()
        assert it.wire.heard()[:6] == [
            "read 100 x28",
            "write 0: 042e 0000 c000 0100 0 at 0",
            "write 0: 04ae 0000 c000 0100 0 at 0",  # acknowledge
            "read 100 x28",
            "write 0: 042e 0000 c000 0100 0 at 0",
            "read 100 x28",
        ]
        it.drive.trip(126)
        with pytest.raises(InstrumentError, match="126"):
            axis.start_move(1.0, 1.0)
        with pytest.raises(InstrumentError, match="126"):
            axis.home()


# --- the role --------------------------------------------------------------------------------


def test_who_it_is_and_what_it_may() -> None:
    with service() as it:
        axis = it.connect()
        assert axis.identity.simulated
        assert axis.identity.serial_number == "SIMZ1"
        reach = axis.reach()
        assert (reach["position"].low, reach["position"].high) == (0.0, 80.0)
        assert reach["speed"].high == 50.0


def test_a_servo_follows_a_moving_target_without_ever_stopping() -> None:
    with service() as it:
        axis = it.homed()
        speeds = []
        for tick in range(300):
            axis.start_move(5 + 0.05 * tick, 20.0)
            it.clock.sleep(0.01)
            speeds.append(it.speed)
        assert it.bench.told("move") == [{"target_mm": 5.0, "speed_mm_s": 20.0}]
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
        with pytest.raises(InstrumentError, match="stopped, not on our command"):
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


def test_a_fault_is_told_by_number_and_meaning_before_anything_acknowledges_it() -> None:
    with service() as it:
        axis = it.connect()
        assert axis.fault() is None
        it.drive.trip(126)
        assert axis.fault() == "126 (following error: the axis did not follow)"
        assert it.drive.fault == 126


def test_a_drive_that_reports_no_torque_has_none_to_watch() -> None:
    with service() as it:
        del it.drive._parameters[11704]
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
    ("kind", "own", "told"),
    [
        ("limit-switch", {}, "115 .*positive limit switch"),
        ("reference-lost", {}, "lost its reference"),
        ("stuck", {"torque_limit_percent": None}, "126 .*following error"),
        ("stuck", {}, "torque limit"),
    ],
)
@pytest.mark.parametrize("way", ["move", "servo", "wait"])
def test_a_disturbed_motion_is_one_error_however_it_is_watched(
    kind: Any, own: dict[str, Any], told: str, way: str
) -> None:
    fault = AxisFault(device="stage_z", kind=kind, move=2, after_s=0.5)
    with service(drive={"faults": (fault,)}, **own) as it:
        axis = it.homed()
        axis.move_to(5.0, 20.0)
        begun = it.clock.now()
        with pytest.raises(InstrumentError, match=told) as caught:
            WAYS[way](axis, it.clock)
        assert caught.value.device == "stage_z"
        assert caught.value.hint
        assert it.clock.now() - begun < 1.0, "at once"
        it.clock.sleep(0.5)  # told once
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


# --- making safe -----------------------------------------------------------------------------


def test_an_axis_that_is_made_safe_keeps_its_power() -> None:
    with service() as it:
        axis = it.homed()
        axis.start_move(60.0, 40.0)
        it.clock.sleep(0.5)
        axis.make_safe()
        it.bench.now_us += 210_000
        assert it.speed == 0
        assert it.drive.enabled, "a vertical axis hangs by its power"


def test_what_fails_in_one_thread_leaves_another_its_new_connection() -> None:
    """A link that broke is closed before the next request opens it anew, not after."""
    with service({"kind": "close", "command": "read 100", "at": 20}) as it:
        axis = it.homed()
        ended: list[object] = []

        def look() -> None:
            for _ in range(40):
                try:
                    ended.append(axis.position_mm())
                except InstrumentError as error:
                    ended.append(error)

        threads = [threading.Thread(target=look) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert sum(isinstance(result, InstrumentError) for result in ended) <= 1


def test_making_a_drive_without_power_safe_does_not_switch_it_on() -> None:
    with service() as it:
        axis = it.connect()
        axis.make_safe()
        axis.stop()
        it.clock.sleep(1)
        assert not it.drive.enabled


def test_make_safe_gets_through_on_a_second_connection() -> None:
    with service() as it:
        axis = it.homed()
        axis.start_move(60.0, 40.0)
        it.clock.sleep(0.5)
        break_wire(it, kind="close")
        axis.make_safe()
        it.bench.now_us += 210_000
        assert it.speed == 0
        assert it.drive.fault == 0


def test_make_safe_that_does_not_get_through_says_so_after_one_time_out() -> None:
    with service() as it:
        axis = it.homed()
        axis.start_move(60.0, 40.0)
        break_wire(it, kind="silence", count=0)
        begun = time.monotonic()
        with pytest.raises(InstrumentTimeoutError, match="no answer"):
            axis.make_safe()
        assert time.monotonic() - begun < 10 * TIMEOUT_S
        assert it.wire.said[-1].startswith("write 0: 042f"), "it was said all the same"


class RealTime:
    """A bench whose time goes on by itself from where another's stands."""

    def __init__(self, bench: AxisBench):
        self._shift = bench.now_us - time.monotonic_ns() // 1000
        self.log, self.load_N = bench.log, bench.load_N

    @property
    def now_us(self) -> int:
        return time.monotonic_ns() // 1000 + self._shift


def test_the_modules_make_safe_waits_for_rest_beside_a_live_connection() -> None:
    with service(communication_timeout_ms=5000, max_speed_mm_s=200.0) as it:
        axis = it.homed()
        axis.start_move(70.0, 10.0)
        it.drive._port = port = RealTime(it.bench)
        festo_cmmt.make_safe(it.settings)
        festo_cmmt.make_safe(it.settings)
        assert it.drive.velocity_mm_s(port.now_us) == 0
        assert it.drive.enabled


# --- what is refused at connect --------------------------------------------------------------


def test_another_make_is_refused() -> None:
    with service() as it:
        it.drive.identity.update({0: "ACME", 1: "T-1000", 4: "toaster", 5: "T-1000"})
        with pytest.raises(InstrumentError, match="ACME T-1000") as caught:
            it.connect()
        assert "expected" in str(caught.value.hint)


def test_another_telegram_is_refused() -> None:
    with service() as it:
        assert it.drive._parameters[3490] == b"\x6f\x00"
        it.drive._parameters[3490] = struct.pack("<H", 9)
        with pytest.raises(InstrumentError, match="telegram 9"):
            it.connect()


@pytest.mark.parametrize(
    "drive", [{"position_unit_mm": 0.01}, {"speed_unit_mm_s": 0.01}, {"position_unit_mm": 1.0}]
)
def test_another_unit_is_refused(drive: dict[str, float]) -> None:
    with service(drive=drive) as it, pytest.raises(InstrumentError, match="the drive's unit is"):
        it.connect()


def test_a_unit_that_agrees_is_used() -> None:
    units = {"position_unit_mm": 0.01, "speed_unit_mm_s": 0.1}
    with service(drive=units, **units) as it:
        axis = it.homed()
        axis.move_to(12.34, 20.0)
        assert it.truth_mm == pytest.approx(12.34)


def test_a_drive_that_does_not_tell_its_unit_needs_a_persons_word() -> None:
    with service() as it:
        it.wire.refused = {12698}
        with pytest.raises(InstrumentError, match="does not report its units") as caught:
            it.connect()
        assert "trust_units" in str(caught.value.hint)
    with service(trust_units=True) as it:
        it.wire.refused = {12698, 12699}
        it.connect()


def test_a_communication_time_out_that_is_not_kept_is_reported() -> None:
    with service() as it:
        it.wire.forged[400] = [1000]
        with pytest.raises(InstrumentError, match="set to 500 ms but reads back 1000 ms"):
            it.connect()


@pytest.mark.parametrize("number", [11584, 11585, 12168], ids=["low", "high", "torque"])
def test_a_limit_that_the_drive_does_not_keep_ends_the_connection(number: int) -> None:
    with service() as it:
        other = b"\x07" * len(it.drive._parameters[number])
        write = it.wire.write

        def keep_another(address: int, values: Sequence[int], by: str) -> None:
            write(address, values, by)
            if (address, values[0]) == (503, 2):
                it.drive._parameters[number] = other

        it.wire.write = keep_another  # type: ignore[method-assign]
        told = rf"write parameter {number}: set to \w+ but reads back {other.hex()}"
        with pytest.raises(InstrumentError, match=told) as caught:
            it.connect()
        assert caught.value.hint


def test_connecting_stops_what_an_earlier_run_left_moving() -> None:
    with service() as it:
        it.homed().start_move(70.0, 10.0)
        it.connect()
        assert it.speed == 0
        assert it.drive.enabled


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"low_limit_mm": 90}, "below high_limit_mm"),
        ({"acceleration_mm_s2": 2000}, "cannot exceed"),
        ({"deceleration_mm_s2": 0.01}, "resolution"),
        ({"communication_timeout_ms": 10}, "communication_timeout_ms"),
        ({"torque_limit_percent": 0}, "torque_limit_percent"),
        ({"high_limit_mm": 3e6}, "do not fit"),
        ({"speed_unit_mm_s": 1e-9}, "max_speed_mm_s does not fit"),
        ({"axis": "y"}, "axis"),
        ({"resource": "here"}, "resource"),
    ],
)
def test_settings_that_are_refused(change: dict[str, Any], told: str) -> None:
    with pytest.raises(ValidationError, match=told):
        FestoCmmtSettings(**{**OWN, **change})


# --- the wire breaks -------------------------------------------------------------------------


def break_wire(it: Service, **fault: Any) -> None:
    """A fault on the wire from now on."""
    plan = FaultPlan.model_validate({"fault": [{"device": "it", **fault}]})
    it.server.faults._faults = list(plan.fault)
    it.server.faults._matched = [0]


def test_a_new_connection_sets_the_communication_time_out_again() -> None:
    with service({"kind": "close", "command": "FC3 100", "at": 2}) as it:
        axis = it.connect()
        it.wire.heard()
        with pytest.raises(InstrumentError, match="connection failed"):
            axis.position_mm()
        axis.position_mm()
        assert it.wire.heard() == [
            "read 100 x28",
            "write 400: 500 0",
            "read 400 x1",
            "read 100 x28",
        ]


def test_a_new_connection_whose_time_out_cannot_be_set_is_none() -> None:
    with service() as it:
        axis = it.homed()
        it.wire.forged[400] = [1000]
        break_wire(it, kind="close")
        with pytest.raises(InstrumentError, match="connection failed"):
            axis.position_mm()
        with pytest.raises(InstrumentError, match="set to 500 ms but reads back 1000 ms"):
            axis.position_mm()
        del it.wire.forged[400]
        assert axis.position_mm() == 0.0


def test_silence_is_reported_and_charged_to_the_clock() -> None:
    with service({"kind": "silence", "count": 0}) as it:
        told = f"no answer within {TIMEOUT_S:g} s"
        with pytest.raises(InstrumentTimeoutError, match=told) as caught:
            it.connect()
        assert f"127.0.0.1:{it.server.port}" in str(caught.value.hint)
        assert it.clock.now() == pytest.approx(TIMEOUT_S)


def test_a_time_out_inside_a_keep_alive_ends_the_wait_once() -> None:
    with service() as it:
        axis = it.homed()
        break_wire(it, kind="silence", count=0)
        before = it.clock.now()
        with pytest.raises(InstrumentTimeoutError):
            it.clock.sleep(1)
        assert it.clock.now() - before < 2 * TIMEOUT_S
        axis.close()


@pytest.mark.parametrize("kind", ["silence", "garbage", "close", "truncate", "stale"])
@pytest.mark.parametrize("at", [1, 2, 3])
def test_a_broken_exchange_of_a_servo_is_an_error_and_the_next_one_works(
    kind: str, at: int
) -> None:
    with service({"kind": kind, "command": "FC16 0", "at": 5 + at}) as it:
        axis = it.homed()
        failures = 0
        for target in (10.0, 11.0, 12.0, 13.0, 14.0):
            try:
                axis.start_move(target, 10.0)
            except InstrumentError:
                failures += 1
            it.clock.sleep(0.05)
        assert failures == 1
        while axis.moving():
            it.clock.sleep(0.05)
        assert it.truth_mm == 14.0, "a late answer is nobody's answer"


def test_a_modbus_exception_is_reported() -> None:
    with service() as it:
        axis = it.homed()

        def refuse(address: int, count: int, by: str) -> Sequence[int]:
            raise ModbusError(4)

        it.wire.read = refuse  # type: ignore[method-assign]
        with pytest.raises(InstrumentError, match="Modbus exception 4"):
            axis.position_mm()


def test_a_drive_that_is_not_there_is_reported() -> None:
    with service() as it:
        pass
    with pytest.raises(InstrumentError, match="cannot be opened") as caught:
        it.connect()
    assert f"127.0.0.1:{it.server.port}" in str(caught.value.hint)


def test_one_flipped_bit_of_a_position_is_asked_for_again_and_changes_nothing() -> None:
    """Modbus TCP has no checksum of its own. Bit 16 of the position is 65.5 mm."""
    with service() as it:
        axis = it.homed()
        axis.start_move(20.0, 25.0)
        it.clock.sleep(0.2)
        usual = it.wire.read

        def flip_once(address: int, count: int, by: str) -> Sequence[int]:
            registers = list(usual(address, count, by))
            if address == 100:
                it.wire.read = usual  # type: ignore[method-assign]
                registers[6] ^= 1
            return registers

        it.wire.read = flip_once  # type: ignore[method-assign]
        assert axis.position_mm() == pytest.approx(it.truth_mm, abs=0.1)
        assert axis.misreadings == 1
        while axis.moving():
            it.clock.sleep(0.02)
        assert it.truth_mm == pytest.approx(20.0, abs=0.02)
        assert axis.misreadings == 1
