"""When the guard lifts z off what a dead run has left pressed, and when it does not."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from rig.bench.interlocks import InterlockSettings
from rig.core.errors import InstrumentError
from rig.instruments.roles import Limits
from rig.run.making_safe.lift import Lift, LIFT_mm_s, NotLiftedError

PARKED_mm, FIRST_mm, STANDS_mm = 5.0, 12.0, 12.44
CLEAR_mm = FIRST_mm - 0.3


class Stage:
    """A z stage that moves with its clock; positions grow towards the object."""

    def __init__(self) -> None:
        self.now_s, self.mm = 0.0, STANDS_mm
        self.is_homed = True
        self.fault_number: str | None = None
        self.timed_out = self.acknowledged = False
        self.moves: list[tuple[float, float]] = []
        self.target_mm, self.speed_mm_s = STANDS_mm, 0.0

    # clock
    def now(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds
        step_mm = self.speed_mm_s * seconds
        self.mm += max(-step_mm, min(self.target_mm - self.mm, step_mm))

    # stage
    def homed(self) -> bool:
        return self.is_homed

    def position_mm(self) -> float:
        return self.mm

    def limits(self) -> dict[str, Limits]:
        return {
            "position": Limits(0.0, 14.0, "mm", "stage_z"),
            "speed": Limits(0.001, 50.0, "mm/s", "stage_z"),
        }

    def fault(self) -> str | None:
        return self.fault_number

    def acknowledge_timeout(self) -> bool:
        self.acknowledged = True
        return self.timed_out

    def start_move(self, position_mm: float, speed_mm_s: float) -> None:
        self.moves.append((position_mm, speed_mm_s))
        self.target_mm, self.speed_mm_s = position_mm, speed_mm_s

    def moving(self) -> bool:
        return self.mm != self.target_mm

    def stop(self) -> None:
        self.target_mm = self.mm


class Door:
    """A door's contact that opens at a time."""

    def __init__(self, stage: Stage, opens_at_s: float = float("inf")):
        self._stage, self._opens_at_s = stage, opens_at_s

    def inputs_high(self, names: Sequence[str]) -> dict[str, bool]:
        return dict.fromkeys(names, self._stage.now_s < self._opens_at_s)


DOOR = InterlockSettings.model_validate({"name": "door", "input": "daq.501.0", "class": "person"})
PRESSURE = InterlockSettings.model_validate(
    {"name": "air", "input": "daq.501.0", "class": "process"}
)


def lift_of(
    stage: Any,
    contacts: tuple[InterlockSettings, ...] = (),
    reader: Any = None,
    opened: str | None = None,
    first_mm: float | None = FIRST_mm,
    until_s: float = float("inf"),
    parked_mm: float = PARKED_mm,
) -> Lift:
    fixture = SimpleNamespace(parked_mm=parked_mm, contact_from_mm=first_mm)
    settings = SimpleNamespace(fixture=fixture, interlock=contacts)
    bench: Any = SimpleNamespace(settings=settings, stage_z=stage, clock=stage)
    store: Any = SimpleNamespace(get=lambda name: SimpleNamespace(opened=opened))
    return Lift(bench, {} if reader is None else {"daq": reader}, store, until_s)


def no_force() -> float | None:
    return None


def test_z_goes_up_slowly_until_it_is_clear_of_contact() -> None:
    stage = Stage()
    lift = lift_of(stage, (DOOR,), Door(stage))
    assert lift.is_needed()
    lift.carry_out(lambda: 3.9)
    assert stage.moves == [(CLEAR_mm, LIFT_mm_s)]
    assert stage.mm == pytest.approx(CLEAR_mm)
    assert not lift.is_needed()


def test_a_stage_slower_than_the_lift_has_the_time_for_its_way() -> None:
    stage = Stage()
    slow = stage.limits() | {"speed": Limits(0.001, 0.05, "mm/s", "stage_z")}
    stage.limits = lambda: slow  # type: ignore[method-assign]
    lift_of(stage).carry_out(no_force)
    assert stage.mm == pytest.approx(CLEAR_mm)
    assert stage.now_s > 10.0


def test_without_a_contact_range_it_goes_to_the_parking_place() -> None:
    stage = Stage()
    lift_of(stage, first_mm=None).carry_out(no_force)
    assert stage.moves == [(PARKED_mm, LIFT_mm_s)]


def test_it_goes_to_a_parking_place_that_is_nearer() -> None:
    stage = Stage()
    lift_of(stage, parked_mm=CLEAR_mm + 0.1).carry_out(no_force)
    assert stage.moves == [(CLEAR_mm + 0.1, LIFT_mm_s)]


def test_no_stage_is_moved_beyond_its_limits() -> None:
    stage = Stage()
    short = stage.limits() | {"position": Limits(CLEAR_mm + 0.1, 14.0, "mm", "stage_z")}
    stage.limits = lambda: short  # type: ignore[method-assign]
    with pytest.raises(NotLiftedError, match=r"11\.7 mm is outside the limits of stage_z"):
        lift_of(stage).carry_out(no_force)
    assert stage.moves == []


def test_z_that_stands_clear_is_not_moved_and_none_is_ever_moved_deeper() -> None:
    stage = Stage()
    stage.mm = CLEAR_mm - 2.0
    assert not lift_of(stage).is_needed()


