"""The AZ driver against the simulated pair, through pyserial and a pseudo-terminal."""

from __future__ import annotations

import os
import termios
import threading
import time
import tty
from typing import Any

import pytest
import serial
from pydantic import ValidationError
from stages.az import OWN, STEPS, service

from drivers.oriental_az import driver as oriental_az
from drivers.oriental_az.link import AzLine, BrokenAnswerError, echoing
from drivers.oriental_az.settings import OrientalAzSettings
from drivers.simulated.instruments.oriental_az import (
    HIGH_LIMIT,
    LOW_LIMIT,
    SLAVE_ERROR_RESPONSE,
    LINE_TIMEOUT_ms,
)
from drivers.simulated.transports.modbus_tcp import ILLEGAL_ADDRESS, ModbusError
from rig.core.clock import WallClock
from rig.core.errors import InstrumentError, InstrumentTimeoutError


def silent(device: str, **when: Any) -> dict[str, Any]:
    return {"device": device, "kind": "silence", **when}


# --- what goes over the line -----------------------------------------------------------------


def test_a_move_is_one_write_of_everything_and_a_change_of_it_another() -> None:
    with service() as bench:
        axis = bench.homed()
        axis.start_move(25.0, 10.0)
        axis.start_move(24.0, 10.0)
        writes = [said for said in bench.line.said if said.startswith("01 10")]
        values = "{} 00 00 27 10 00 03 0d 40 00 03 0d 40 00 00 01 2c 00 00 00 01"
        whole = "01 10 00 58 00 10 20 00 00 00 00 00 00 00 01 " + values
        without_number = "01 10 00 5a 00 0e 1c 00 00 00 01 " + values
        first, second = "00 00 61 a8", "00 00 5d c0"
        assert writes in (
            [whole.format(first), without_number.format(second)],
            [without_number.format(first), whole.format(second)],
        )
        assert bench.bench.reported("move") == [{"target_mm": 25.0, "speed_mm_s": 10.0}], (
            "the second changed the first"
        )


def test_the_line_has_its_silence_on_the_benchs_clock() -> None:
    """17 bytes at 230400 baud, 3 ms until the drive answers, 3 ms after it has."""
    with service() as bench:
        axis = bench.homed()
        bench.line.at_us.clear()
        for _ in range(50):
            axis.position_mm()
        gaps = [b - a for a, b in zip(bench.line.at_us, bench.line.at_us[1:], strict=False)]
        shortest = (8 + 21) * 11 / 230_400 * 1e6 + 6000
        assert min(gaps) == pytest.approx(shortest, abs=2)
        assert axis.limits()["update_rate"].high == pytest.approx(50.0)


def test_a_slow_line_carries_fewer_updates() -> None:
    with service(baudrate=19_200, communication_timeout_ms=2000) as bench:
        axis = bench.connect()
        assert 10 < axis.limits()["update_rate"].high < 25
        assert (
            "its line carries a poll and a new target in" in axis.limits()["update_rate"].limited_by
        )


def test_two_axes_share_one_port_and_close_it_together() -> None:
    with service() as bench:
        z, x = bench.connect("z"), bench.connect("x")
        assert z._line is x._line
        z.close()
        assert x.position_mm() == pytest.approx(47.5, abs=1e-3), "unhomed by 37.5 mm"
        x.close()
        assert AzLine._open == {}


def test_a_line_with_two_baudrates_is_refused() -> None:
    with service() as bench:
        bench.connect("z")
        wrong = bench.settings("x").model_copy(update={"baudrate": 9600})
        with pytest.raises(InstrumentError, match="is in use at 230400 baud") as caught:
            oriental_az.connect(wrong, bench.clock)
        assert "same baudrate" in str(caught.value.hint)


def test_a_port_that_cannot_do_the_parity_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """As some pseudo-terminals cannot; it is no OSError."""

    def refuse(*arguments: object, **named: object) -> None:
        raise termios.error(22, "Invalid argument")

    monkeypatch.setattr(serial, "Serial", refuse)
    with service() as bench, pytest.raises(InstrumentError, match="Invalid argument") as caught:
        bench.connect()
    assert "parity" in str(caught.value.hint)


# --- what the instrument itself keeps --------------------------------------------------------


