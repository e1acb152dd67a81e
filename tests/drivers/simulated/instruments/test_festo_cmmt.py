"""The simulated CMMT without a wire: images in, images out, by hand and by the sheet's numbers."""

from __future__ import annotations

import struct

import pytest

from drivers.simulated.faults.plan import AxisFault, DriveFault, MoveFault, SlowAxis
from drivers.simulated.transports.modbus_tcp import ModbusError

from ..axis_bench import ACK, HOME, ON, PLC, RUN, TASK, Controller


@pytest.fixture
def at() -> Controller:
    return Controller.of_a_drive()


@pytest.fixture
def homed() -> Controller:
    controller = Controller.of_a_drive()
    controller.home()
    return controller


# --- power -----------------------------------------------------------------------------------


def test_power_comes_with_a_rising_bit_and_takes_its_time(at: Controller) -> None:
    at.write(*RUN, ON)
    assert not at.zsw1(2)
    at.wait(0.05)
    assert at.zsw1(2)


def test_nothing_happens_without_control_by_plc(at: Controller) -> None:
    at.write(1, 2, 3, 4, 5, ON)
    at.wait(0.1)
    assert not at.zsw1(2)


@pytest.mark.parametrize("missing", [ON, 1, 2, 3])
def test_each_bit_of_the_power_chain_takes_power_away(homed: Controller, missing: int) -> None:
    homed.write(*RUN, ON, TASK, target=50_000)
    homed.wait(0.5)
    homed.write(*(bit for bit in (*RUN, ON, TASK) if bit != missing), target=50_000)
    assert not homed.zsw1(2)
    homed.wait(0.5)
    stands = homed.position
    homed.wait(0.2)
    assert homed.position == stands
    homed.write(*RUN, ON)
    homed.wait(0.1)
    assert homed.zsw1(2) is (missing == ON), "only a rising ON brings it back"


def test_all_zeros_take_power_away(homed: Controller) -> None:
    homed.drive.write(0, [0] * 28, "test")
    assert not homed.zsw1(2)


# --- homing ----------------------------------------------------------------------------------


def test_homing_finds_the_reference(at: Controller) -> None:
    at.enable()
    assert at.position == 47_500, "10 mm from home and wrong by 37.5"
    at.write(*RUN, ON, HOME)
    assert at.words[1] >> 11 & 1
    assert not at.zsw1(11)
    at.wait(1.0)
    assert at.zsw1(11)
    assert at.position == 0
    assert not at.words[1] >> 11 & 1


def test_homing_that_is_broken_off_leaves_the_axis_unhomed(at: Controller) -> None:
    at.enable()
    at.write(*RUN, ON, HOME)
    at.wait(0.1)
    at.write(*RUN, ON)
    at.wait(2.0)
    assert not at.zsw1(11)
    assert at.zsw1(13)


def test_homing_into_an_obstacle_is_a_fault(at: Controller) -> None:
    at.enable()
    at.drive.axis.jammed = True
    at.write(*RUN, ON, HOME)
    at.wait(1.0)
    assert at.fault == 58
    assert not at.zsw1(11)


# --- tasks -----------------------------------------------------------------------------------


def test_an_absolute_move(homed: Controller) -> None:
    homed.write(*RUN, ON, TASK, target=30_000)
    assert homed.zsw1(12)
    assert not homed.zsw1(10)
    assert not homed.zsw1(13)
    homed.wait(0.7)
    assert homed.zsw1(13) is False
    assert struct.unpack("<i", struct.pack("<HH", *homed.words[7:9]))[0] == pytest.approx(
        20 / 1000 * 0x40000000, rel=1e-6
    )
    homed.wait(1.0)
    assert homed.zsw1(10)
    assert homed.zsw1(13)
    assert homed.position == 30_000


def test_a_level_is_no_task(homed: Controller) -> None:
    homed.write(*RUN, ON, TASK, target=30_000)
    homed.wait(3)
    homed.write(*RUN, ON, TASK, target=10_000)
    homed.wait(3)
    assert homed.position == 30_000, "without continuous update only a rising bit counts"
    homed.write(*RUN, ON, target=10_000)
    assert not homed.zsw1(12)
    homed.write(*RUN, ON, TASK, target=10_000)
    homed.wait(3)
    assert homed.position == 10_000


