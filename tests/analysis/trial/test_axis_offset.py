"""The axis's offset from nudges: right within its error, and refused where nothing is felt."""

import numpy as np
import pytest

from rig.analysis.trial.axis_offset import AxisOffsetError, NudgeForce, ROLLING_mm, axis_offset

SIDES = (0, 1, 0, -1, 0)
STIFFNESS_N_mm = 18.0


def looks(rng, size, slope, drift_N=0.02, noise_N=0.005):
    """What the sensor shows: slope times nudge, an even drift, noise."""
    found = []
    for number, side in enumerate(SIDES):
        force = 0.3 + slope * side * size + drift_N * number
        found.append(NudgeForce(side * size, force + noise_N * rng.standard_normal(100)))
    return found


@pytest.mark.parametrize("offset_mm", [-3.0, 0.0, 0.3, 2.0])
def test_the_offset_is_found_within_its_error(offset_mm):
    rng = np.random.default_rng(4)
    found = [
        axis_offset(
            looks(rng, 0.02, STIFFNESS_N_mm), looks(rng, 0.0087, STIFFNESS_N_mm * offset_mm)
        )
        for _ in range(50)
    ]
    values = np.array([one.value for one in found])
    assert values.mean() == pytest.approx(offset_mm, abs=0.05)
    assert values.std() < 0.15
    assert all(one.covers(offset_mm) for one in found), "the error has room for the roll itself"
    assert all(one.standard_error >= ROLLING_mm for one in found)


def test_nudges_that_are_not_felt_give_no_offset():
    rng = np.random.default_rng(5)
    with pytest.raises(
        AxisOffsetError, match=r"axis cannot be measured: .* N/mm, .* does not stick"
    ):
        axis_offset(looks(rng, 0.02, 0.0), looks(rng, 0.0087, 0.0))
