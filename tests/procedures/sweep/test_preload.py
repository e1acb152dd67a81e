"""The way from contact to the preload, on a film that is a spring and a force that comes late."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest

from procedures.pressed.approach.torque_watch import TorqueWatch
from procedures.sweep import preload
from rig.core.errors import InstrumentError
from rig.instruments.roles import Limits
from rig.run.trip import TripError

CONTACT_mm, TARGET_N = 12.6, 25.0
WAY = Limits(0.0, 14.0, "mm", "stage_z")
SPEEDS = Limits(0.001, 20.0, "mm/s", "stage_z")


class Bench:
    """Stage, film, sensor and clock: time passes in ms, the force is known `late_ms` afterwards."""

    def __init__(self, stiffness_N_mm: float, late_ms: int):
        self.stiffness_N_mm = stiffness_N_mm
        self.now_ms = 0
        self.position, self.target, self.speed = CONTACT_mm, 13.0, preload.APPROACH_mm_s
        self.known = deque([preload.CONTACT_N] * (late_ms + 1), maxlen=late_ms + 1)
        self.farthest_ahead_mm = 0.0
        self.noise_N = np.full(3, 0.002)
        self.speeds = SPEEDS

    def now(self) -> float:
        return 1e-3 * self.now_ms

    def sleep(self, seconds: float) -> None:
        for _ in range(round(1e3 * seconds)):
            self.now_ms += 1
            step = 1e-3 * self.speed
            self.position += min(max(self.target - self.position, -step), step)
            pressed_N = preload.CONTACT_N + self.stiffness_N_mm * (self.position - CONTACT_mm)
            self.known.append(max(pressed_N, 0.0))

    def mean_N(  # noqa: N802 - the unit keeps its capital
        self, seconds: float
    ) -> np.ndarray:
        return np.array([0.0, 0.0, self.known[0]])

    def latest_N(  # noqa: N802 - as above
        self, seconds: float
    ) -> np.ndarray:
        return np.tile(self.mean_N(seconds), (10, 1))

    def position_mm(self) -> float:
        return self.position

    def start_move(self, position_mm: float, speed_mm_s: float) -> None:
        self.speeds.require("stage_z", "speed", speed_mm_s)
        self.target, self.speed = position_mm, speed_mm_s
        self.farthest_ahead_mm = max(self.farthest_ahead_mm, position_mm - self.position)

    def stop(self) -> None:
        self.target = self.position

    def limits(self) -> dict[str, Limits]:
        return {"position": WAY, "speed": self.speeds}


def run_on(bench: Bench, clock: object = None, contact_to_mm: float = 14.0) -> SimpleNamespace:
    """A run with this bench and its fixture."""
    fixture = SimpleNamespace(parked_mm=5.0, contact_from_mm=12.5, contact_to_mm=contact_to_mm)
    described = SimpleNamespace(stage_z=bench, settings=SimpleNamespace(fixture=fixture))
    return SimpleNamespace(bench=described, clock=clock or bench, force=bench)


def approach(run: SimpleNamespace, first_mm: float) -> float:
    """Search for contact from here, with a stage that reports no torque."""
    torque = TorqueWatch(run)  # type: ignore[arg-type]
    return preload._approach(run, first_mm, 13.0, TARGET_N, torque)  # type: ignore[arg-type]


def press_from(run: SimpleNamespace, contact_mm: float) -> preload.Preload | None:
    """Press from contact; no run before this one bounds the way."""

    def refuse_way(way_mm: float, force_N: float) -> None: ...

    torque = TorqueWatch(run)  # type: ignore[arg-type]
    return preload._press_from(run, contact_mm, TARGET_N, refuse_way, torque)  # type: ignore[arg-type]


@pytest.mark.parametrize("late_ms", [5, 60])
@pytest.mark.parametrize("stiffness_N_mm", [30.0, 250.0])
def test_a_late_force_neither_ends_the_way_to_the_preload_nor_sends_the_stage_far_ahead(
    stiffness_N_mm: float, late_ms: int
) -> None:
    bench = Bench(stiffness_N_mm, late_ms)
    run = run_on(bench)
    pressed = press_from(run, CONTACT_mm)
    assert pressed is not None
    assert pressed.reached_N == pytest.approx(TARGET_N, rel=0.02)
    assert bench.farthest_ahead_mm <= 0.051
    assert max(bench.known) < 1.1 * TARGET_N


def test_a_program_that_stands_still_on_the_way_to_contact_does_not_press_on() -> None:
    bench = Bench(90.0, 5)
    bench.position = bench.target = CONTACT_mm - 0.1
    bench.known = deque([0.0] * 6, maxlen=6)
    in_free_air = SimpleNamespace(now=bench.now, sleep=_standing_still(bench, CONTACT_mm))
    run = run_on(bench, in_free_air)
    felt_mm = approach(run, CONTACT_mm - 0.2)
    assert bench.now() > 3.0
    assert CONTACT_mm < felt_mm < CONTACT_mm + 0.051
    assert max(bench.known) < 90.0 * 0.051


def test_a_stage_that_may_only_go_slowly_is_pressed_and_followed_at_its_own_speed() -> None:
    bench = Bench(90.0, 5)
    bench.speeds = Limits(0.001, 0.1, "mm/s", "stage_z")
    bench.position = bench.target = CONTACT_mm - 0.1
    bench.known = deque([0.0] * 6, maxlen=6)
    run = run_on(bench)
    felt_mm = approach(run, CONTACT_mm - 0.2)
    pressed = press_from(run, felt_mm)
    assert pressed is not None
    bench.position -= 0.01  # the film has crept
    bench.sleep(0.1)
    assert pressed.follow(run, 0.05)  # type: ignore[arg-type]


def test_a_stage_that_stands_in_free_air_is_reported_in_time() -> None:
    bench = Bench(90.0, 5)
    bench.position = bench.target = CONTACT_mm - 0.2
    bench.known = deque([0.0] * 6, maxlen=6)
    bench.start_move = lambda position_mm, speed_mm_s: None  # type: ignore[method-assign]
    run = run_on(bench, contact_to_mm=13.0)
    reported = r"stage_z is held at 12\.400 mm.*; force_sensor reads 0 N of 25 N"
    with pytest.raises(InstrumentError, match=reported):
        approach(run, 12.0)
    assert bench.now() < 0.5


def test_what_creeps_on_is_not_followed_below_the_latest_contact() -> None:
    bench, pressed, run = held(90.0, 90.0)
    run.bench.settings.fixture.contact_to_mm = bench.position + 0.02
    bench.sleep = _giving_way(bench)  # type: ignore[method-assign]
    with pytest.raises(TripError, match="deeper than contact_to_mm"):
        pressed.hold(run, 0.05, 0.02)  # type: ignore[arg-type]
    assert bench.target <= run.bench.settings.fixture.contact_to_mm + 0.002


def _standing_still(bench: Bench, at_mm: float) -> Callable[[float], None]:
    """For 3 s once the stage has come so far; nothing is touched before the film."""

    def sleep(seconds: float) -> None:
        before_mm = bench.position
        bench.sleep(seconds)
        if before_mm < at_mm <= bench.position:
            bench.sleep(3.0)

    return sleep


def test_what_was_felt_and_is_gone_is_no_contact() -> None:
    bench = Bench(90.0, 5)
    run = run_on(bench)
    bench.position = CONTACT_mm - 0.4  # the sensor was shaken: nothing is touched yet
    bench.known = deque([0.0] * 6, maxlen=6)
    assert press_from(run, bench.position) is None
    assert bench.position < CONTACT_mm


def held(
    stiffness_N_mm: float, taken_for_N_mm: float
) -> tuple[Bench, preload.Preload, SimpleNamespace]:
    """A film under less than its preload, and stiffer or softer than it is taken for."""
    bench = Bench(stiffness_N_mm, 5)
    bench.position = bench.target = CONTACT_mm + 0.95 * TARGET_N / stiffness_N_mm
    bench.sleep(0.01)
    run = run_on(bench)
    pressed = preload.Preload(
        TARGET_N,
        CONTACT_mm,
        taken_for_N_mm,
        TARGET_N,
        0.0,
        0.0,
        bench.position,
        TorqueWatch(run),  # type: ignore[arg-type]
    )
    return bench, pressed, run


@pytest.mark.parametrize("taken_for_N_mm", [20.0, 35.0, 90.0, 300.0])
def test_a_film_that_is_stiffer_than_it_seemed_is_not_hunted_for(taken_for_N_mm: float) -> None:
    bench, pressed, run = held(90.0, taken_for_N_mm)
    pressed.hold(run, 0.05, 0.02)  # type: ignore[arg-type]
    assert bench.known[0] == pytest.approx(TARGET_N, rel=preload.CLOSE)
    assert bench.now() < 2.0


def test_a_film_that_never_comes_to_rest_is_reported_in_time() -> None:
    bench, pressed, run = held(90.0, 90.0)
    run.bench.settings.fixture.contact_to_mm = 100.0
    bench.sleep = _giving_way(bench)  # type: ignore[method-assign]
    with pytest.raises(InstrumentError, match=r"followed for 60 s and not within 0\.2 % of 25 N"):
        pressed.hold(run, 0.05, 0.02)  # type: ignore[arg-type]
    assert preload.CREEP_PATIENCE_S < bench.now() < preload.CREEP_PATIENCE_S + 1


def _giving_way(bench: Bench) -> Callable[[float], None]:
    """A film that loses force as fast as the stage gives it some."""
    steady = bench.sleep

    def sleep(seconds: float) -> None:
        steady(seconds)
        for k in range(len(bench.known)):
            bench.known[k] = 0.96 * TARGET_N

    return sleep


def test_a_preload_that_the_steps_of_the_stage_cannot_hold_is_reported_with_that_reason() -> None:
    bench = Bench(900.0, 5)
    exact = bench.start_move
    bench.start_move = lambda position_mm, speed_mm_s: exact(  # type: ignore[method-assign]
        round(position_mm, 3), speed_mm_s
    )
    run = run_on(bench)
    with pytest.raises(InstrumentError) as caught:
        press_from(run, CONTACT_mm)
    assert "steps of the stage may be too coarse to hold it within 1 %" in caught.value.one_line()