def test_continuous_update_changes_a_running_task(homed: Controller) -> None:
    for target in (30_000, 5_000, 20_000):
        homed.write(*RUN, ON, TASK, target=target, pos_stw1=0x9100)
        assert homed.zsw1(12)
        homed.wait(0.3)
    homed.wait(3)
    assert homed.position == 20_000
    assert len(homed.bench.reported("move")) == 1, "one task"


def test_a_task_before_homing_is_not_taken(at: Controller) -> None:
    at.enable()
    before = at.position
    at.write(*RUN, ON, TASK, target=60_000)
    assert not at.zsw1(12)
    at.wait(1)
    assert at.position == before


def test_rejecting_a_task_is_a_controlled_stop(homed: Controller) -> None:
    homed.write(*RUN, ON, TASK, target=50_000, rate=0x1000)
    homed.wait(1.0)
    before = homed.position
    homed.write(*(bit for bit in RUN if bit != 4), ON, rate=0x1000)
    assert not homed.zsw1(12)
    homed.wait(0.5)
    assert homed.zsw1(13)
    assert homed.position - before == pytest.approx(20**2 / 2 / 250 * 1000, abs=2)
    assert homed.zsw1(2), "under power"


def test_a_pause_keeps_the_task(homed: Controller) -> None:
    homed.write(*RUN, ON, TASK, target=40_000)
    homed.wait(0.5)
    homed.write(*(bit for bit in RUN if bit != 5), ON, TASK, target=40_000)
    homed.wait(1)
    paused = homed.position
    assert paused < 40_000
    homed.wait(1)
    assert homed.position == paused
    homed.write(*RUN, ON, TASK, target=40_000)
    homed.wait(3)
    assert homed.position == 40_000


PAUSE = tuple(bit for bit in RUN if bit != 5)


def test_homing_takes_the_place_of_a_paused_task(homed: Controller) -> None:
    homed.write(*RUN, ON, TASK, target=40_000)
    homed.wait(0.5)
    homed.write(*PAUSE, ON, TASK, target=40_000)
    homed.write(*PAUSE, ON, HOME)
    homed.write(*RUN, ON, HOME)
    homed.wait(3)
    assert homed.zsw1(11), "homed"
    assert homed.position == 0


def test_a_paused_task_waits_for_a_speed_too(homed: Controller) -> None:
    homed.write(*RUN, ON, TASK, target=40_000)
    homed.wait(0.5)
    homed.write(*PAUSE, ON, TASK, target=40_000)
    homed.wait(1)
    paused = homed.position
    homed.write(*RUN, ON, TASK, target=40_000, speed=0)
    homed.wait(1)
    assert homed.position == paused
    homed.write(*RUN, ON, TASK, target=40_000)
    homed.wait(3)
    assert homed.position == 40_000


def test_override_and_acceleration_are_shares(homed: Controller) -> None:
    homed.write(*RUN, ON, TASK, target=90_000, speed=100_000, rate=0x0666)
    homed.wait(0.2)
    assert homed.drive.velocity_mm_s(homed.bench.now_us) == pytest.approx(100 * 0.2, rel=0.01)


# --- jogging ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("bit", "way"), [(8, 1), (9, -1)])
def test_jogging_lasts_as_long_as_its_bit(homed: Controller, bit: int, way: int) -> None:
    homed.write(*RUN, ON, TASK, target=40_000)
    homed.wait(4)
    homed.write(*RUN, ON)
    homed.write(*RUN, ON, bit)
    homed.wait(1)
    assert homed.words[1] >> 10 & 1
    assert homed.drive.velocity_mm_s(homed.bench.now_us) == pytest.approx(10 * way)
    homed.write(*RUN, ON, 8, 9)
    homed.wait(0.5)
    assert not homed.words[1] >> 10 & 1
    assert homed.zsw1(13)
    assert homed.position == pytest.approx(40_000 + way * 10_000, abs=100)


def test_jogging_ends_at_a_software_limit_and_without_a_reference_at_the_switch() -> None:
    homed, unhomed = Controller.of_a_drive(), Controller.of_a_drive()
    homed.home()
    unhomed.enable()
    for axis in (homed, unhomed):
        axis.write(*RUN, ON, 9)
        axis.wait(5)
    assert (homed.position, homed.fault) == (-5_000, 0)
    assert unhomed.fault == 114


