"""What a procedure does with a force sensor of another rate than usual."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from procedures.pressed.approach.contact import FORCE_RATE_S_S, stream_force
from procedures.pressed.arming import MIN_FORCE_RATE_S_S, arm_pressed
from procedures.pressed.rates import ServoRates
from procedures.pressed.record.force import FORCE_AGE_S, FORCE_WINDOW_S, ForceTiming
from procedures.pressed.settings import DELAY_S
from rig.core.errors import LimitError
from rig.instruments.roles import Limits

RATES = ServoRates(100.0, DELAY_S, 100.0)
STAGE_LIMITS = {
    "position": Limits(0.0, 14.0, "mm", "stage_z"),
    "speed": Limits(0.001, 20.0, "mm/s", "stage_z"),
}


def test_the_usual_rate_changes_nothing_of_delay_and_age() -> None:
    usual = ForceTiming(FORCE_RATE_S_S)
    assert usual.window_s == FORCE_WINDOW_S
    assert usual.age_s == FORCE_AGE_S
    assert usual.delay_s(RATES) == DELAY_S
    assert usual.block_frames == 50


@pytest.mark.parametrize(
    ("rate_S_s", "window_s", "older_s", "block_frames"),
    [(500.0, 0.004, 0.0005, 25), (250.0, 0.004, 0.0015, 12), (100.0, 0.01, 0.0075, 5)],
)
def test_a_slower_sensor_gives_an_older_force(
    rate_S_s: float, window_s: float, older_s: float, block_frames: int
) -> None:
    """By half of what a frame is longer, and where the window is less than a frame by half of that,
    too."""
    slow = ForceTiming(rate_S_s)
    assert slow.window_s == pytest.approx(window_s)
    assert slow.older_s == pytest.approx(older_s)
    assert slow.delay_s(RATES) == pytest.approx(DELAY_S + older_s)
    assert slow.block_frames == block_frames


class SlowSensor:
    """A run whose force sensor has only some rates, and whose z can be armed but not moved."""

    def __init__(self, highest_S_s: float) -> None:
        limits = {"rate": Limits(1.0, highest_S_s, "1/s", "force_sensor")}
        sensor = SimpleNamespace(limits=lambda: limits)
        fixture = SimpleNamespace(contact_from_mm=12.0, contact_to_mm=13.0, parked_mm=5.0)
        self.bench = SimpleNamespace(
            force_sensor=sensor,
            daq=SimpleNamespace(stop=None),
            stage_z=SimpleNamespace(stop=_move, make_safe=_move, limits=lambda: STAGE_LIMITS),
            settings=SimpleNamespace(fixture=fixture),
        )
        self.settings = SimpleNamespace(largest_force_N=15.0)
        self.asked_S_s = 0.0
        self.armed: list[str] = []

    def arm(self, name: str, *_: Any, **__: Any) -> None:
        self.armed.append(name)

    def stream_force(self, rate_S_s: float) -> Any:
        self.asked_S_s = rate_S_s
        return SimpleNamespace(rate_S_s=rate_S_s)


@pytest.mark.parametrize(("highest_S_s", "asked_S_s"), [(12_000.0, 1000.0), (250.0, 250.0)])
def test_a_sensor_is_asked_for_a_rate_that_it_has(highest_S_s: float, asked_S_s: float) -> None:
    run = SlowSensor(highest_S_s)
    stream_force(run, 100.0, "a test")  # type: ignore[arg-type]
    assert run.asked_S_s == asked_S_s


@pytest.mark.parametrize(("rate_S_s", "tick_Hz"), [(50.0, 100.0), (50.0, 40.0), (250.0, 500.0)])
def test_a_sensor_that_is_too_slow_is_refused_before_anything_moves(
    rate_S_s: float, tick_Hz: float
) -> None:
    run, least_S_s = SlowSensor(rate_S_s), max(tick_Hz, MIN_FORCE_RATE_S_S)
    words = rf"sends {rate_S_s:g} frames/s, .* at {tick_Hz:g} Hz needs {least_S_s:g} or more"
    with pytest.raises(LimitError, match=words):
        arm_pressed(run, "slide", _move, _move, "x stage stopped", tick_Hz)  # type: ignore[arg-type]
    assert run.armed == ["normal force"], "what lifts z, which may have been left pressed"


def _move() -> None:
    raise AssertionError("nothing may be done to a stage")
