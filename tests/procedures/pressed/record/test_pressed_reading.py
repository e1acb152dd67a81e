"""What a trial tells of how its servo went, from its record."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from procedures.pressed.record.reading import _touch_frame, reading_of
from procedures.pressed.record.trial_record import TrialRecord
from procedures.pressed.settings import PressedSettings
from procedures.slip_trial.settings import SlipTrialSettings
from rig.control.tick_loop import LoopStatistics

TICKS = 200


def record(held_back: int) -> TrialRecord:
    """Two seconds of 4 N, the motion in the second of them; no touch-down is seen."""
    found = TrialRecord(3, 100.0, 1000.0, 4.0)
    found.force = [np.tile([4.0, 0.5, 0.0], (2000, 1))]
    found.volts = [np.zeros((2000, 2))]
    found.rows, found.frames = 20_000, 2000
    found.motion_from_s, found.motion_to_s = 1.0, 1.9
    found.held_back = held_back
    found.loops = [LoopStatistics(TICKS, 0, 0, 0.0)]
    return found


def reading_of_record(
    recorded: TrialRecord,
    said: list[str] | None = None,
    settings: PressedSettings | None = None,
) -> dict[str, object]:
    """The reading of a record; what was said of the servo is added to `said`."""
    said = [] if said is None else said

    def event(level: str, code: str, message: str) -> None:
        if (level, code) == ("warning", "servo"):
            said.append(message)

    run = SimpleNamespace(
        settings=settings or SlipTrialSettings(),
        event=event,
        check_stop=lambda: None,
        clock=SimpleNamespace(truth=dict),
        force=SimpleNamespace(axes="xyz"),
    )
    return dict(reading_of(run, recorded))


def reported(held_back: int) -> tuple[dict[str, object], list[str]]:
    """The reading, and what was said of the servo."""
    said: list[str] = []
    return reading_of_record(record(held_back), said), said


@pytest.mark.parametrize("held_back", [0, TICKS // 2])
def test_a_drive_that_is_busy_now_and_then_is_counted(held_back: int) -> None:
    reading, said = reported(held_back)
    assert reading["held_back_ticks"] == held_back
    assert said == []
    assert reading["invalid"] == ""


def test_a_servo_that_could_tell_its_drive_too_seldom_says_so() -> None:
    reading, said = reported(TICKS // 2 + 1)
    assert reading["held_back_ticks"] == 101
    assert said == [
        "trial-003: z was busy in 101 of 200 ticks: the servo held the force with fewer targets "
        "than its 100 a second"
    ]


def test_the_touch_down_is_the_one_that_leads_to_the_held_force() -> None:
    force_N = np.zeros(3000)
    force_N[100] = 0.3  # an impulse in free air
    force_N[1500:1510] = 0.15  # felt, and lost again
    force_N[2000:] = np.minimum(4.0, 0.02 * np.arange(1000))
    force_N[2500] = 0.0  # one frame that is lost
    assert _touch_frame(force_N, 1000.0, tapped_s=2.9) == 2006
    assert _touch_frame(force_N, 1000.0, tapped_s=0.0) == 100, "no tap was recorded"
    assert _touch_frame(np.zeros(50), 1000.0, tapped_s=0.06) == 50