def test_a_rejected_task_ends_jogging_too(homed: Controller) -> None:
    homed.write(*RUN, ON, 8)
    homed.wait(0.5)
    homed.write(*(bit for bit in RUN if bit != 4), ON, 8)
    homed.wait(0.5)
    assert homed.zsw1(13)


# --- limits and faults -----------------------------------------------------------------------


@pytest.mark.parametrize(("target", "number"), [(-6_000, 109), (106_000, 110)])
def test_a_target_beyond_a_software_limit(homed: Controller, target: int, number: int) -> None:
    homed.write(*RUN, ON, TASK, target=target)
    homed.wait(1)
    assert homed.fault == number
    assert homed.position == 0


@pytest.mark.parametrize(("target", "number"), [(-9_000, 114), (120_000, 115)])
def test_a_limit_switch(homed: Controller, target: int, number: int) -> None:
    homed.write(*RUN, ON, TASK, target=target, pos_stw2=0x8000)
    homed.wait(7)
    assert homed.fault == number
    assert not homed.zsw1(2)
    assert homed.words[1] >> (8 if target < 0 else 9) & 1


def test_contradictory_software_limits(homed: Controller) -> None:
    homed.drive.write(0, [0] * 28, "test")
    assert homed.set_parameter(11584, struct.pack("<q", 50)) == 0x10
    assert homed.set_parameter(11585, struct.pack("<q", 40)) == 0x10
    homed.enable()
    homed.write(*RUN, ON, TASK, target=45)
    assert homed.fault == 113


def test_following_error(homed: Controller) -> None:
    homed.bench.wall_mm = 10.0
    homed.write(*RUN, ON, TASK, target=50_000)
    homed.wait(3)
    assert homed.fault == 126
    assert 11.9 < homed.position / 1000 < 12.1, "200 N against 100 N/mm"


def test_travel_to_a_fixed_stop_is_no_fault(homed: Controller) -> None:
    homed.drive.write(0, [0] * 28, "test")
    assert homed.set_parameter(12168, struct.pack("<f", 30.0)) == 0x10
    homed.enable()
    homed.bench.wall_mm = 10.0
    homed.write(*RUN, ON, TASK, target=50_000, stw2=1 << 8)
    homed.wait(3)
    assert (homed.fault, homed.zsw1(10)) == (0, True)
    assert homed.words[2] >> 12 & 0b111 == 0b111
    assert 10.3 <= homed.position / 1000 < 10.33


def test_a_stop_not_found_is_a_warning(homed: Controller) -> None:
    homed.write(*RUN, ON, TASK, target=5_000, stw2=1 << 8)
    homed.wait(2)
    assert (homed.fault, homed.words[10], homed.zsw1(7)) == (0, 279, True)


def test_a_fault_needs_a_rising_acknowledge_and_then_a_rising_on(homed: Controller) -> None:
    homed.drive.trip(118)
    assert (homed.fault, homed.zsw1(3), homed.zsw1(2), homed.zsw1(6)) == (118, True, False, True)
    homed.write(*RUN, ON)
    homed.wait(0.1)
    assert homed.zsw1(3)
    homed.write(*RUN, ON, ACK)
    homed.wait(0.1)
    assert (homed.zsw1(3), homed.zsw1(2)) == (False, False)
    homed.write(*RUN)
    homed.write(*RUN, ON)
    homed.wait(0.1)
    assert homed.zsw1(2)
    assert homed.zsw1(11), "a fault does not cost the reference"


# --- faults ----------------------------------------------------------------------------------


def with_faults(*faults: MoveFault) -> Controller:
    at = Controller.of_a_drive(faults=faults)
    at.home()
    return at


def test_a_fault_comes_at_its_time_without_a_poll() -> None:
    at = with_faults(
        DriveFault(device="stage_z", kind="drive-fault", move=1, after_s=0.5, code=115),
        AxisFault(device="stage_z", kind="reference-lost", move=1, after_s=0.2),
    )
    at.write(*RUN, ON, TASK, target=50_000)
    begun = at.bench.now_us
    at.bench.now_us += 2_000_000
    assert at.drive.velocity_mm_s(begun + 499_000) == pytest.approx(20)
    assert at.drive.velocity_mm_s(begun + 530_000) == 0
    assert (at.fault, at.zsw1(11)) == (115, False)