@pytest.mark.parametrize(
    ("change", "reported"),
    [
        ({"is_homed": False}, "does not know its position"),
        ({"fault_number": "126 (following error)"}, "has fault 126"),
    ],
)
def test_a_stage_that_is_lost_or_has_a_fault_is_not_moved(
    change: dict[str, Any], reported: str
) -> None:
    stage = Stage()
    vars(stage).update(change)
    with pytest.raises(NotLiftedError, match=reported):
        lift_of(stage).carry_out(no_force)
    assert stage.moves == []


def test_a_drive_that_its_own_time_out_has_stopped_is_acknowledged_and_lifted() -> None:
    stage = Stage()
    stage.fault_number, stage.timed_out = "391 (communication time-out)", True
    lift_of(stage).carry_out(no_force)
    assert stage.acknowledged
    assert stage.mm == pytest.approx(CLEAR_mm)


def test_a_stage_that_does_not_know_its_position_is_not_taken_for_clear() -> None:
    stage = Stage()
    stage.mm, stage.is_homed = 0.0, False
    assert lift_of(stage).is_needed()


def test_contacts_are_looked_at_after_a_force_sensor_that_takes_long() -> None:
    stage = Stage()

    def slow_force() -> None:
        stage.sleep(3.0)

    with pytest.raises(NotLiftedError, match="'door' is open"):
        lift_of(stage, (DOOR,), Door(stage, 2.0)).carry_out(slow_force)
    assert stage.moves == []


def test_a_lift_for_which_too_little_time_is_left_ends_with_z_stopped() -> None:
    stage = Stage()
    lift = lift_of(stage, until_s=0.2)
    with pytest.raises(NotLiftedError, match="no time was left"):
        lift.carry_out(no_force)
    assert stage.moves == []
    with pytest.raises(NotLiftedError, match=r"has come to 12\.\d\d mm and not to 11\.7 mm"):
        lift_of(stage, until_s=stage.now_s + 0.8).carry_out(no_force)
    stopped_mm = stage.mm
    stage.sleep(1.0)
    assert CLEAR_mm < stage.mm == stopped_mm


def test_a_stage_that_does_not_come_up_is_given_up() -> None:
    stage = Stage()

    def creep(seconds: float) -> None:
        stage.now_s += seconds
        assert stage.now_s < 60.0, "it is still waited for"

    stage.sleep = creep  # type: ignore[method-assign]
    with pytest.raises(NotLiftedError, match=r"has come to 12\.44 mm and not to 11\.7 mm in time"):
        lift_of(stage).carry_out(no_force)
    assert not stage.moving()


@pytest.mark.parametrize("contact", [DOOR, PRESSURE])
@pytest.mark.parametrize("opens_at_s", [0.0, 0.3])
def test_nothing_moves_while_a_contact_is_open_or_has_just_been(
    contact: InterlockSettings, opens_at_s: float
) -> None:
    stage = Stage()
    with pytest.raises(NotLiftedError, match="is open"):
        lift_of(stage, (contact,), Door(stage, opens_at_s)).carry_out(no_force)
    assert stage.moves == []


def test_a_latched_contact_or_one_that_cannot_be_read_lets_nothing_move() -> None:
    stage = Stage()
    with pytest.raises(NotLiftedError, match="'door' is latched"):
        lift_of(stage, (DOOR,), Door(stage), opened="2026-11-25T03:00").carry_out(no_force)
    with pytest.raises(NotLiftedError, match="'door' cannot be read"):
        lift_of(stage, (DOOR,)).carry_out(no_force)
    assert stage.moves == []


def test_a_door_that_opens_on_the_way_up_stops_it() -> None:
    stage = Stage()
    with pytest.raises(NotLiftedError, match="'door' is open"):
        lift_of(stage, (DOOR,), Door(stage, 0.8)).carry_out(no_force)
    stopped_mm = stage.mm
    stage.sleep(1.0)
    assert CLEAR_mm < stage.mm == stopped_mm


def test_a_force_that_rises_on_the_way_up_stops_it() -> None:
    stage = Stage()

    def force_N() -> float:  # noqa: N802 - the unit keeps its capital
        return 4.0 + 10.0 * max(0.0, 12.2 - stage.mm)  # something above z

    with pytest.raises(NotLiftedError, match=r"the force rose from 4\.0 N to"):
        lift_of(stage).carry_out(force_N)
    assert stage.mm == pytest.approx(12.1, abs=0.03)
    stage.sleep(1.0)
    assert stage.mm > 12.0


def test_a_driver_that_cannot_tell_a_fault_is_not_lifted() -> None:
    stage = Stage()
    parts = ("homed", "position_mm", "limits", "now", "sleep", "start_move", "moving", "stop")
    blind = SimpleNamespace(**{name: getattr(stage, name) for name in parts})
    with pytest.raises(NotLiftedError, match="cannot say whether it has a fault"):
        lift_of(blind).carry_out(no_force)
    assert stage.moves == []


def test_a_stage_that_fails_on_its_way_is_stopped() -> None:
    stage = Stage()

    def fails() -> bool:
        raise InstrumentError("stage_z", "move", "no answer", "look")

    stage.moving = fails  # type: ignore[method-assign]
    with pytest.raises(InstrumentError, match="no answer"):
        lift_of(stage).carry_out(no_force)
    assert stage.target_mm == stage.mm
