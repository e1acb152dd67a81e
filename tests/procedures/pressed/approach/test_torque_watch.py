"""What a torque that rises without a force means, and what it does not."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from procedures.pressed.approach.approach_watch import ApproachWatch, naming_the_sensor
from procedures.pressed.approach.torque_watch import TorqueWatch, WayTorque
from rig.core.errors import InstrumentError
from rig.instruments.roles import Limits

CONTACT_mm, STIFFNESS_N_mm, SPEED_mm_s, TICK_S = 12.2, 100.0, 0.5, 0.02
LIMIT_percent, TARGET_N = 25.0, 10.0
"""1 % of the torque is 1 N."""


class Bench:
    """Clock, z stage with torque and friction, and a force sensor that shows `share` of a force."""

    def __init__(self, share: float, friction_percent: float = 2.0):
        self.share, self.friction_percent = share, friction_percent
        self.now_s, self.mm, self.moves, self.stopped = 0.0, 11.7, False, False
        self.noise_N, self.update_rate_Hz = np.full(3, 0.002), 1000.0
        self.events: list[str] = []
        fixture = SimpleNamespace(parked_mm=5.0, contact_from_mm=12.0, contact_to_mm=13.0)
        settings = SimpleNamespace(torque_limit_percent=LIMIT_percent)
        part = SimpleNamespace(role="stage_z", settings=settings)
        plan = SimpleNamespace(instruments=(part,))
        described = SimpleNamespace(
            stage_z=self, plan=plan, settings=SimpleNamespace(fixture=fixture)
        )
        self.run: Any = SimpleNamespace(bench=described, clock=self, force=self, event=self.event)

    def event(self, level: str, code: str, message: str) -> None:
        self.events.append(message)

    def now(self) -> float:
        return self.now_s

    def limits(self) -> dict[str, Limits]:
        return {"update_rate": Limits(0.0, self.update_rate_Hz, "Hz", "stage_z")}

    def position_mm(self) -> float:
        return self.mm

    def stop(self) -> None:
        self.stopped, self.moves = True, False

    @property
    def pressed_N(self) -> float:  # noqa: N802 - the unit keeps its capital, here and below
        return max(0.0, self.mm - CONTACT_mm) * STIFFNESS_N_mm

    def torque_percent(self) -> float | None:
        return self.pressed_N + (self.friction_percent if self.moves else 0.0)

    def latest_N(self, seconds: float) -> np.ndarray:  # noqa: N802
        return np.tile([0.0, 0.0, self.share * self.pressed_N], (50, 1))

    def press(self, watch: ApproachWatch, torque: TorqueWatch, way_mm: float) -> None:
        """Move down by a way, tick by tick."""
        self.moves = True
        for _ in range(round(way_mm / SPEED_mm_s / TICK_S)):
            force_N = self.share * self.pressed_N
            watch.commanded(0.05, SPEED_mm_s)
            torque.read()
            watch.step(self.mm, force_N, touched=force_N > 0.1)
            self.now_s += TICK_S
            self.mm += SPEED_mm_s * TICK_S
        self.moves = False


def at_rest(bench: Bench) -> tuple[TorqueWatch, ApproachWatch]:
    torque = TorqueWatch(bench.run)
    torque.rest()
    return torque, ApproachWatch(bench.run, 0.1, TARGET_N, torque)


@pytest.mark.parametrize("friction_percent", [0.0, 8.0])
def test_a_torque_that_rises_without_a_force_names_the_sensor_long_before_its_limit(
    friction_percent: float,
) -> None:
    bench = Bench(0.0, friction_percent)
    torque, watch = at_rest(bench)
    with pytest.raises(InstrumentError, match="as if it pressed") as caught:
        bench.press(watch, torque, 0.8)
    assert caught.value.device == "force_sensor"
    assert "suspect the force sensor" in str(caught.value.hint)
    assert bench.stopped
    assert 0 < bench.pressed_N < 0.4 * LIMIT_percent


def stand_still(
    bench: Bench,
    watch: ApproachWatch,
    torque: TorqueWatch,
    percent: float | None,
    rises_s: float = 0.0,
) -> InstrumentError:
    """Command z to move on while it stands and its motor shows a torque, to which it rises, or none
    is read; the error."""
    begun_s = bench.now_s
    try:
        with naming_the_sensor(bench.run, 0.1):
            for _ in range(round(0.5 / TICK_S)):
                watch.commanded(0.05, SPEED_mm_s)
                if percent is not None:
                    torque.read()
                    share = min(1.0, (bench.now_s - begun_s) / rises_s) if rises_s else 1.0
                    torque.latest_percent = share * percent
                watch.step(bench.mm, 0.0, touched=False)
                bench.now_s += TICK_S
    except InstrumentError as error:
        assert bench.stopped
        return error
    raise AssertionError("it was not refused")


@pytest.mark.parametrize(
    ("percent", "device", "words"),
    [
        (2.5, "stage_z", "as in free air: nothing holds it, and it does not obey"),
        (LIMIT_percent, "force_sensor", ""),
        (None, "force_sensor", "stage_z is held at 12.2"),
    ],
    ids=["idle", "at its limit", "not read since"],
)
def test_a_stage_that_stands_in_the_contact_range_is_distinguished_from_one_that_is_held(
    percent: float | None, device: str, words: str
) -> None:
    bench = Bench(0.0)
    torque, watch = at_rest(bench)
    bench.press(watch, torque, CONTACT_mm - bench.mm)
    error = stand_still(bench, watch, torque, percent)
    assert error.device == device
    assert words in str(error)
    assert ("suspect the force sensor" in str(error.hint)) == (device == "force_sensor")


def test_a_stage_that_is_held_above_any_contact_is_not_taken_for_idle() -> None:
    """What its motor shows meanwhile is not the torque of free air."""
    bench = Bench(0.0)
    bench.mm = 11.0
    torque, watch = at_rest(bench)
    bench.press(watch, torque, 0.8)
    assert "stage_z is held at 11.8" in str(stand_still(bench, watch, torque, LIMIT_percent, 0.3))


def test_a_torque_that_never_changes_does_not_show_an_idle_stage() -> None:
    bench = Bench(0.0, friction_percent=0.0)
    torque, watch = at_rest(bench)
    bench.press(watch, torque, CONTACT_mm - bench.mm)
    assert "stage_z is held at 12.2" in str(stand_still(bench, watch, torque, 0.0))


def test_the_friction_of_a_further_trial_is_no_rise_from_rest() -> None:
    bench = Bench(1.0, friction_percent=8.0)
    torque, watch = at_rest(bench)
    bench.press(watch, torque, 0.6)
    bench.mm = 11.7
    torque.rest()
    watch = ApproachWatch(bench.run, 0.1, TARGET_N, torque)
    watch.step(bench.mm, 0.0, touched=False)
    bench.press(watch, torque, 0.6)
    assert not bench.stopped


def test_a_force_that_stops_changing_while_the_torque_rises_names_the_sensor() -> None:
    bench = Bench(1.0)
    torque, watch = at_rest(bench)
    bench.press(watch, torque, 0.58)  # 8 N, with its force
    seen_N = bench.pressed_N
    bench.latest_N = lambda seconds: np.tile([0.0, 0.0, seen_N], (50, 1))  # type: ignore[method-assign]
    with pytest.raises(InstrumentError, match="have not changed with it"):
        bench.press(watch, torque, 0.2)


def test_a_force_that_comes_with_its_torque_is_pressed() -> None:
    bench = Bench(1.0)
    torque, watch = at_rest(bench)
    bench.press(watch, torque, 0.7)
    assert bench.pressed_N == pytest.approx(20.0)
    assert not bench.stopped


def held(bench: Bench) -> TorqueWatch:
    """A torque that is watched under 8 N, from its first readings on."""
    torque, watch = at_rest(bench)
    bench.press(watch, torque, 0.58)
    torque.hold_begins(bench.pressed_N)
    torque.settle_in_hold()
    return torque


def test_a_torque_that_changes_under_a_force_that_does_not_names_the_sensor() -> None:
    bench = Bench(1.0)
    torque = held(bench)
    reads_N = bench.pressed_N  # by a zero that drifts as the servo follows
    with pytest.raises(InstrumentError, match="hold the force"):
        press_on(bench, torque, reads_N)
    assert bench.stopped
    assert bench.pressed_N - reads_N < 0.3 * LIMIT_percent


def press_on(bench: Bench, torque: TorqueWatch, reads_N: float) -> None:
    """Go 0.1 mm deeper while the sensor reads the same."""
    for _ in range(100):
        bench.mm += 0.001
        torque.read()
        torque.refuse_rise_in_hold(reads_N, 2.0)


def test_what_changes_both_is_no_fault_of_the_sensor() -> None:
    bench = Bench(1.0)
    torque = held(bench)
    bench.mm += 0.1
    torque.read()
    torque.refuse_rise_in_hold(bench.pressed_N, 2.0)
    assert not bench.stopped


def test_friction_that_hides_a_held_force_is_reported_and_ends_no_run() -> None:
    bench = Bench(1.0, friction_percent=10.0)
    torque = held(bench)
    bench.mm += 0.15
    torque.read()
    torque.refuse_rise_in_hold(8.0, 2.0)
    (said,) = bench.events
    assert said.startswith("the friction of stage_z, 10 % of its torque, hides")


def test_a_stage_that_reports_no_torque_is_not_watched() -> None:
    bench = Bench(0.0)
    bench.torque_percent = lambda: None  # type: ignore[method-assign]
    torque, watch = at_rest(bench)
    bench.press(watch, torque, 0.7)
    assert not bench.stopped
    assert bench.events == ["stage_z reports no torque: only its torque limit backs the force"]


@pytest.mark.parametrize("update_rate_Hz", [1000.0, 50.0])
def test_something_on_the_way_down_that_the_sensor_does_not_show_is_felt_by_the_torque(
    update_rate_Hz: float,
) -> None:
    bench = Bench(0.0, friction_percent=4.0)
    bench.update_rate_Hz, bench.mm = update_rate_Hz, 11.5
    torque, bench.moves = WayTorque(bench.run), True
    with pytest.raises(InstrumentError, match="way down"):
        go_down(bench, torque)
    assert bench.stopped
    assert 0 < bench.pressed_N < 0.4 * LIMIT_percent


def go_down(bench: Bench, torque: WayTorque) -> None:
    """Go down by 2 mm."""
    for _ in range(200):
        bench.now_s += TICK_S
        bench.mm += SPEED_mm_s * TICK_S
        torque.refuse_rise(0.0)


@pytest.mark.parametrize(("shown_percent", "warnings"), [(0.0, 1), (None, 0)])
def test_a_torque_that_never_changes_is_no_witness_and_is_reported(
    shown_percent: float | None, warnings: int
) -> None:
    """What the drive reports is 0 % in free air and under 8 N; or, the second time, the torque."""
    bench = Bench(1.0)
    if shown_percent is not None:
        bench.torque_percent = lambda: shown_percent  # type: ignore[method-assign]
    held(bench)
    reported = [text for text in bench.events if "the same torque, 0 %, in free air" in text]
    assert len(reported) == warnings
    assert all("under 8 N" in text for text in reported)