def test_a_fault_waits_for_its_task_and_a_changed_task_is_the_same() -> None:
    at = with_faults(DriveFault(device="stage_z", kind="drive-fault", move=2, after_s=0.1))
    for target in (10_000, 12_000, 14_000):
        at.write(*RUN, ON, TASK, target=target, pos_stw1=0x9100)
        at.wait(1)
    assert at.fault == 0
    at.write(*RUN, ON)
    at.write(*RUN, ON, TASK, target=20_000)
    at.wait(0.2)
    assert at.fault == 126


def test_a_fault_waits_for_the_task_of_another_axis() -> None:
    at = with_faults(DriveFault(device="stage_z", kind="drive-fault", move=1, of="stage_x"))
    at.write(*RUN, ON, TASK, target=10_000)
    at.wait(0.1)
    assert at.fault == 0
    at.bench.tasks.begin("stage_x", at.bench.now_us)
    at.wait(0.1)
    assert at.fault == 126


def test_a_fault_of_no_task_comes_at_its_bench_time() -> None:
    at = with_faults(DriveFault(device="stage_z", kind="drive-fault", after_s=5.0, code=58))
    at.wait(5.0 - at.bench.now_us * 1e-6 - 0.02)
    assert at.fault == 0
    at.wait(0.03)
    assert at.fault == 58


def test_an_axis_that_turns_slow_arrives_later_and_stays_slow() -> None:
    at = with_faults(SlowAxis(device="stage_z", kind="slow", move=1, after_s=0.5, share=0.25))
    at.write(*RUN, ON, TASK, target=20_000)
    at.wait(0.4)
    assert at.drive.velocity_mm_s(at.bench.now_us) == pytest.approx(20)
    at.wait(0.4)
    assert at.drive.velocity_mm_s(at.bench.now_us) == pytest.approx(5)
    at.wait(3)
    assert (at.position, at.fault) == (20_000, 0)
    at.write(*RUN, ON)
    at.write(*RUN, ON, TASK, target=0)
    at.wait(1)
    assert at.drive.velocity_mm_s(at.bench.now_us) == pytest.approx(-5)


def test_a_limit_switch_that_closes_stops_the_axis_on_its_way() -> None:
    at = with_faults(AxisFault(device="stage_z", kind="limit-switch", move=2, after_s=0.5))
    at.write(*RUN, ON, TASK, target=20_000)
    at.wait(2)
    at.write(*RUN, ON)
    at.write(*RUN, ON, TASK, target=0)
    at.wait(1)
    assert at.fault == 114, "the negative one: it went down"
    assert at.position == pytest.approx(10_000, abs=400)


def test_a_runaway_axis_passes_its_target_and_obeys_no_other_until_it_is_stopped() -> None:
    at = with_faults(AxisFault(device="stage_z", kind="runaway", move=1, after_s=0.2))
    at.write(*RUN, ON, TASK, target=10_000)
    at.wait(1)
    at.write(*RUN, ON, TASK, target=5_000, pos_stw1=0x9100)
    at.wait(0.5)
    assert at.drive.velocity_mm_s(at.bench.now_us) == pytest.approx(20)
    assert at.position > 25_000
    at.write(1, 2, 3, 5, PLC, ON)
    at.wait(0.1)
    assert at.drive.velocity_mm_s(at.bench.now_us) == 0
    at.write(*RUN, ON)
    at.write(*RUN, ON, TASK, target=10_000)
    at.wait(3)
    assert at.position == 10_000


def test_a_stuck_axis_is_a_following_error_for_ever() -> None:
    at = with_faults(AxisFault(device="stage_z", kind="stuck", move=1, after_s=0.5))
    at.write(*RUN, ON, TASK, target=50_000)
    at.wait(2)
    stands = at.position
    assert at.fault == 126
    at.write(*RUN, ACK)
    at.write(*RUN, ON)
    at.wait(0.1)
    at.write(*RUN, ON, TASK, target=50_000)
    at.wait(2)
    assert at.fault == 126
    assert at.position == pytest.approx(stands, abs=20)


