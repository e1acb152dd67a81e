"""What a roll trial reads from its strips."""

from __future__ import annotations

import json
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from procedures.roll_trial import RollTrial
from procedures.roll_trial.reading import RollTrialRecord, reading_of
from procedures.roll_trial.settings import RollTrialSettings
from rig.control.tick_loop import LoopStatistics


def rolled(
    rest_s: float,
    scale: float = 1.0,
    noise_mV: np.ndarray | float = 0.0,
    curve: tuple[tuple[float, ...], tuple[float, ...]] = ((), ()),
    late_s: float = 0.0,
) -> dict[str, Any]:
    """Return the reading of a roll that begins `rest_s` after the tap, with its warnings; along a
    `curve` of times and angles the object is `late_s` behind.

    The servo takes over with -4 mV in the first 60 ms; on the way there v_2 falls to -4.4 mV and
    then rises to 4 mV.
    """
    settings = RollTrialSettings(
        rest_s=rest_s, profile_times_s=curve[0], profile_angles_deg=curve[1]
    )
    found = RollTrialRecord(1, 100.0, 1000.0, 4.0)
    found.tapped_s, found.motion_from_s = 1.0, 1.0 + rest_s
    profile = settings.profile_at(100.0)
    way_s = profile.duration_s / 2
    found.motion_to_s = found.motion_from_s + 2 * way_s
    t = np.arange(round(1000 * (found.motion_to_s + 0.2))) / 1000
    v_2 = np.where((t >= 1.0) & (t < 1.06), -4.0, 0.0)
    part = (t - found.motion_from_s) / way_s
    v_2 += np.where((part >= 0) & (part < 0.5), -4.4 * np.sin(2 * math.pi * part), 0.0)
    v_2 += np.where((part >= 0.5) & (part < 1), -4.0 * np.sin(2 * math.pi * part), 0.0)
    noise = noise_mV[: len(t)] if isinstance(noise_mV, np.ndarray) else noise_mV
    found.volts = [1e-3 * (scale * np.stack([np.zeros_like(v_2), v_2], axis=1) + noise)]
    found.force = [np.tile([4.0, 0.0, 0.0], (len(t), 1))]
    found.rows, found.frames = 10 * len(t), len(t)
    since_s = t[::10] - found.motion_from_s
    asked_deg = [profile.at_deg(s) if curve[0] else 0.0 for s in since_s]
    where_deg = [profile.at_deg(s - late_s) if curve[0] else 0.0 for s in since_s]
    found.rotation = [
        (float(s), at, asked) for s, at, asked in zip(t[::10], where_deg, asked_deg, strict=True)
    ]
    found.loops = [LoopStatistics(200, 0, 0, 0.0)]
    warnings: list[str] = []
    run: Any = SimpleNamespace(
        settings=settings,
        event=lambda kind, topic, text: warnings.append(text),
        check_stop=lambda: None,
        clock=SimpleNamespace(truth=dict),
        force=SimpleNamespace(axes="xyz"),
    )
    return dict(reading_of(run, found, None)) | {"warnings": warnings}


@pytest.mark.parametrize("rest_s", [0.1, 0.15, 0.3])
def test_a_short_rest_does_not_shift_the_zero_of_the_strips(rest_s: float) -> None:
    assert rolled(rest_s)["peak_2_mV"] == pytest.approx(-4.4, abs=0.05)


@pytest.mark.parametrize("angles", [(0.0, 3.0, -3.0, 0.0), (0.0, -3.0, 3.0, 0.0)])
def test_a_curve_to_both_sides_that_was_followed_has_no_error(angles: tuple[float, ...]) -> None:
    """Found by an attack: 3 deg to one side were compared with 3 deg to the other, 6 deg apart."""
    found = rolled(0.3, curve=((0.0, 0.5, 1.5, 2.0), angles))
    assert found["angle_error_deg"] == pytest.approx(0.0, abs=1e-9)
    assert abs(found["angle_deg"]) == pytest.approx(3.0)
    assert found["invalid"] == ""


