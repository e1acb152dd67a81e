"""What a roll trial reads from its strips."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from procedures.roll_trial.reading import RollTrialRecord, reading_of
from procedures.roll_trial.settings import RollTrialSettings
from rig.control.tick_loop import LoopStatistics


def rolled(rest_s: float) -> dict[str, Any]:
    """Return the reading of a roll that begins `rest_s` after the tap.

    The servo takes over with -4 mV in the first 60 ms; on the way there v_2 falls to -4.4 mV and
    then rises to 4 mV.
    """
    settings = RollTrialSettings(rest_s=rest_s)
    found = RollTrialRecord(1, 100.0, 1000.0)
    found.tapped_s, found.motion_from_s = 1.0, 1.0 + rest_s
    way_s = settings.profile.duration_s / 2
    found.motion_to_s = found.motion_from_s + 2 * way_s
    t = np.arange(round(1000 * (found.motion_to_s + 0.2))) / 1000
    v_2 = np.where((t >= 1.0) & (t < 1.06), -4.0, 0.0)
    part = (t - found.motion_from_s) / way_s
    v_2 += np.where((part >= 0) & (part < 0.5), -4.4 * np.sin(2 * math.pi * part), 0.0)
    v_2 += np.where((part >= 0.5) & (part < 1), -4.0 * np.sin(2 * math.pi * part), 0.0)
    found.volts = [1e-3 * np.stack([np.zeros_like(v_2), v_2], axis=1)]
    found.force = [np.tile([4.0, 0.0, 0.0], (len(t), 1))]
    found.rows, found.frames = 10 * len(t), len(t)
    found.rotation = [(float(s), 0.0, 0.0) for s in t[::10]]
    found.loops = [LoopStatistics(200, 200, 0, 0, 0.0, 0.0, 2.0, False)]
    run: Any = SimpleNamespace(
        settings=settings,
        event=lambda *said: None,
        check_stop=lambda: None,
        clock=SimpleNamespace(truth=dict),
    )
    return dict(reading_of(run, found, None))


@pytest.mark.parametrize("rest_s", [0.1, 0.15, 0.3])
def test_a_short_rest_does_not_shift_the_zero_of_the_strips(rest_s: float) -> None:
    assert rolled(rest_s)["peak_2_mV"] == pytest.approx(-4.4, abs=0.05)
