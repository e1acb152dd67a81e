"""The tangential ramp on a contact that softens and then slips, in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rig.control.approach import CLOSING
from rig.control.force_ramp import ForceRamp

GROSS_N, STEEPNESS_mm = 2.7, 0.08
"""F_t = GROSS (1 - exp(-x / STEEPNESS)): 34 N/mm at first, none in the end."""
DELAY_s = 0.005


def dragged(rate_N_s, tick_s, largest_mm_s=0.5, gross_N=GROSS_N, seconds=4.0, look_every=1):
    """Times, forces (n,) and the ramp, with the stage at its speed at once and the force seen a
    delay after it; the stage is looked at in every so many ticks."""
    ramp = ForceRamp(rate_N_s, largest_mm_s, tick_s, DELAY_s)
    fine_s = 5e-4
    late, every = round(DELAY_s / fine_s), round(tick_s / fine_s)
    travel, speed = [0.0] * (late + 1), 0.0
    force_at = lambda x: gross_N * (1 - math.exp(-x * GROSS_N / gross_N / STEEPNESS_mm))  # noqa: E731
    times, forces, seen = [], [], (0.0, 0.0)
    for k in range(round(seconds / fine_s)):
        if k % every == 0:
            seen_N = force_at(travel[-1 - late])
            times.append(k * fine_s)
            forces.append(seen_N)
            if k % (every * look_every) == 0:
                seen = times[-1], travel[-1]
            speed = ramp.step(times[-1], *seen, times[-1] - DELAY_s, seen_N)
            if ramp.slipped:
                break
        travel.append(travel[-1] + speed * fine_s)
    return np.array(times), np.array(forces), ramp, travel[-1]


@pytest.mark.parametrize(
    ("rate_N_s", "tick_s", "look_every"), [(0.5, 0.002, 5), (2.0, 0.01, 1), (8.0, 0.002, 1)]
)
def test_the_force_rises_at_the_rate_until_the_contact_slips(rate_N_s, tick_s, look_every) -> None:
    """Late by no more than the closing time on the whole way to 80 % of gross slip, also where the
    stage says where it is a hundred times a second only."""
    times, forces, ramp, _ = dragged(
        rate_N_s, tick_s, largest_mm_s=rate_N_s / 2, seconds=8.0, look_every=look_every
    )
    closing_s = CLOSING * (DELAY_s + tick_s)
    rising = (times > 3 * closing_s) & (rate_N_s * times < 0.8 * GROSS_N)
    late_s = times[rising] - forces[rising] / rate_N_s
    assert rising.sum() > 3
    assert np.abs(late_s).max() < closing_s
    assert ramp.slipped
    assert not ramp.follows
    assert forces[-1] > 0.9 * GROSS_N


def test_a_slip_is_reported_soon_after_the_force_can_rise_no_more() -> None:
    times, _, _, travel_mm = dragged(2.0, 0.01)
    assert times[-1] < GROSS_N / 2.0 + 4 * CLOSING * (DELAY_s + 0.01)
    assert travel_mm < 1.0


def test_a_contact_that_holds_is_never_said_to_slip() -> None:
    times, forces, ramp, _ = dragged(2.0, 0.01, gross_N=50.0, seconds=3.0)
    assert not ramp.slipped
    assert ramp.follows
    assert forces[-1] == pytest.approx(2.0 * times[-1], rel=0.05)


def test_the_speed_stays_within_its_limit_and_never_is_nothing() -> None:
    ramp = ForceRamp(2.0, 0.5, 0.01, DELAY_s)
    assert 0 < ramp.step(0.0, 0.0, 0.0, -DELAY_s, 5.0) < 0.01
    assert ramp.step(10.0, 10.0, 0.0, 10.0 - DELAY_s, 0.0) == 0.5
