"""The rotary stage's driver on the wire, word for word, and against the simulated stage, with what
can go wrong; angles are judged by the World."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest
from patience import TIMEOUT_S
from pydantic import ValidationError
from stages.zaber import OWN, Service, saying, service, signed, suffering

from drivers.simulated.ports import Exchange
from drivers.zaber_rst import driver as zaber_rst
from drivers.zaber_rst import link
from drivers.zaber_rst.driver import ZaberAxis, ZaberRstSettings
from drivers.zaber_rst.frames import ZaberFrameError, command, reply
from rig.core.errors import InstrumentError, InstrumentTimeoutError, LimitError

TURNED_deg = 0.02

# --- messages --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sent", "reported"),
    [
        ((0, 0, 1, ""), b"/0 0 01:FF\n"),
        ((1, 1, 0, "get pos"), b"/1 1 00 get pos:2C\n"),
        ((1, 1, 17, ""), b"/1 1 17:F6\n"),
        ((1, 1, 4, "home"), b"/1 1 04 home:31\n"),
        ((1, 1, 8, "move abs 6000 1000 100"), b"/1 1 08 move abs 6000 1000 100:51\n"),
    ],
)
def test_commands_are_those_of_the_vendors_client(sent: Any, reported: bytes) -> None:
    assert command(*sent) == reported


def test_a_reply_tells_status_flag_and_data() -> None:
    reported = reply(signed(b"@01 1 07 OK BUSY NI 22400"))
    assert reported is not None
    assert (reported.device, reported.axis, reported.message_id) == (1, 1, 7)
    assert (reported.accepted, reported.busy, reported.flag, reported.data) == (
        True,
        True,
        "NI",
        "22400",
    )


@pytest.mark.parametrize("line", [b"#01 1 07 some words", b"!01 1 IDLE --"])
def test_information_and_alerts_answer_nothing(line: bytes) -> None:
    assert reply(signed(line)) is None


@pytest.mark.parametrize(
    "line",
    [
        b"@01 1 07 OK BUSY NI 22400\r\n",
        b"@01 1 07 OK BUSY NI 22401:5C\r\n",
        b"\r\n",
        b"garbage\r\n",
        signed(b"@01 1 7 OK BUSY NI 22400"),
        signed(b"@01 1 07 OK BUSY NI"),
        signed(b"@01 1 07 YES BUSY NI 0"),
    ],
)
def test_a_message_that_is_not_sound_is_reported(line: bytes) -> None:
    with pytest.raises(ZaberFrameError, match=r"checksum|not a reply"):
        reply(line)


def test_the_rest_of_a_message_that_was_cut_short_does_not_spoil_the_next() -> None:
    reported = reply(b"@01 1 06 OK ID" + signed(b"@01 1 07 OK IDLE -- 5"))
    assert reported is not None
    assert (reported.message_id, reported.data) == (7, "5")


# --- connecting ------------------------------------------------------------------------------

LIMITS = ("limit.min -32000", "limit.max 576000", "maxspeed 524288", "accel 1048")


def test_connecting_word_for_word() -> None:
    with service() as it:
        axis = it.connect()
        limits = []
        for limit in LIMITS:
            name = limit.split()[0]
            limits += [f"get {name}", f"set {limit}", f"get {name}"]
        assert it.wire.heard() == [
            "get deviceid", "get system.serial", "get version", "get limit.cycle.dist",
            "get system.axiscount", "get resolution", "get limit.cycle.dist", "get encoder.pos",
            "get encoder.pos", *limits, "warnings",
        ]  # fmt: skip
        assert axis.identity.serial_number == "SIM00001"
        assert axis.identity.simulated
        assert axis.limits()["acceleration"].low == pytest.approx(0.9537, abs=1e-4)


def test_a_port_that_opens_slowly_leaves_the_whole_time_out_to_the_answer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def slowly(path: str, baudrate: int, timeout_s: float) -> link.Port:
        port = open_port(path, baudrate, timeout_s)
        time.sleep(1.2 * timeout_s)
        return port

    open_port = link.open_port
    monkeypatch.setattr(link, "open_port", slowly)
    with service(timeout_s=TIMEOUT_S) as it:
        assert it.connect().identity.serial_number == "SIM00001"


def test_connecting_again_writes_nothing() -> None:
    with service() as it:
        it.connect().close()
        it.wire.heard()
        it.connect()
        assert not any(words.startswith(("set", "move", "home")) for words in it.wire.heard())


@pytest.mark.parametrize("name", ["limit.min", "limit.max", "maxspeed", "accel"])
def test_a_limit_that_the_stage_does_not_keep_ends_the_connection(name: str) -> None:
    with service() as it:
        it.wire.forged[f"get {name}"] = saying("77")
        with pytest.raises(InstrumentError, match=f"set {name}: set to .* but reads back 77"):
            it.connect()
        assert it.stage.speed_deg_s(it.bench.now_us) == 0


@pytest.mark.parametrize(
    ("stage", "own", "words"),
    [
        ({"resolution": 128}, {}, "128 microsteps in a full step, the bench file says 64"),
        ({}, {"microstep_deg": 0.000234375}, "a microstep is 0.00015625 deg, not 0.000234375 deg"),
        ({"firmware": "7.11"}, {}, "firmware 7.11.*7.25 or later is expected"),
        ({"turn_microsteps": 0}, {}, "SIM00001.*not a rotary stage"),
        ({}, {"axis": 2}, "rejected with BADAXIS|has no axis 2; it has 1"),
    ],
)
def test_a_stage_that_the_bench_file_does_not_describe_is_refused(
    stage: dict[str, Any], own: dict[str, Any], words: str
) -> None:
    with service(stage=stage, **own) as it:
        with pytest.raises(InstrumentError) as caught:
            it.connect()
        assert re.search(words, caught.value.one_line())
        assert not any(said.startswith(("set", "stop")) for said in it.wire.heard())


def test_a_stage_that_does_not_tell_its_turn_is_known_by_its_resolution() -> None:
    with service(stage={"turn_microsteps": None}) as it:
        axis = it.homed()
        axis.turn_to(10.0, 20.0, 100.0)
        assert it.angle == pytest.approx(10.0, abs=TURNED_deg)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"port": "socket://localhost"}, "socket://HOST:NUMBER"),
        ({"low_limit_deg": 90.0}, "low_limit_deg = 90 deg must be below"),
        ({"high_limit_deg": 1e6}, "high_limit_deg = 1e\\+06 deg do not fit .* reach .* deg"),
        ({"max_speed_deg_s": 1e-5}, "max_speed_deg_s = 1e-05 deg/s is below .*, 9.54e-05 deg/s"),
        ({"max_acceleration_deg_s2": 0.9}, "max_acceleration_deg_s2 = 0.9 deg/s.2 is below"),
        ({"angle_tolerance_deg": 1e-4}, "0.0001 deg is below one microstep, 0.000156"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        ZaberRstSettings(**{"port": "COM5", **OWN, **wrong})


# --- turning ---------------------------------------------------------------------------------


def test_a_turn_word_for_word() -> None:
    with service() as it:
        axis = it.homed()
        axis.start_turn(3.5, 5.0, 20.0)
        assert it.wire.heard() == ["get encoder.pos", "warnings", "move abs 22400 52429 21"]
        it.clock.sleep(2.0)
        assert it.angle == 3.5
        assert not axis.moving()


def test_a_set_point_under_way_is_one_command() -> None:
    with service() as it:
        axis = it.homed()
        axis.start_turn(10.0, 5.0, 100.0)
        it.wire.heard()
        for k in range(5):
            it.clock._pass(0.01)
            axis.start_turn(10.0 + k, 10.0, 100.0)
        said = it.wire.heard()
        assert len(said) == 5
        assert all(words.startswith("move abs") for words in said)


def test_turns_end_within_two_hundredths_of_a_degree() -> None:
    """By the World's own angle; the driver's agrees with it."""
    random = np.random.default_rng(7)
    with service() as it:
        axis = it.homed()
        for angle in random.uniform(-5.0, 90.0, 20):
            axis.turn_to(float(angle), 50.0, 1000.0)
            assert abs(it.angle - angle) <= TURNED_deg
            assert abs(axis.angle_deg() - it.angle) <= 0.0002


def test_an_acceleration_outside_its_limits_sends_nothing() -> None:
    with service() as it:
        axis = it.homed()
        for asked in (2000.0, 0.5, -1.0):
            named = f"acceleration {asked:g} deg/s\\^2 is outside"
            with pytest.raises(LimitError, match=named):
                axis.start_turn(3.5, 5.0, asked)
        assert it.wire.heard() == []


def test_the_stage_itself_refuses_what_lies_beyond_its_limits() -> None:
    """The third barrier: the driver's own limit is out of the way, the stage's is not."""
    with service() as it:
        axis = it.homed()
        axis._settings = axis._settings.model_copy(update={"high_limit_deg": 200.0})
        with pytest.raises(
            InstrumentError, match=r"move abs 640000 .* rejected with BADDATA"
        ) as caught:
            axis.start_turn(100.0, 5.0, 20.0)
        assert "limit.max" in str(caught.value.hint)
        assert it.speed == 0


@pytest.mark.parametrize("reason", ["DRIVERDISABLED", "PARKED", "NONSENSE"])
def test_a_rejection_is_reported_with_its_reason_and_a_remedy(reason: str) -> None:
    fault = {"kind": "rejected", "command": "move", "reason": reason}
    with service(fault) as it:
        axis = it.homed()
        with pytest.raises(InstrumentError, match=f"rejected with {reason}: ") as caught:
            axis.start_turn(3.5, 5.0, 20.0)
        assert caught.value.hint
        axis.stop()
        axis.turn_to(3.5, 5.0, 20.0)
        assert it.angle == pytest.approx(3.5, abs=TURNED_deg)


def test_a_move_whose_answer_is_lost_is_not_repeated_and_still_watched() -> None:
    with service({"kind": "silence", "command": "move abs"}) as it:
        axis = it.homed()
        with pytest.raises(InstrumentTimeoutError):
            axis.start_turn(10.0, 5.0, 100.0)
        assert sum(words.startswith("move abs") for words in it.wire.heard()) == 1
        assert axis.moving()
        axis.start_turn(10.0, 20.0, 100.0)  # absolute: the caller may say it again
        while axis.moving():
            it.clock.sleep(0.02)
        assert it.angle == pytest.approx(10.0, abs=TURNED_deg)


def test_a_turn_whose_program_is_gone_ends_at_its_target() -> None:
    """The stage has no communication time-out: its own limits bound what it does unwatched."""
    with service() as it:
        axis = it.homed()
        axis.start_turn(10.0, 5.0, 100.0)
        axis.close()
        it.wire.heard()
        it.clock.sleep(20.0)
        assert it.angle == pytest.approx(10.0, abs=TURNED_deg)
        assert it.wire.heard() == [], "nobody keeps it alive any more"
        zaber_rst.make_safe(it.settings)
        assert it.speed == 0


def test_a_stage_without_encoder_is_read_by_its_own_count() -> None:
    with service(stage={"encoder": False}) as it:
        axis = it.homed()
        axis.turn_to(10.0, 20.0, 100.0)
        assert it.angle == pytest.approx(10.0, abs=TURNED_deg)
        assert it.wire.heard()[-1] == "get pos"


# --- reference, knob, faults -----------------------------------------------------------------


def test_after_power_up_it_refuses_to_turn_until_it_is_homed() -> None:
    with service() as it:
        axis = it.connect()
        assert not axis.homed()
        axis.keep_alive()  # not homed yet is no fault
        with pytest.raises(InstrumentError, match=r"reports W[RH]: ") as caught:
            axis.turn_to(3.5, 5.0, 20.0)
        assert caught.value.hint == "home it"
        assert not any(words.startswith("move") for words in it.wire.heard())
        axis.home()
        assert axis.homed()
        assert it.angle == 0.0


def test_a_knob_that_was_turned_is_reported_once_and_has_to_be_acknowledged() -> None:
    with service(stage=suffering(kind="knob", after_s=5.0, by_deg=1.0)) as it:
        axis = it.homed()
        axis.turn_to(10.0, 20.0, 100.0)
        with pytest.raises(InstrumentError, match="reports NC: its knob has been turned by hand"):
            it.clock.sleep(6.0)
        it.clock.sleep(1.0)  # reported once
        assert it.angle == pytest.approx(11.0, abs=0.001)
        assert not axis.homed()
        it.wire.heard()
        with pytest.raises(InstrumentError, match="NC"):
            axis.start_turn(3.5, 5.0, 20.0)
        assert not any(words.startswith("move") for words in it.wire.heard())
        axis.home()
        axis.turn_to(3.5, 5.0, 20.0)
        assert it.angle == pytest.approx(3.5, abs=TURNED_deg)


def test_a_knob_that_was_turned_before_is_found_at_connect() -> None:
    with service(stage={"referenced": True, **suffering(kind="knob", by_deg=1.0)}) as it:
        it.clock._pass(2.0)
        axis = it.connect()
        assert not axis.homed()
        axis.keep_alive()
        with pytest.raises(InstrumentError, match="NC"):
            axis.start_turn(3.5, 5.0, 20.0)


def test_a_flag_in_the_answer_to_a_set_point_stops_the_stage() -> None:
    with service() as it:
        axis = it.homed()
        axis.start_turn(10.0, 5.0, 100.0)
        it.stage.flags.add("WT")
        it.clock._pass(0.01)
        with pytest.raises(InstrumentError, match="WT: controller too hot"):
            axis.start_turn(20.0, 5.0, 100.0)
        it.clock._pass(0.5)
        assert it.speed == 0


def wait_for(it: Service, axis: ZaberAxis) -> None:
    """As a procedure does that wants the stage to arrive."""
    while axis.moving():
        it.clock._pass(0.02)


def sleep_beside(it: Service, axis: ZaberAxis) -> None:
    """As a procedure does that is at something else."""
    it.clock.each_slice(axis.keep_alive)
    it.clock.sleep(10.0)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ({"kind": "stuck"}, "FS: stalled, and stopped"),
        ({"kind": "warning-flag", "flag": "FD"}, "FD: the driver has disabled itself"),
        ({"kind": "warning-flag", "flag": "FQ"}, "FQ: encoder error"),
        ({"kind": "warning-flag", "flag": "FE"}, "FE: limit sensor"),
        ({"kind": "limit-switch"}, "WL: a limit sensor"),
        ({"kind": "reference-lost"}, "WR: it has no reference"),
        ({"kind": "knob"}, "NC: its knob has been turned by hand"),
        ({"kind": "runaway"}, "ran past its target"),
    ],
)
@pytest.mark.parametrize("watch", [wait_for, sleep_beside], ids=["moving", "keep-alives"])
def test_a_turn_that_is_disturbed_is_reported_with_meaning_and_remedy(
    fault: dict[str, Any], words: str, watch: Callable[[Service, ZaberAxis], None]
) -> None:
    with service(stage=suffering(move=1, after_s=0.3, **fault)) as it:
        axis = it.connect()
        axis.home()
        axis.start_turn(40.0, 10.0, 100.0)
        with pytest.raises(InstrumentError, match=words) as caught:
            watch(it, axis)
        assert caught.value.hint
        axis.stop()
        assert it.speed == 0


def test_a_stage_that_was_stopped_by_others_is_reported() -> None:
    with service() as it:
        axis = it.homed()
        axis.start_turn(10.0, 5.0, 100.0)
        it.clock.sleep(0.5)
        it.stage.answer(b"1 1 stop", "somebody")
        with pytest.raises(InstrumentError, match=r"is at rest at .* has not arrived at 10"):
            wait_for(it, axis)


def test_a_stage_that_is_too_slow_is_reported_when_it_should_have_arrived() -> None:
    with service(stage=suffering(kind="slow", share=0.05, move=1)) as it:
        axis = it.homed()
        axis.start_turn(40.0, 10.0, 100.0)
        with pytest.raises(InstrumentError, match=r"is still turning, at .* has not arrived at 40"):
            wait_for(it, axis)
        assert it.clock.now() < 10.0
        axis.stop()
        assert it.speed == 0


def test_a_disabled_driver_does_not_home() -> None:
    with service(stage=suffering(kind="warning-flag", flag="FD")) as it:
        axis = it.connect()
        with pytest.raises(InstrumentError, match="home: rejected with DRIVERDISABLED"):
            axis.home()


def test_homing_that_takes_too_long_is_reported() -> None:
    with service(homing_timeout_s=0.5) as it:
        axis = it.connect()
        with pytest.raises(InstrumentError, match=r"is still searching after 0\.5 s"):
            axis.home()


# --- the link --------------------------------------------------------------------------------


def other(place: int, text: bytes) -> Callable[[bytes], bytes]:
    """A reply with another text at a place, its check made to fit."""

    def forge(reported: bytes) -> bytes:
        body = reported.split(b":")[0]
        return signed(body[:place] + text + body[place + len(text) :])

    return forge


@pytest.mark.parametrize(
    "forge", [other(1, b"07"), other(4, b"2"), other(6, b"99")], ids=["device", "axis", "id"]
)
def test_an_answer_of_another_device_is_not_accepted(forge: Callable[[bytes], bytes]) -> None:
    with service(timeout_s=TIMEOUT_S) as it:
        axis = it.homed()
        it.wire.forged["get encoder.pos"] = forge
        with pytest.raises(InstrumentTimeoutError):
            axis.angle_deg()
        it.wire.forged.clear()
        assert axis.angle_deg() == pytest.approx(it.angle, abs=1e-3)


@pytest.mark.parametrize("kind", ["checksum", "garbage", "truncate", "silence", "stale", "double"])
def test_a_corrupt_answer_is_reported_and_the_next_one_is_right(kind: str) -> None:
    fault = {"kind": kind, "command": "get encoder.pos", "at": 20}
    with service(fault, stage={"referenced": True}) as it:
        axis = it.connect()
        failures = 0
        for k in range(40):
            it.clock._pass(0.05)
            if k == 10:
                axis.start_turn(60.0, 10.0, 100.0)
            try:
                assert axis.angle_deg() == pytest.approx(it.angle, abs=1e-3), k
            except InstrumentError:
                failures += 1
        assert failures == (0 if kind == "double" else 1)


def test_a_dead_stage_is_reported_and_cannot_be_made_safe() -> None:
    with service(timeout_s=TIMEOUT_S) as it:
        axis = it.connect()
        it.server.instrument = Dead()
        with pytest.raises(InstrumentTimeoutError, match=f"no answer within {TIMEOUT_S:g} s"):
            axis.angle_deg()
        with pytest.raises(InstrumentTimeoutError, match="stop"):
            axis.make_safe()


class Dead:
    """A line with nobody on it."""

    def exchanges(self, data: bytes, by: str) -> Iterable[Exchange]:
        return ()

    def frames_until(self, now_us: int) -> bytes:
        return b""


def test_make_safe_over_a_link_that_broke_is_tried_on_a_new_one() -> None:
    with service({"kind": "close", "command": "stop", "at": 2}) as it:
        axis = it.homed()  # with the first stop
        axis.start_turn(40.0, 10.0, 100.0)
        it.clock._pass(0.3)
        axis.make_safe()
        it.clock._pass(0.5)
        assert it.speed == 0