def test_time_out_limits_and_error_reply_are_set_at_connect_and_the_stop_is_lifted() -> None:
    with service(communication_timeout_ms=700) as bench:
        bench.connect()
        values = bench.z._values
        kept = [values[one] for one in (LINE_TIMEOUT_ms, LOW_LIMIT, HIGH_LIMIT)]
        assert kept == [700, 0, 80 * STEPS]
        assert values[SLAVE_ERROR_RESPONSE] == 1
        assert values[0x7C] == 0


@pytest.mark.parametrize(
    ("register", "what"),
    [(LINE_TIMEOUT_ms, "138A"), (LOW_LIMIT, "038A"), (HIGH_LIMIT, "0388")],
)
def test_a_value_that_is_not_kept_ends_the_connection(register: int, what: str) -> None:
    with service(low_limit_mm=1.0) as bench:
        honest = bench.z._register

        def forgetful(address: int) -> int:
            return 5 if address == register + 1 else honest(address)

        bench.z._register = forgetful  # type: ignore[method-assign]
        with pytest.raises(InstrumentError, match=f"{what}h: set to .* but reads back"):
            bench.connect()
        assert AzLine._open == {}


def test_the_torque_limit_goes_with_every_motion_and_ends_one_into_something() -> None:
    """30 N against 100 N/mm: held 0.3 mm into the wall, and reported before the drive's alarm."""
    with service() as bench:
        axis = bench.homed()
        bench.bench.wall_mm = 30.0
        with pytest.raises(InstrumentError, match=r"is held back by 0\.\d+ mm at 30\.\d+ mm") as e:
            axis.move_to(40.0, 5.0)
        assert "torque_limit_percent" in str(e.value.hint)
        assert bench.z.axis.force_limit_N == 30.0
        bench.run_dry(0.2)
        assert bench.speed(bench.z) == 0
        axis.move_to(20.0, 5.0)  # its own stop is not another client's: it is lifted first
        assert axis.position_mm() == pytest.approx(20.0, abs=0.02)


def test_an_operating_current_that_the_drive_does_not_keep_ends_the_first_motion() -> None:
    with service() as bench:
        axis = bench.homed()
        operate = bench.z._operate

        def at_full_current(by: str) -> None:
            bench.z._values[0x64] = 1000
            operate(by)

        bench.z._operate = at_full_current  # type: ignore[method-assign]
        reported = "its operating current is 100 % where torque_limit_percent asks for 30 %"
        with pytest.raises(InstrumentError, match=reported):
            axis.start_move(40.0, 5.0)
        bench.run_dry(0.2)
        assert bench.speed(bench.z) == 0


def test_the_torque_shows_what_is_pressed_and_a_drive_without_it_is_asked_once() -> None:
    with service() as bench:
        axis = bench.homed()
        bench.bench.wall_mm = 30.0
        axis.move_to(29.0, 5.0)
        assert [axis.torque_percent() for _ in range(2)] == [0.0, 0.0]
        axis.move_to(30.1, 5.0)
        shown = [axis.torque_percent() for _ in range(2)]
        assert shown == pytest.approx([10.0, 10.0], abs=0.2), "10 N of 100 N, in either length"

        bench.z.read = _without_torque(bench.z.read)
        asked = len(bench.line.said)
        assert [axis.torque_percent() for _ in range(3)] == [None, None, None]
        assert len(bench.line.said) == asked + 1


def test_an_alarm_is_reported_by_number_and_meaning_before_anything_resets_it() -> None:
    with service() as bench:
        axis = bench.connect("z")
        assert axis.fault() is None
        bench.z._fail(0x30, bench.z._port.now_us)
        reported = axis.fault()
        assert reported is not None
        assert reported.startswith("30h (overload")
        assert bench.z.alarm == 0x30


def _without_torque(read: Any) -> Any:
    def refused(address: int, count: int, by: str) -> Any:
        if address + count > 0xD6:
            raise ModbusError(ILLEGAL_ADDRESS)
        return read(address, count, by)

    return refused


def test_settings_that_contradict_each_other_are_refused() -> None:
    good = {**OWN, "axis": "z", "unit_id": 1, "port": "p"}
    for change, words in (
        ({"low_limit_mm": 90.0}, "below high_limit_mm"),
        ({"max_speed_mm_s": 1000, "steps_per_mm": 50_000}, "above the drive's 4000000 steps/s"),
        ({"high_limit_mm": 3e6}, "do not fit the drive's steps"),
        ({"unit_id": 32}, "less than or equal to 31"),
        ({"baudrate": 12_345}, "baudrate"),
        ({"torque_limit_percent": 0.04}, "greater than or equal to 0.1"),
    ):
        with pytest.raises(ValidationError, match=words):
            OrientalAzSettings(**{**good, **change})


