"""How the rotary axis is measured, and what x can take back of its offset."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from procedures.roll_trial.profile import Curve, ThereAndBack
from procedures.roll_trial.trial import (
    PolledRotary,
    require_nudged,
    require_small_offset,
    require_way_of_x,
)
from rig.analysis.estimate import Estimate
from rig.core.errors import InstrumentError, LimitError
from rig.instruments.roles import Limits

ROLL = ThereAndBack(3.5, 12.0, 60.0, 0.3)
CURVE = Curve((0.0, 0.5, 1.0), (0.0, -3.5, 0.0), 300.0)
START_mm, TICK_S = 5.0, 0.01


def limits(low_mm: float = 0.0, high_mm: float = 40.0, fastest_mm_s: float = 20.0):
    return {
        "position": Limits(low_mm, high_mm, "mm", "stage_x"),
        "speed": Limits(0.001, fastest_mm_s, "mm/s", "stage_x"),
    }


@pytest.mark.parametrize("profile", [ROLL, CURVE])
@pytest.mark.parametrize("offset_mm", [-8.0, 0.3, 8.0])
def test_a_stage_with_room_may_compensate(profile, offset_mm):
    require_way_of_x(offset_mm, profile, TICK_S, START_mm, limits())


@pytest.mark.parametrize(
    ("profile", "limits", "words"),
    [
        (ROLL, limits(low_mm=4.8), "needs a position of 4.695 mm; the stage_x allows 4.8 to 40 mm"),
        (
            CURVE,
            limits(high_mm=5.2),
            "needs a position of 5.305 mm; the stage_x allows 0 to 5.2 mm",
        ),
        (ROLL, limits(fastest_mm_s=1.0), "needs a speed of 1.068 mm/s; the stage_x allows"),
    ],
)
def test_an_offset_that_x_cannot_follow_is_refused_before_the_roll(profile, limits, words):
    with pytest.raises(LimitError) as caught:
        require_way_of_x(5.0, profile, TICK_S, START_mm, limits)
    line = caught.value.one_line()
    assert "offset of the rotary axis, 5.00 mm" in line
    assert words in line
    assert "--start" in line


def test_x_that_compensates_already_is_not_the_remedy():
    """Found by an attack: `--alignment compensate` was advised where it was in force."""
    offset = Estimate.normal(-10.92, 0.93, "mm")
    with pytest.raises(LimitError) as compensated:
        require_small_offset(offset, True, 1.0)
    line = compensated.value.one_line()
    assert "the rotary axis lies 10.92 mm below the point of contact" in line
    assert "8 mm at most, so 2.92 mm remain, more than --largest-offset 1 mm" in line
    assert "--alignment" not in line
    with pytest.raises(LimitError) as measured:
        require_small_offset(offset, False, 1.0)
    assert "--alignment compensate" in measured.value.one_line()
    require_small_offset(Estimate.normal(8.9, 0.5, "mm"), True, 1.0)


def test_an_axis_that_has_not_followed_its_nudge_is_named():
    with pytest.raises(InstrumentError) as caught:
        require_nudged("rotary", 0.02, 0.5, 0.5, "deg")
    assert "rotary: measure the rotary axis: it has gone 0.02 deg for a nudge of 0.5 deg" in (
        caught.value.one_line()
    )


@pytest.mark.parametrize("went_mm", [0.012, 0.02, 0.028])
def test_an_axis_that_stops_some_micrometres_beside_its_target_has_followed(went_mm):
    require_nudged("stage_x", went_mm, 0.02, 0.02, "mm")


def test_an_x_that_is_never_slow_compensates_for_a_small_offset():
    changed = limits() | {"speed": Limits(0.5, 20.0, "mm/s", "stage_x")}
    require_way_of_x(0.001, ROLL, TICK_S, START_mm, changed)


def test_set_points_around_a_peak_are_turned_to_at_a_speed_that_the_stage_has():
    """Found by an attack: 4e-14 deg/s was refused in the middle of a roll, the skin pressed."""
    asked: list[tuple[float, float, float]] = []
    stage = SimpleNamespace(
        limits=lambda: {"speed": Limits(1e-4, 20.0, "deg/s", "rotary")},
        start_turn=lambda *turn: asked.append(turn),
    )
    run: Any = SimpleNamespace(bench=SimpleNamespace(rotary=stage), clock=None)
    links: Any = SimpleNamespace(add=lambda role: None, ask=lambda role, what, do: do())
    rotary = PolledRotary(run, 15.0, links)
    for turn in Curve((0.0, 0.411, 0.822), (0.0, 3.0, 0.0), 60.0).turns(TICK_S):
        rotary.ask_turn(turn)
    speeds = [speed for _, speed, _ in asked]
    assert min(speeds) == 1e-4
    assert max(speeds) < 20.0
