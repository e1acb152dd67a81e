"""What the CMMT driver refuses when it connects."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import pytest
from pydantic import ValidationError
from stages.festo import OWN, service

from drivers.festo_cmmt.driver import FestoCmmtSettings
from rig.core.errors import InstrumentError


def test_another_make_is_refused() -> None:
    with service() as it:
        it.drive.identity.update({0: "ACME", 1: "T-1000", 4: "toaster", 5: "T-1000"})
        with pytest.raises(InstrumentError, match="ACME T-1000") as caught:
            it.connect()
        assert "expected" in str(caught.value.hint)


def test_another_telegram_is_refused() -> None:
    with service() as it:
        assert it.drive.parameters.values[3490] == b"\x6f\x00"
        it.drive.parameters.values[3490] = struct.pack("<H", 9)
        with pytest.raises(InstrumentError, match="telegram 9"):
            it.connect()


@pytest.mark.parametrize(
    ("drive", "words"),
    [
        ({"position_unit_mm": 0.01}, "the drive's unit is 0.01 mm, not 0.001 mm"),
        ({"speed_unit_mm_s": 0.01}, "the drive's unit is 0.01 mm/s, not"),
        ({"position_unit_mm": 1.0}, "the drive's unit is 1 mm, not 0.001 mm"),
    ],
)
def test_another_unit_is_refused(drive: dict[str, float], words: str) -> None:
    with service(drive=drive) as it, pytest.raises(InstrumentError, match=words) as caught:
        it.connect()
    (setting,) = drive
    assert caught.value.hint == f"correct {setting} in the bench file"


@pytest.mark.parametrize(("parameter", "code"), [(12698, 0xFD41_0000), (12699, 0xFD01_4700)])
def test_a_unit_that_is_not_one_of_metres_is_refused(parameter: int, code: int) -> None:
    """Degrees, and metres per minute."""
    with service() as it:
        it.drive.parameters.values[parameter] = struct.pack("<I", code)
        with pytest.raises(InstrumentError, match=f"{code:#010x} .CiA 402., which cannot be"):
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
        other = b"\x07" * len(it.drive.parameters.values[number])
        write = it.wire.write

        def keep_another(address: int, values: Sequence[int], by: str) -> None:
            write(address, values, by)
            if (address, values[0]) == (503, 2):
                it.drive.parameters.values[number] = other

        it.wire.write = keep_another  # type: ignore[method-assign]
        reported = rf"write parameter {number}: set to \w+ but reads back {other.hex()}"
        with pytest.raises(InstrumentError, match=reported) as caught:
            it.connect()
        assert caught.value.hint


def test_connecting_stops_what_an_earlier_run_left_moving() -> None:
    with service() as it:
        it.homed().start_move(70.0, 10.0)
        it.connect()
        assert it.speed == 0
        assert it.drive.enabled


@pytest.mark.parametrize(
    ("change", "reported"),
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
def test_settings_that_are_refused(change: dict[str, Any], reported: str) -> None:
    with pytest.raises(ValidationError, match=reported):
        FestoCmmtSettings(**{**OWN, **change})