# --- stopping --------------------------------------------------------------------------------


def test_the_stop_stands_until_it_is_answered_and_the_drive_itself_refuses_to_start() -> None:
    with service() as bench:
        axis = bench.homed()
        axis.start_move(60.0, 10.0)
        axis.make_safe()
        assert bench.z._values[0x7C] == 0x20
        bench.run_dry(0.2)
        with pytest.raises(InstrumentError, match="made safe"):
            axis.start_move(60.0, 10.0)
        frame = bytes.fromhex("0110005a000e1c 00000001 00001388 00002710 00030d40 00030d40")
        words = [int.from_bytes(frame[7 + i : 9 + i], "big") for i in range(0, 20, 2)]
        with pytest.raises(Exception, match="exception 4"):
            bench.z.write(0x5A, [*words, 0, 300, 0, 1], "a late line of a procedure")
        axis.stop()
        assert bench.z._values[0x7C] == 0
        axis.move_to(20.0, 40.0)


def test_a_stop_by_another_client_is_not_overridden() -> None:
    """Another program makes the axis safe while the servo tells new targets."""
    with service() as bench:
        axis = bench.homed()
        axis.start_move(60.0, 10.0)
        bench.z.write(0x7C, [0, 0x20], "somebody")
        with pytest.raises(InstrumentError, match="not by this run"):
            axis.start_move(60.1, 10.0)
        with pytest.raises(InstrumentError, match="a stop is set in the drive, not by this run"):
            axis.start_move(60.1, 10.0)
        bench.run_dry(0.2)
        assert bench.speed(bench.z) == 0


def test_a_keep_alive_reports_a_stop_by_another_client() -> None:
    with service() as bench:
        axis = bench.homed()
        axis.start_move(60.0, 10.0)
        bench.z.write(0x7C, [0, 0x20], "somebody")
        with pytest.raises(InstrumentError, match="stopped, not by this run"):
            bench.clock.sleep(0.3)


def test_a_watchers_make_safe_is_not_kept_waiting_by_a_procedure_that_waits_for_the_line() -> None:
    """The procedure waits on a clock that stands until the watcher is done."""
    with service() as bench:
        axis = bench.homed()
        axis.start_move(60.0, 10.0)
        made_safe: list[bool] = []

        def watcher() -> None:
            axis.make_safe()
            made_safe.append(True)

        def trip() -> None:
            unregister()
            thread = threading.Thread(target=watcher)
            thread.start()
            thread.join(5)

        unregister = bench.clock.each_slice(trip)
        with pytest.raises(InstrumentError, match="made safe"):
            axis.start_move(61.0, 10.0)
        assert made_safe == [True]
        bench.run_dry(0.2)
        assert bench.speed(bench.z) == 0


def test_a_time_out_of_another_instrument_met_while_waiting_for_the_line_starves_no_drive() -> None:
    """Its keep-alive runs from the slices of that wait, and its lost answer takes 1.5 s."""
    with service() as bench:
        axis = bench.homed()

        def time_out() -> None:
            unregister()
            bench.clock.sleep(1.5)

        axis.start_move(60.0, 10.0)
        unregister = bench.clock.each_slice(time_out)
        axis.stop()
        axis.move_to(20.0, 10.0)
        assert bench.bench.reported("fault") == []


def test_a_stop_goes_out_although_the_drive_owes_an_answer() -> None:
    fault = silent("stage_z", command="FC3 198", at=3, count=0)
    with service(fault) as bench:
        axis = bench.homed()
        axis.start_move(60.0, 10.0)
        bench.clock.sleep(0.05)
        with pytest.raises(InstrumentTimeoutError):
            axis.move_to(60.0, 10.0)
        axis.make_safe()
        assert bench.z._values[0x7C] == 0x20


# --- faults of drive and axis ----------------------------------------------------------------

ALARMS = {
    "overload": ({"kind": "drive-fault", "code": 0x30}, "30h (overload)", "blocks the axis"),
    "limit switch": ({"kind": "limit-switch"}, "66h (limit switch reached)", "home again"),
    "reference lost": (
        {"kind": "reference-lost"},
        "33h (absolute position error: the axis has lost its reference)",
        "home it",
    ),
    "unknown": ({"kind": "drive-fault", "code": 0x7E}, "7Eh (see the drive's manual)", "look the"),
}


