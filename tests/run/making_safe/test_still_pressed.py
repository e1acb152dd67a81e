"""What the guard finds pressed, and lifts, where the force sensor answers and where it does not."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rig.bench.connected import Bench
from rig.bench.plan import BenchPlan, InstrumentPlan
from rig.bench.settings import BenchSettings
from rig.core.errors import ConfigurationError, InstrumentError
from rig.core.settings import Settings
from rig.instruments.roles import Limits
from rig.run.interlocks.store import InterlockStore
from rig.run.locks.shared_folder import VARIABLE as SHARED_FOLDER
from rig.run.making_safe.still_pressed import Orders, PressedState, _Sensor, pressed_state

FIRST_mm, CLEAR_mm, STANDS_mm, TOUCHES_mm = 12.0, 11.7, 12.44, 12.4
N_mm = 100.0
ZERO = (0.0, 0.0, 0.0)
CONTACT = {"contact_from_mm": FIRST_mm, "contact_to_mm": 13.0}
DOOR = {"name": "door", "input": "daq.501.0", "class": "person"}
DRIVER: Any = SimpleNamespace()
"""`connect` is replaced whole: what a driver does is shown where runs are killed (test_killed)."""


class Rig:
    """Clock, z stage and force sensor of a bench that was stopped."""

    def __init__(self) -> None:
        self.now_s, self.mm, self.target_mm = 0.0, STANDS_mm, STANDS_mm
        self.moves: list[float] = []
        self.off: list[str] = []
        self.tared = False

    def now(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds
        self.mm += max(-seconds, min(self.target_mm - self.mm, seconds))

    def homed(self) -> bool:
        return True

    def position_mm(self) -> float:
        return self.mm

    def fault(self) -> None:
        return None

    def acknowledge_timeout(self) -> bool:
        return False

    def start_move(self, position_mm: float, speed_mm_s: float) -> None:
        self.moves.append(position_mm)
        self.target_mm = position_mm

    def moving(self) -> bool:
        return self.mm != self.target_mm

    def stop(self) -> None:
        self.target_mm = self.mm

    def close(self) -> None:
        pass


class Frames(SimpleNamespace):
    def __len__(self) -> int:
        return 50


@dataclass
class Sensor:
    """The force sensor above such a rig; `share` of the force is what it reads, and `rest_N`."""

    rig: Rig
    share: float = 1.0
    rest_N: float = 0.0
    largest_N: float = 50.0

    def limits(self) -> dict[str, Limits]:
        return {
            "force": Limits(-self.largest_N, self.largest_N, "N", "force_sensor"),
            "rate": Limits(1.0, 1000.0, "Hz", "force_sensor"),
        }

    def tare(self, zero: object) -> None:
        pass

    def start(self, rate_S_s: float) -> float:
        return rate_S_s

    def read(self) -> Any:
        force_N = self.rest_N + self.share * max(0.0, self.rig.mm - TOUCHES_mm) * N_mm
        return Frames(force_N=np.tile([0.0, 0.0, force_N], (50, 1)))

    def stop(self) -> None:
        pass

    def close(self) -> None:
        pass


@dataclass
class Door:
    """The DAQ that reads a door's contact."""

    closed: bool = True

    def inputs_high(self, names: Sequence[str]) -> dict[str, bool]:
        return dict.fromkeys(names, self.closed)

    def close(self) -> None:
        pass


class DaqSettings(Settings):
    """Settings with an address, under which a latch is kept."""

    host: str = "127.0.0.1"
    port: int = 5025


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Rig:
    """A bench whose z presses with 4 N. `rig.sensor` and `rig.door` answer, or are the errors that
    they give; of the latter the bench has a contact only where `rig.contacts` names one."""
    found: Any = Rig()
    found.sensor, found.door, found.contacts, found.more = Sensor(found), Door(), [], {}
    limits = {"position": Limits(0.0, 14.0, "mm", "z"), "speed": Limits(0.001, 50.0, "mm/s", "z")}
    found.limits = lambda: limits
    own = {"name": "b", "fixture": {"mounted": "plate", "parked_mm": 5.0} | CONTACT}
    settings = {"stage_z": Settings(), "force_sensor": Settings(), "daq": DaqSettings()}
    parts = tuple(InstrumentPlan(role, "made-up", DRIVER, of) for role, of in settings.items())

    def plan(*_: str) -> BenchPlan:
        whole = BenchSettings.model_validate(own | {"interlock": found.contacts} | found.more)
        return BenchPlan(whole, parts, "", "b.toml")

    def connect(plan: BenchPlan, clock: object) -> Bench:
        (part,) = plan.instruments
        instruments = {"stage_z": found, "force_sensor": found.sensor, "daq": found.door}
        instrument: Any = instruments[part.role]
        if isinstance(instrument, Exception):
            raise instrument
        instrument.make_safe = lambda: found.off.append(part.role)
        links: Any = SimpleNamespace(close=lambda: None)
        return Bench(plan, found, {part.role: instrument}, links)

    module = "rig.run.making_safe.still_pressed."
    monkeypatch.setattr(f"{module}connect", connect)
    monkeypatch.setattr(f"{module}parse_bench", plan)
    monkeypatch.setattr(f"{module}WallClock", lambda: found)
    times = SimpleNamespace(monotonic=found.now, sleep=found.sleep)
    monkeypatch.setattr(f"{module}time", times)
    found.plan = plan
    return found


