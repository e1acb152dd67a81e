"""Weights on the simulated bench: what becomes of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from procedures.pressed.grip_summary import grip_summary
from procedures.slip_trial.reading import SlipTrialRecord, _ramp, _weight
from procedures.slip_trial.settings import SlipTrialSettings
from rig.files.runfile.reader import RunFile


@pytest.mark.thorough
@pytest.mark.parametrize(("load", "outcome"), [("4N", "lost"), ("1.5N", "held")])
def test_a_weight_is_lost_where_the_contact_cannot_hold_it_also_if_it_comes_fast(
    rig: Any, load: str, outcome: str
) -> None:
    """4 N of normal force hold about 2.9 N."""
    done = rig.run(
        "slip-trial", "--json", "--no-figures", "--loading", "ramp", "--ramp", "20N/s",
        "--hold-at", load, "--speed", "2mm/s", "--distance", "3mm", "--rest", "100ms",
        "--force-error-peak", "1000", "--force-error-rms", "1000",
    )  # fmt: skip
    assert done.code in (0, 5), done.stderr
    with RunFile.open(rig.folder / done.object["file"]) as run:
        (reading,) = run.readings()
    assert reading["outcome"] == outcome
    assert (reading["slid_mm"] > 0.5) == (outcome == "lost")
    assert f"{outcome} 1" in " ".join(done.object["summary"]["grip"])


@pytest.mark.thorough
def test_a_weight_that_slides_slowly_and_without_end_is_lost(rig: Any) -> None:
    """5 N on a contact that holds some 2.9 N: at 0.2 mm/s it has slid 0.4 mm when a weight that
    rests would be held."""
    done = rig.run(
        "slip-trial", "--json", "--no-figures", "--loading", "ramp", "--detector", "none",
        "--hold-at", "5N", "--speed", "0.2mm/s", "--rest", "100ms",
        "--force-error-peak", "1000", "--force-error-rms", "1000",
    )  # fmt: skip
    assert done.code in (0, 5), done.stderr
    with RunFile.open(rig.folder / done.object["file"]) as run:
        (reading,) = run.readings()
    assert reading["outcome"] == "lost"


def test_the_end_of_a_ramp_does_not_limit_a_weight_which_replaces_it() -> None:
    """Files and plans may hold both, the end at its default or not."""
    weight = SlipTrialSettings(loading="ramp", hold_at_N=3.0, distance_mm=2.0, largest_force_N=8.0)
    assert weight.ramp_to_N == 10.0
    assert SlipTrialSettings.model_validate(weight.model_dump()) == weight
    with pytest.raises(ValidationError, match="ramp_to_N 10 N is not below largest_force_N 8 N"):
        SlipTrialSettings(loading="ramp", largest_force_N=8.0)
    with pytest.raises(ValidationError, match="hold_at_N 9 N is not below largest_force_N 8 N"):
        SlipTrialSettings(loading="ramp", hold_at_N=9.0, largest_force_N=8.0)


def test_a_weight_that_is_there_before_a_frame_of_the_force_is_has_no_error_of_its_ramp() -> None:
    """0.5 N at 100 N/s is there within the first tick; the trial was lost to an IndexError."""
    settings = SlipTrialSettings(loading="ramp", hold_at_N=0.5, ramp_N_s=100.0)
    record = SlipTrialRecord(1, 100.0, 1000.0, 4.0, motion_from_s=1.0, ramp_to_s=1.0004)
    times_s, force_N = np.array([0.9997, 1.0007]), np.zeros((2, 3))
    assert _ramp(settings, record, times_s, force_N) == {
        "ramp_error_rms_N": None,
        "ramp_to_s": None,
    }


@pytest.mark.parametrize(("normal_N", "least"), [(0.5, 0.975), (1.0, 0.988), (4.0, 0.997)])
def test_noise_of_single_frames_makes_the_least_force_hardly_smaller(normal_N, least) -> None:
    """The weight is all that the contact holds, so that the force used is the least; the forces
    have 3 mN of noise for 4 s. By single frames it was 0.96, 0.98 and 0.995 of that."""
    rng = np.random.default_rng(0)
    load_N, t = 0.6 * normal_N, np.arange(4000) / 1000
    force_N = 0.003 * rng.standard_normal((t.size, 3))
    force_N[:, 0] += normal_N
    force_N[:, 1] += load_N * np.minimum(t, 1.0)
    settings = SlipTrialSettings(loading="ramp", hold_at_N=load_N, normal_force_N=normal_N)
    record = SlipTrialRecord(1, 100.0, 1000.0, normal_N, weight_rested=True)
    found = _weight(settings, record, {}, t, force_N)
    assert found["outcome"] == "held"
    assert least < found["least_force_N"] / normal_N <= 1.0


def trial(outcome: str, used_N: float, shown_N: float, true_N: float | None) -> dict[str, Any]:
    """Return what the reading of a weight says of forces."""
    return {
        "outcome": outcome,
        "force_used_N": used_N,
        "least_force_N": shown_N,
        "least_force_true_N": true_N,
    }


def test_the_force_used_is_stated_as_a_bound_and_by_the_true_coefficient_of_a_simulation() -> None:
    kept = [trial("averted", 4.8, 4.8, 3.75), trial("lost", 4.0, 2.0, 6.25)]
    weights, force = grip_summary(kept)["grip"]
    assert weights == "Weights: held 0, averted 1, lost 1 (averted: at rest after a squeeze)."
    assert "about 1.00 or more by the largest F_t/F_n that a trial showed over 5 ms" in force
    assert "1.28 by the simulation's coefficient of friction (median of 1)" in force
    weights, force = grip_summary([trial("held", 4.8, 4.8, None)])["grip"]
    assert weights == "Weights: held 1, averted 0, lost 0."
    assert "simulation" not in force