@pytest.mark.parametrize("what", ALARMS)
def test_an_alarm_is_reported_with_its_meaning_and_remedy(what: str) -> None:
    fault, words, remedy = ALARMS[what]
    with service({"device": "stage_z", "move": 1, "after_s": 0.5, **fault}) as bench:
        axis = bench.homed()
        with pytest.raises(InstrumentError) as caught:
            axis.move_to(60.0, 10.0)
        assert f"stage_z: drive alarm: {words}" in caught.value.message
        assert remedy in str(caught.value.hint)
        with pytest.raises(InstrumentError, match="drive alarm"):
            axis.start_move(20.0, 10.0)
        axis.stop()
        assert bench.speed(bench.z) == 0
        bench.clock.sleep(1.0)  # reported once: other waits go on


def test_an_alarm_of_before_is_reset_at_the_first_motion() -> None:
    with service() as bench:
        first = bench.connect()
        first.home()
        first.close()
        bench.run_dry(1.0)  # longer than the communication time-out
        assert bench.z.alarm == 0
        bench.z.heard()
        assert bench.z.alarm == 0x85
        axis = bench.connect()
        axis.move_to(20.0, 40.0)
        assert bench.bench.reported("acknowledged") == [0x85]


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ({"kind": "stuck"}, "is held back by"),
        ({"kind": "runaway"}, "ran past its target"),
        ({"kind": "slow", "share": 0.05}, "has not arrived"),
    ],
)
def test_an_axis_that_goes_wrong_is_stopped(kind: dict[str, Any], words: str) -> None:
    with service({"device": "stage_z", "move": 1, "after_s": 0.3, **kind}) as bench:
        axis = bench.homed()
        with pytest.raises(InstrumentError, match=words):
            axis.move_to(20.0, 10.0)
        axis.stop()
        assert bench.speed(bench.z) == 0


def test_beyond_a_software_limit_of_the_drive_it_stops_there_and_that_is_reported() -> None:
    with service() as bench:
        axis = bench.homed()
        bench.z._values[HIGH_LIMIT] = 40 * STEPS
        with pytest.raises(InstrumentError, match="is at 40 mm and has not arrived at 60 mm"):
            axis.move_to(60.0, 40.0)


# --- two drives on one line ------------------------------------------------------------------


def test_frames_to_one_drive_feed_the_other_as_well_and_silence_stops_both() -> None:
    with service() as bench:
        z, x = bench.homed("z"), bench.homed("x")
        z.start_move(60.0, 1.0)
        x.start_move(60.0, 1.0)
        for _ in range(10):
            bench.run_dry(0.3)
            z.position_mm()
        assert bench.x.alarm == 0
        assert bench.speed(bench.x) == pytest.approx(1.0)
        bench.run_dry(0.6)
        assert [bench.speed(drive) for drive in (bench.z, bench.x)] == [0, 0]
        assert (bench.z.alarm, bench.x.alarm) == (0x85, 0x85)


def test_a_drive_whose_answers_are_lost_while_the_other_answers_is_reported() -> None:
    """Its communication time-out is fed, it goes on moving: nobody but the program can notice."""
    with service(silent("stage_x", command="FC3 124", at=60, count=0)) as bench:
        z, x = bench.homed("z"), bench.homed("x")
        x.start_move(60.0, 1.0)
        with pytest.raises(InstrumentError) as caught:
            bench.clock.sleep(60.0)
        assert caught.value.device == "stage_x"
        assert bench.speed(bench.x) == pytest.approx(1.0)
        assert z.position_mm() == pytest.approx(0.0, abs=0.01)


def test_a_keep_alive_of_either_minds_the_other() -> None:
    """x's own keep-alives do not come any more; z's notice, once."""
    with service() as bench:
        z = bench.homed("z")
        bench.connect("x")
        with pytest.raises(InstrumentError) as caught:
            bench.clock.sleep(2.0)
        error = caught.value
        assert (error.device, error.command) == ("stage_x", "keep alive")
        assert "which feeds its communication time-out" in error.cause
        assert error.hint is not None
        bench.clock.sleep(2.0)
        bench.axes[1].position_mm()
        with pytest.raises(InstrumentError, match="stage_x: keep alive"):
            bench.clock.sleep(2.0)
        assert z.position_mm() == pytest.approx(0.0, abs=0.01)