def test_what_is_pressed_is_lifted_and_both_are_said(rig: Any) -> None:
    state = pressed_state("", "", Orders(ZERO))
    assert state == PressedState(
        "was pressed at 12.44 mm, 4.0 N; stage_z was lifted: nothing is pressed at 11.70 mm, 0.0 N",
        released=True,
    )
    assert rig.moves == [CLEAR_mm]
    assert rig.off == ["force_sensor", "stage_z"]


def test_a_force_that_is_felt_after_the_lift_as_well_is_not_released(rig: Any) -> None:
    rig.sensor.rest_N = 2.0
    assert pressed_state("", "", Orders(ZERO)) == PressedState(
        "was pressed at 12.44 mm, 6.0 N; stage_z was lifted: still pressed at 11.70 mm, 2.0 N"
    )


def test_a_record_that_is_not_of_the_force_hides_no_force(rig: Any) -> None:
    """It may have been moved or spoilt since the run began."""
    rig.more = {"calibrations": {"film": "moved-away.json"}, "film": {"name": "A"}}
    assert "was pressed at 12.44 mm, 4.0 N;" in pressed_state("", "", Orders(ZERO)).text


def test_z_is_lifted_although_the_force_sensor_is_not_there(rig: Any) -> None:
    rig.sensor = ConfigurationError("force_sensor: no such port: /dev/ttyUSB0", "plug it in")
    state = pressed_state("", "", Orders(ZERO))
    assert rig.moves == [CLEAR_mm]
    assert state.released
    assert state.text.startswith("stage_z was at 12.44 mm; what is pressed is not known since ")
    assert "no such port: /dev/ttyUSB0" in state.text
    assert state.over_limit is None


def test_z_is_lifted_although_the_force_sensor_sends_nothing(rig: Any) -> None:
    rig.sensor.read = lambda: None
    state = pressed_state("", "", Orders(ZERO))
    assert (rig.moves, state.released) == ([CLEAR_mm], True)
    assert "too few frames" in state.text


def silent_once(rig: Any, name: str) -> None:
    """Let the first of these calls of z fail."""
    answer = getattr(rig, name)

    def fails() -> Any:
        setattr(rig, name, answer)
        raise InstrumentError("stage_z", name, "no answer", "look")

    setattr(rig, name, fails)


@pytest.mark.parametrize(("call", "moves"), [("position_mm", 1), ("moving", 2)])
def test_z_that_does_not_answer_at_once_is_lifted_all_the_same(
    rig: Any, call: str, moves: int
) -> None:
    silent_once(rig, call)
    state = pressed_state("", "", Orders(ZERO))
    assert rig.moves == [CLEAR_mm] * moves
    assert state.released
    assert state.text.endswith("stage_z was lifted: nothing is pressed at 11.70 mm, 0.0 N")


def test_a_second_try_has_only_the_time_that_the_first_has_left(rig: Any) -> None:
    silent_once(rig, "position_mm")
    state = pressed_state("", "", Orders(ZERO, within_s=0.8))
    assert state.text.endswith("not lifted: no time was left for it")
    assert rig.moves == []


def test_z_is_lifted_although_the_force_sensor_sends_no_numbers(rig: Any) -> None:
    rig.sensor.share = float("nan")
    state = pressed_state("", "", Orders(ZERO))
    assert rig.moves == [CLEAR_mm]
    assert "not known since force_sensor: it sends forces that are not finite numbers" in state.text


def test_a_pull_is_a_force_as_well(rig: Any) -> None:
    rig.sensor.share = -1.0
    assert pressed_state("", "", Orders(ZERO)).text.startswith("was pressed at 12.44 mm, 4.0 N; ")


def test_a_force_sensor_that_fails_on_the_way_up_leaves_no_force_behind(rig: Any) -> None:
    plan = rig.plan()
    links: Any = SimpleNamespace(close=lambda: None)
    sensor = _Sensor(Bench(plan, rig, {"force_sensor": rig.sensor}, links), Orders(ZERO))
    assert sensor.latest_N() == pytest.approx(4.0)

    def fails() -> None:
        raise InstrumentError("force_sensor", "read", "no answer", "look")

    rig.sensor.read = fails
    assert sensor.latest_N() is None


