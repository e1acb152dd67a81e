"""Profiles of a roll: where the object is to be, and which commands the stage gets for it."""

import numpy as np
import pytest
from pydantic import ValidationError

from procedures.roll_trial.profile import Curve, ThereAndBack
from procedures.roll_trial.settings import RollTrialSettings

WAYS = [
    ThereAndBack(3.5, 12.0, 60.0, 0.3),  # reaches its speed
    ThereAndBack(3.5, 100.0, 60.0, 0.3),  # a triangle of speed
    ThereAndBack(-3.5, 5.0, 500.0, 0.0),
]


@pytest.mark.parametrize("profile", WAYS)
def test_there_and_back_keeps_its_limits_and_its_ends(profile):
    t = np.linspace(-0.1, profile.duration_s + 0.1, 20_001)
    angles = np.array([profile.at_deg(float(x)) for x in t])
    speeds = np.gradient(angles, t)
    assert angles[0] == angles[-1] == 0
    assert np.abs(angles).max() == pytest.approx(3.5)
    assert np.sign(angles[np.abs(angles).argmax()]) == np.sign(profile.angle_deg)
    assert np.abs(speeds).max() <= profile.speed_deg_s * 1.001
    assert np.abs(np.gradient(speeds, t)).max() <= profile.acceleration_deg_s2 * 1.01
    stays = (t > profile.way_s) & (t < profile.way_s + profile.stay_s)
    assert (np.abs(angles[stays]) == pytest.approx(3.5)) or not stays.any()


def test_the_stage_gets_the_commands_to_go_there_and_back():
    there, back = WAYS[0].turns(0.01)
    assert (there.at_s, there.to_deg, there.speed_deg_s, there.acceleration_deg_s2) == (
        0.0, 3.5, 12.0, 60.0,
    )  # fmt: skip
    assert (back.to_deg, back.at_s) == (0.0, pytest.approx(WAYS[0].way_s + 0.3))


def test_a_curve_is_straight_between_its_times_and_streamed_ahead():
    curve = Curve((0.0, 0.2, 0.3, 0.6), (0.0, 2.0, 2.0, 0.0), 300.0)
    assert [curve.at_deg(t) for t in (-1.0, 0.1, 0.25, 0.45, 2.0)] == pytest.approx(
        [0.0, 1.0, 2.0, 1.0, 0.0]
    )
    turns = curve.turns(0.01)
    assert turns[0].at_s == 0.0
    assert turns[0].to_deg > curve.at_deg(0.01)
    assert turns[-1].to_deg == 0.0
    assert max(turn.speed_deg_s for turn in turns) == pytest.approx(16.0)  # the first holds two
    reported = np.diff([turn.at_s for turn in turns])
    assert reported.min() == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("angles", "there_s"),
    [
        ((0.0, 2.0, 2.0, 0.0), 0.25),
        ((0.0, 1.0, -2.0, 0.0), 0.3),
        ((0.0, 2.0, -2.0, 0.0), 0.2),
        ((0.0, 0.0, 0.0, 0.0), 0.3),
    ],
)
def test_a_curve_is_there_in_the_middle_of_its_stay_at_the_largest_angle(angles, there_s):
    assert Curve((0.0, 0.2, 0.3, 0.6), angles, 300.0).there_s == pytest.approx(there_s)
    assert WAYS[0].there_s == pytest.approx(WAYS[0].way_s + 0.15)


WRONG = [
    ({"profile_times_s": (0.0, 1.0, 2.0)}, "each time needs its angle"),
    ({"profile_times_s": (0.0, 2.0, 1.0), "profile_angles_deg": (0.0, 1.0, 0.0)}, "ascend"),
    ({"profile_times_s": (0.0, 1.0, 2.0), "profile_angles_deg": (0.0, 1.0, 1.0)}, "upright"),
    (
        {"profile_times_s": (0.0, 1e6, 2e6), "profile_angles_deg": (0.0, 1.0, 0.0)},
        "profile_times_s ends at 2e\\+06 s, later than 3600 s",
    ),
    ({"angle_deg": 0.0, "stay_s": 0.0}, "angle_deg 0 deg with stay_s 0 s has .* after 0 s"),
    (
        {"profile_times_s": (0.0, 0.001, 1.0), "profile_angles_deg": (0.0, 0.01, 0.0)},
        "profile_times_s has its largest angle after 0.001 s, less than 0.02 s",
    ),
    ({"normal_force_N": 20.0}, "not below largest_force_N"),
]


@pytest.mark.parametrize(("given", "words"), WRONG)
def test_what_cannot_be_rolled_is_refused(given, words):
    with pytest.raises(ValidationError, match=words):
        RollTrialSettings.model_validate(given)