def test_a_turn_that_is_late_has_a_warning_with_its_size() -> None:
    """Found by an attack: a stage that turned at 80 % of its speed made a valid trial without a
    word, its peaks 10 to 15 % smaller."""
    curve = ((0.0, 0.25, 0.55, 0.8), (0.0, 3.0, 3.0, 0.0))
    assert not [
        text for text in rolled(0.3, curve=curve, late_s=0.015)["warnings"] if "away" in text
    ]
    late = rolled(0.3, curve=curve, late_s=0.026)
    (text,) = [text for text in late["warnings"] if "away" in text]
    assert "trial-001: the object was up to 0.31 deg away" in text
    assert "more than 20 ms at 12 deg/s" in text
    assert "--turn-acceleration" in text


def test_the_peaks_of_a_curve_are_those_on_the_way_to_its_largest_angle() -> None:
    """v_2 has -4.4 mV at a quarter of the way there of a roll there and back, here 0.25 s."""
    slow_back = rolled(0.3, curve=((0.0, 0.1, 2.0), (0.0, 3.0, 0.0)))
    assert abs(slow_back["peak_2_mV"]) < 3.0
    slow_there = rolled(0.3, curve=((0.0, 1.9, 2.0), (0.0, 3.0, 0.0)))
    assert slow_there["peak_2_mV"] == pytest.approx(-4.4, abs=0.05)


def test_what_is_above_100_hz_does_not_depend_on_the_size_of_the_roll() -> None:
    """A share of the energy called noise 3 % of a small roll and 0.3 % of a large one."""
    random = np.random.default_rng(0)
    noise_mV = 0.1 * random.standard_normal((3000, 2))
    small, large = (rolled(0.3, scale, noise_mV) for scale in (0.1, 1.0))
    for found in (small, large):
        assert found["high_roll_rms_mV"] == pytest.approx(0.1 * math.sqrt(2 * 0.8), rel=0.1)
        assert found["high_rest_rms_mV"] == pytest.approx(0.1 * math.sqrt(2 * 0.8), rel=0.35)
    assert small["high_roll_rms_mV"] == pytest.approx(large["high_roll_rms_mV"], rel=0.02)


def test_the_summary_sets_a_roll_beside_rest_and_slip() -> None:
    found = RollTrial(RollTrialSettings()).summarise(
        [rolled(0.3) | {"invalid": "", "axis_offset_mm": 0.0}]
    )
    (text,) = found["high_frequencies"]
    assert "mV rms in the roll and" in text
    assert "mV at rest" in text
    assert "ASSUMED" in text


def test_the_summary_says_what_the_world_put_in() -> None:
    """The World's usual head is a cylinder, under a fixture with the name of the paper's."""
    truth = {
        "object": {"shape": "cylinder", "radius_mm": 30.0},
        "static_coefficient": 0.8,
        "kinetic_coefficient": 0.65,
        "weakening_distance_um": 5.0,
    }
    reading = rolled(0.3) | {"invalid": "", "simulated_truth": json.dumps(truth)}
    text = " ".join(RollTrial(RollTrialSettings()).summarise([reading])["put_in"])
    assert "a cylinder of 30 mm radius, not the paper's semi-spherical head" in text
    assert "calibrated so that all nine ridges touch at 4 N" in text
    assert "ASSUMED" in text


def test_what_the_sentence_on_high_frequencies_says_has_no_line_of_its_own() -> None:
    procedure = RollTrial(RollTrialSettings())
    two = procedure.summarise([rolled(0.3, scale) | {"invalid": ""} for scale in (1.0, 1.1)])
    assert "standard_deviation_high_roll_rms_mV" in two
    said = procedure.in_brief(two, {})
    assert [line for line in said if "rms" in line and "force" not in line] == two[
        "high_frequencies"
    ]
