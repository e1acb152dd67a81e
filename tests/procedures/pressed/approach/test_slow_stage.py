"""A stage whose bench file allows less than the usual speed of travel."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from procedures.pressed.approach.unload import UNLOAD_DEADLINE_S, _go_clear, unload_deadline_s
from procedures.pressed.approach.way_down import TRAVEL_mm_s, travel_mm_s
from procedures.sweep.preload import APPROACH_mm_s, _possible_mm_s
from rig.control.approach import Approach
from rig.instruments.roles import Limits

PARKED_mm, PRESSED_mm, LATEST_mm = 5.0, 12.6, 13.0


class Stage:
    """A stage that stands where it presses, and refuses a speed beyond its limit."""

    def __init__(self, largest_mm_s: float):
        self.speeds = Limits(0.001, largest_mm_s, "mm/s", "stage_z")
        self.at_mm = PRESSED_mm

    def limits(self) -> dict[str, Limits]:
        """Its limits."""
        return {"position": Limits(0.0, 14.0, "mm", "stage_z"), "speed": self.speeds}

    def position_mm(self) -> float:
        """Where it stands."""
        return self.at_mm

    def move_to(self, position_mm: float, speed_mm_s: float) -> None:
        """Go there, as a drive does: only at a speed that it may have."""
        self.speeds.require("stage_z", "speed", speed_mm_s)
        self.at_mm = position_mm


def pressed_by(stage: Stage) -> Any:
    """A run in which this stage presses."""
    fixture = SimpleNamespace(
        parked_mm=PARKED_mm, contact_from_mm=12.0, contact_to_mm=LATEST_mm, mounted="plate"
    )
    return SimpleNamespace(
        bench=SimpleNamespace(stage_z=stage, settings=SimpleNamespace(fixture=fixture))
    )


@pytest.mark.parametrize("largest_mm_s", [0.2, 5.0, 20.0])
def test_what_is_pressed_is_released_at_the_speed_that_the_stage_may_have(
    largest_mm_s: float,
) -> None:
    """Found by an attack: max_speed_mm_s = 5 left the film pressed at the end of every run."""
    stage = Stage(largest_mm_s)
    _go_clear(pressed_by(stage), 0.0)
    assert stage.at_mm == PARKED_mm
    assert travel_mm_s(stage) == min(largest_mm_s, TRAVEL_mm_s)  # type: ignore[arg-type]


def test_a_slow_stage_has_the_time_for_its_way_off_the_object() -> None:
    """From wherever it stands, and back to where it came from."""
    stage = Stage(0.2)
    travel = stage.limits()["position"]
    assert unload_deadline_s(pressed_by(stage)) >= UNLOAD_DEADLINE_S + travel.high / 0.2


def test_a_slow_stage_searches_for_contact_at_its_own_speed() -> None:
    """The watch of a stage that is held would take a slower one for it."""
    approach = Approach(8.0, 0.01, 0.0045, stage_mm_s=0.1)
    assert approach.search_mm_s == 0.1
    assert approach.step(0.0, 1.0, 0.0, force_N=0.0).speed_mm_s == 0.1


@pytest.mark.parametrize(
    ("slowest_mm_s", "wanted_mm_s", "goes_mm_s"),
    [(0.002, 0.0017, 0.002), (0.002, 0.3, 0.3), (0.002, 50.0, APPROACH_mm_s)],
)
def test_the_preload_is_brought_up_at_a_speed_that_the_stage_has(
    slowest_mm_s: float, wanted_mm_s: float, goes_mm_s: float
) -> None:
    stage = Stage(20.0)
    stage.speeds = Limits(slowest_mm_s, 20.0, "mm/s", "stage_z")
    assert _possible_mm_s(stage, wanted_mm_s) == goes_mm_s  # type: ignore[arg-type]