def test_a_load_may_ask_the_drive_where_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """A film that creeps wants to know where it was pressed a moment ago."""
    plain, curious = Controller.of_a_drive(), Controller.of_a_drive()
    asked: list[float] = []

    def load(axis: str, position_mm: float, t_us: int) -> float:
        asked.append(curious.drive.position_mm(t_us - 500))
        return -100.0 * max(0.0, position_mm - 10.0)

    monkeypatch.setattr(curious.bench, "load_N", load)
    plain.bench.wall_mm = 10.0
    for at in (plain, curious):
        at.home()
        at.write(*RUN, ON, TASK, target=50_000)
        at.bench.now_us += 3_000_000
        assert at.fault == 126
    assert curious.position == plain.position
    assert len(asked) > 50, "asked more and more often as the force limit comes near"


# --- the communication time-out --------------------------------------------------------------


def test_silence_stops_the_axis_when_the_time_is_up_and_not_later(homed: Controller) -> None:
    homed.drive.write(400, [500, 0], "test")
    homed.write(*RUN, ON, TASK, target=90_000)
    begun = homed.bench.now_us
    homed.bench.now_us += 3_000_000  # nobody asks for three seconds
    drive = homed.drive
    assert drive.velocity_mm_s(begun + 499_000) == pytest.approx(20)
    assert drive.velocity_mm_s(begun + 530_000) == 0, "20 mm/s at 1000 mm/s^2: 20 ms"
    assert homed.fault == 391
    assert not homed.zsw1(2)
    assert drive.position_mm(homed.bench.now_us) < 11


@pytest.mark.parametrize("address", [100, 0, 400, 503])
def test_any_request_feeds_the_time_out(homed: Controller, address: int) -> None:
    homed.drive.write(400, [500, 0], "test")
    for _ in range(10):
        homed.bench.now_us += 450_000
        homed.drive.read(address, 1, "test")
    assert homed.fault == 0


def test_a_late_request_does_not_heal(homed: Controller) -> None:
    homed.drive.write(400, [500, 0], "test")
    homed.bench.now_us += 501_000
    assert homed.fault == 391


def test_without_control_a_silent_client_is_not_missed(at: Controller) -> None:
    at.drive.write(400, [500, 0], "test")
    at.bench.now_us += 10_000_000
    assert at.fault == 0


# --- registers -------------------------------------------------------------------------------


def test_the_time_out_reads_back_and_is_a_parameter(at: Controller) -> None:
    at.drive.write(400, [500, 0], "test")
    assert list(at.drive.read(400, 2, "test")) == [500, 0]
    assert at.parameter(4854) == struct.pack("<f", 500.0)


def test_parameters(at: Controller) -> None:
    assert at.parameter(3490) == b"\x6f\x00"
    assert at.parameter(2021, 5) == b"SIMZ1"
    assert at.parameter(12698) == bytes([0, 0, 1, 0xFA]), "micrometres"
    assert at.parameter(12699) == bytes([0, 3, 1, 0xFA]), "micrometres per second"
    assert at.parameter(1) == 3, "no such parameter"


@pytest.mark.parametrize("value", [0.0, -5.0, float("nan"), float("inf")])
def test_a_senseless_torque_is_refused(at: Controller, value: float) -> None:
    assert at.set_parameter(12168, struct.pack("<f", value)) == 3
    assert at.parameter(12168) == struct.pack("<f", 100.0)


def test_a_parameter_of_the_wrong_length_or_read_only_is_refused(at: Controller) -> None:
    assert at.set_parameter(12168, b"\0\0") == 3
    assert at.set_parameter(12698, b"\0\0\0\0") == 3


@pytest.mark.parametrize(("address", "count"), [(28, 1), (0, 29), (99, 2), (127, 2), (700, 1)])
def test_registers_that_are_none(at: Controller, address: int, count: int) -> None:
    with pytest.raises(ModbusError):
        at.drive.read(address, count, "test")
    with pytest.raises(ModbusError):
        at.drive.write(address, [0] * count, "test")


def test_the_input_image_cannot_be_written(at: Controller) -> None:
    with pytest.raises(ModbusError):
        at.drive.write(100, [1], "test")


def test_the_log_names_who_commanded_what() -> None:
    at = Controller.of_a_drive(name="stage_x")
    at.home()
    at.by = "modbus#2"
    at.write(*RUN, ON, TASK, target=30_000)
    move = {"target_mm": 30.0, "speed_mm_s": 20.0}
    assert at.bench.entries[-1] == ("stage_x", "move", move, "modbus#2")
    at.wait(3)
    assert at.bench.entries[-1] == ("stage_x", "at-rest", 30.0, "drive")
