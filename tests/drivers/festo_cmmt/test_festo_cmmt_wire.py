"""What the CMMT driver sends, word for word, and what it does when the wire breaks."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from stages.festo import TIMEOUT_S, break_wire, service

from drivers.simulated.transports.modbus_tcp import ModbusError
from rig.core.errors import InstrumentError, InstrumentTimeoutError


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
        reported = f"no answer within {TIMEOUT_S:g} s"
        with pytest.raises(InstrumentTimeoutError, match=reported) as caught:
            it.connect()
        assert f"127.0.0.1:{it.server.port}" in str(caught.value.hint)
        assert it.clock.now() == pytest.approx(TIMEOUT_S)


def test_a_time_out_inside_a_keep_alive_ends_the_wait_once() -> None:
    with service(timeout_s=TIMEOUT_S) as it:
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
    fault = {"kind": kind, "command": "FC16 0", "at": 5 + at}
    with service(fault, communication_timeout_ms=5000) as it:  # longer than the link's own
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