# --- the link --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "kind", ["silence", "garbage", "truncate", "stale", "double", "checksum", "error", "close"]
)
def test_an_answer_is_right_or_an_error_and_the_next_but_one_is_right(kind: str) -> None:
    """The axis moves on between two questions: an old answer would be another position."""
    code = {"code": 4} if kind == "error" else {}
    fault = {"device": "stage_z", "kind": kind, "command": "FC3 198", "at": 6, "count": 1, **code}
    with service(fault) as bench:
        z, x = bench.homed("z"), bench.homed("x")
        z.start_move(60.0, 10.0)
        failures = []
        for _ in range(20):
            try:
                seen = z.position_mm()
            except InstrumentError as failure:
                failures.append(failure.hint)
                continue
            truth = bench.z.position_mm(bench.bench.now_us)
            assert seen == pytest.approx(truth, abs=2e-3)
            assert x.position_mm() == pytest.approx(0.0, abs=2e-3)
        assert len(failures) == (0 if kind == "double" else 1)
        assert all(failures), "each tells what to do"


def test_late_answers_of_the_other_drive_are_passed_over() -> None:
    fault = {"device": "stage_x", "kind": "stale", "command": "FC3 198", "at": 2}
    with service(fault) as bench:
        z, x = bench.homed("z"), bench.homed("x")
        failures = 0
        for _ in range(10):
            for axis in (x, z):
                try:
                    assert axis.position_mm() == pytest.approx(0.0, abs=1e-3)
                except InstrumentTimeoutError:
                    failures += 1
        assert failures == 1


@pytest.mark.parametrize("stream", [b"\xaa", echoing(2, 1).frame])
def test_a_line_on_which_something_keeps_streaming_is_given_up_and_let_go(stream: bytes) -> None:
    """An instrument that streams on this port, or answers of another unit without an end."""
    ours, theirs = os.openpty()
    over = threading.Event()

    def keep_streaming() -> None:
        while not over.wait(0.001):
            os.write(ours, stream)

    streaming = threading.Thread(target=keep_streaming, daemon=True)
    line = AzLine(os.ttyname(theirs), 115_200, "N", WallClock())
    try:
        tty.setraw(theirs)
        streaming.start()
        with pytest.raises(BrokenAnswerError, match="bytes came, none of them its answer"):
            line.exchange(echoing(1, 7), timeout_s=0.3)
        with pytest.raises(BrokenAnswerError):
            line.exchange(echoing(1, 7), timeout_s=0.3, trusting=True)
    finally:
        over.set()
        streaming.join()
        line.close()
        os.close(ours)
        os.close(theirs)


def test_a_refusal_tells_the_exception_and_what_it_means() -> None:
    fault = {"device": "stage_z", "kind": "error", "code": 4, "command": "FC3 248"}
    with service(fault) as bench, pytest.raises(InstrumentError) as caught:
        bench.connect()
    assert caught.value.__cause__ is not None
    assert "exception 4: slave error" in str(caught.value.__cause__)


def test_make_safe_of_the_module_leaves_the_stop_standing() -> None:
    with service() as bench:
        axis = bench.homed()
        axis.start_move(60.0, 10.0)
        began = time.monotonic()
        released = threading.Event()

        def pass_time() -> None:
            while not released.wait(0.001):
                bench.bench.now_us += round((time.monotonic() - began) * 1e3)

        passing = threading.Thread(target=pass_time)
        passing.start()
        try:
            oriental_az.make_safe(bench.settings())
        finally:
            released.set()
            passing.join()
        assert bench.speed(bench.z) == 0
        assert bench.z._values[0x7C] == 0x20


def test_direct_inputs_are_the_last_word_of_readings_in_two_lengths() -> None:
    with service() as bench:
        axis = bench.homed()
        bench.line.said.clear()
        bench.bench.high = {("stage_z", "DIN0"), ("stage_z", "DIN9")}
        names = ("DIN0", "DIN5", "DIN9")
        assert axis.inputs_high(names) == {"DIN0": True, "DIN5": False, "DIN9": True}
        bench.bench.high = set()
        assert not any(axis.inputs_high(names).values())
        asked = [
            said for said in bench.line.said if said in ("01 03 00 ca 00 0c", "01 03 00 c8 00 0e")
        ]
        assert len(set(asked)) == 2