def test_z_that_stands_clear_says_nothing_of_a_sensor_that_cannot_be_read(rig: Any) -> None:
    rig.mm = rig.target_mm = 5.0
    rig.sensor.read = lambda: None
    state = pressed_state("", "", Orders(ZERO))
    assert (rig.moves, state.released) == ([], False)


def test_a_sensor_that_reads_nothing_where_z_stands_in_contact_is_not_believed(rig: Any) -> None:
    rig.sensor.share = 0.0
    rig.fault = lambda: "126 (following error)"
    state = pressed_state("", "", Orders(ZERO))
    assert state.text.startswith("the force sensor reads no force at 12.44 mm, 0.0 N; not lifted: ")
    assert (state.released, rig.moves) == (False, [])


@pytest.mark.parametrize("zero", [ZERO, None])
def test_a_force_over_the_limit_of_the_run_that_remains_is_reported_zeroed_or_not(
    rig: Any, zero: Any
) -> None:
    rig.fault = lambda: "126 (following error)"
    state = pressed_state("", "", Orders(zero, limit_N=3.0))
    assert state.over_limit is not None
    assert "over the limit of 3 N; not lifted: stage_z has fault 126" in state.over_limit
    assert pressed_state("", "", Orders(zero, limit_N=15.0)).over_limit is None


def test_a_force_over_the_limit_of_the_sensor_itself_is_reported_without_any_of_the_run(
    rig: Any,
) -> None:
    rig.fault = lambda: "126 (following error)"
    rig.sensor.largest_N = 3.0
    state = pressed_state("", "", Orders(ZERO))
    assert state.over_limit is not None
    assert "4.0 N, over the limit of 3 N; not lifted: " in state.over_limit


def test_nothing_moves_beside_a_person(rig: Any) -> None:
    state = pressed_state("", "", Orders(ZERO, lifts=False))
    assert state == PressedState("still pressed at 12.44 mm, 4.0 N")
    assert rig.moves == []


def test_a_defect_is_said_to_be_one(rig: Any) -> None:
    rig.position_mm = lambda: 1 / 0
    state = pressed_state("", "", Orders(ZERO))
    assert state.text.endswith("ZeroDivisionError: division by zero")


def test_z_is_lifted_behind_a_door_that_is_closed(rig: Any) -> None:
    rig.contacts = [DOOR]
    state = pressed_state("", "", Orders(ZERO))
    assert (rig.moves, state.released) == ([CLEAR_mm], True)
    assert sorted(rig.off) == ["daq", "force_sensor", "stage_z"]


@pytest.mark.parametrize(
    ("door", "why"),
    [
        (Door(closed=False), "interlock 'door' is open"),
        (ConfigurationError("daq: no such host", "plug it in"), "interlock 'door' cannot be read"),
    ],
    ids=["open", "unplugged"],
)
def test_z_is_not_lifted_behind_a_door_that_is_open_or_cannot_be_read(
    rig: Any, door: Any, why: str
) -> None:
    rig.contacts, rig.door = [DOOR], door
    state = pressed_state("", "", Orders(ZERO))
    assert state == PressedState(f"still pressed at 12.44 mm, 4.0 N; not lifted: {why}")
    assert rig.moves == []


def test_z_is_not_lifted_behind_a_door_whose_opening_is_recorded(
    rig: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It has been closed since, but a person may still be there."""
    monkeypatch.setenv(SHARED_FOLDER, str(tmp_path / "shared"))
    rig.contacts = [DOOR]
    store = InterlockStore(rig.plan(), lasting=True)
    store.latch("door", "it was opened")
    state = pressed_state("", "", Orders(ZERO, lasting=True))
    assert state.text.endswith("not lifted: interlock 'door' is latched")
    assert (rig.moves, state.released) == ([], False)
    store.reset("door")
    assert pressed_state("", "", Orders(ZERO, lasting=True)).released


def test_a_lift_ends_by_itself_before_the_guard_gives_up(rig: Any) -> None:
    """It has 0.8 s: half a second for the contacts, and too little for 0.74 mm."""
    state = pressed_state("", "", Orders(ZERO, within_s=0.8))
    assert re.search(
        r"; not lifted: stage_z has come to 12\.1\d mm and not to 11\.7 mm in time$", state.text
    )
    assert (rig.moves, state.released) == ([CLEAR_mm], False)
    stopped_mm = rig.mm
    rig.sleep(1.0)
    assert rig.mm == stopped_mm
