"""What a series of slip trials is summed up to."""

from __future__ import annotations

from dataclasses import replace

import pytest

from procedures.path_trial import PathTrial
from procedures.roll_trial import RollTrial
from procedures.slip_trial import SlipTrial
from rig.detector.events import SlipEvent
from rig.files.journal.detections import Detection, detection_of, from_text, to_text


def reading(static: float | None, **changes: object) -> dict[str, object]:
    return {
        "invalid": "",
        "static_friction": static,
        "kinetic_friction": None,
        "force_error_rms_percent": 0.2,
        "force_error_peak_percent": 1.0,
        "overshoot_percent": 0.3,
        "no_friction": "",
    } | changes


def test_a_series_has_means_and_standard_deviations_of_the_trials_that_count() -> None:
    trials = [reading(0.6), reading(0.8), reading(9.0, invalid="late ticks")]
    found = SlipTrial(SlipTrial.Settings()).summarise(trials)
    assert found["valid_trials"] == 2
    assert found["mean_static_friction"] == pytest.approx(0.7)
    assert found["standard_deviation_static_friction"] == pytest.approx(0.1 * 2**0.5)
    assert "mean_kinetic_friction" not in found


def test_a_single_trial_has_no_standard_deviation() -> None:
    assert not any(
        "deviation" in name for name in SlipTrial(SlipTrial.Settings()).summarise([reading(0.6)])
    )


def test_one_trial_is_shown_without_the_word_mean_and_in_three_digits() -> None:
    procedure = SlipTrial(SlipTrial.Settings())
    one = procedure.summarise([reading(0.67984), reading(9.0, invalid="late ticks")])
    said = list(procedure.in_brief(one, {}))
    assert said == [
        "valid: 1 of 2 trials",
        "static friction: 0.68",
        "error of the normal force, rms: 0.2 %",
        "error of the normal force, peak: 1 %",
        "overshoot of the normal force: 0.3 %",
    ]
    two = procedure.summarise([reading(0.6), reading(0.8)])
    assert "static friction: 0.70 ± 0.14" in procedure.in_brief(two, {})


def test_a_roll_and_a_path_name_their_values_in_words() -> None:
    roll = {"valid_trials": 1, "trials": 1, "mean_peak_1_mV": 5.8949, "mean_angle_error_deg": 0.0}
    assert list(RollTrial(RollTrial.Settings()).in_brief(roll, {})) == [
        "valid: 1 of 1 trial",
        "strip 1, peak in the roll: 5.89 mV",
        "error of the angle at rest: 0 deg",
    ]
    path = {"mean_largest_tangential_N": 0.1547, "mean_smallest_normal_N": 3.9649}
    assert list(PathTrial(PathTrial.Settings()).in_brief(path, {})) == [
        "largest tangential force: 0.155 N",
        "smallest normal force: 3.96 N",
    ]


def test_why_a_trial_has_no_friction_coefficients_is_said() -> None:
    trials = [reading(0.6), reading(None, no_friction="the slide is too short; slide further")]
    (reported,) = SlipTrial(SlipTrial.Settings()).summarise(trials)["no_friction"]
    assert reported.startswith("no friction coefficients in 1 of 2 trials: the slide is too short")


def test_strips_gains_and_the_last_zero_of_the_force_are_reported() -> None:
    def touched(gain: float, zero_N: float, **changes: object) -> dict[str, object]:
        zero = {"force_zero_x_N": 0.0, "force_zero_y_N": -0.1, "force_zero_z_N": zero_N}
        gains = {"touch_gain_1_V_s_N": gain, "touch_gain_2_V_s_N": None}
        return reading(0.6, **zero, **gains, **changes)

    trials = [touched(-2e-4, 0.1), touched(-4e-4, 0.2, invalid="late ticks")]
    found = SlipTrial(SlipTrial.Settings()).summarise(trials)
    assert found["mean_touch_gain_1_dB"] == pytest.approx(-70.458, abs=1e-3)
    assert "mean_touch_gain_2_dB" not in found
    assert found["force_zero_N"] == [0.0, -0.1, 0.2]


def test_the_summary_has_errors_of_the_means_and_the_instants_of_slip() -> None:
    slip = Detection("incipient slip", 2178, 2.178, 2.18, 0.7, "", 1.8, 21.2)
    before = Detection("predictive", 1384, 1.384, 1.4, 0.5)
    trials = [
        reading(0.60) | {"trial": 1.0, "detections": to_text([before, slip])},
        reading(0.64) | {"trial": 2.0, "detections": ""},
    ]
    found = SlipTrial(SlipTrial.Settings()).summarise(trials)
    assert found["slips"] == {
        "trial": [1.0],
        "time_s": [2.178],
        "decided_s": [2.18],
        "confidence": [0.7],
        "predictive_mV": [1.8],
        "impulse_mV": [21.2],
    }
    assert found["standard_errors"]["mean_static_friction"] == pytest.approx(0.02)
    one = reading(0.6) | {"static_friction_error": 0.004}
    alone = SlipTrial(SlipTrial.Settings()).summarise([one])
    assert alone["standard_errors"]["mean_static_friction"] == 0.004
    assert "slips" not in alone
    old = reading(0.6) | {
        "trial": 1.0,
        "detections": to_text([before, replace(slip, predictive_mV=None, impulse_mV=None)]),
    }
    said = SlipTrial(SlipTrial.Settings()).summarise([old])["slips"]
    assert list(said) == ["trial", "time_s", "decided_s", "confidence"], "it states no amplitudes"


def test_the_amplitudes_by_which_a_detector_decided_stay_with_the_detection() -> None:
    features = {"predictive_mV": 1.8, "impulse_mV": 21.2, "threshold_mV": 10.0}
    event = SlipEvent("incipient slip", 2178, 2.178, 0.7, features=features)
    (found,) = from_text(to_text([detection_of(event, 2.18)]))
    assert (found.predictive_mV, found.impulse_mV) == (1.8, 21.2)
    other = SlipEvent("incipient slip", 2178, 2.178, 0.7)
    assert detection_of(other, 2.18).impulse_mV is None
    of_before = '[{"kind": "incipient slip", "sample": 1, "time_s": 0.1, "decided_s": 0.2, '
    (older,) = from_text(of_before + '"confidence": 0.5, "reason": ""}]')
    assert older.predictive_mV is None
