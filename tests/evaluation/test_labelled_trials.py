"""Labelled random trials: drawn from their seed alone, true to their labels, cached bit by bit."""

from pathlib import Path

import numpy as np
import pytest
from tiers import mostly_thorough

from rig.core.cache import DiskCache
from rig.evaluation.front_ends import through_front_end
from rig.evaluation.labelled_trials import USUAL_KINDS, Kind, LabelledTrial, labelled_trial
from rig.physics.population import PopulationSettings, Range, StripFrontEndSettings
from rig.physics.skin.condensed import CondensedSkin, build_skin
from rig.physics.skin.settings import SkinSettings

COARSE = PopulationSettings(skin=SkinSettings(elements_per_ridge=6))
"""A mesh that is made in a second; what is tested here does not depend on it."""
SEEDS = 3


@pytest.fixture(scope="module")
def skin() -> CondensedSkin:
    return build_skin(COARSE.skin)


@pytest.fixture(scope="module")
def trials(skin: CondensedSkin) -> dict[tuple[Kind, int], LabelledTrial]:
    return {
        (kind, seed): labelled_trial(skin, kind, seed, COARSE)
        for kind in USUAL_KINDS
        for seed in range(SEEDS)
    }


def equal(one: LabelledTrial, other: LabelledTrial) -> bool:
    plain = [
        {k: v for k, v in vars(trial).items() if k not in ("volts", "force_N")}
        for trial in (one, other)
    ]
    same = str(plain[0]) == str(plain[1])
    return same and (one.volts == other.volts).all() and (one.force_N == other.force_N).all()


@pytest.mark.parametrize("kind", USUAL_KINDS)
def test_a_trial_is_its_kind_and_seed(skin: CondensedSkin, trials, kind: Kind):
    assert equal(labelled_trial(skin, kind, 1, COARSE), trials[kind, 1])
    assert not equal(trials[kind, 0], trials[kind, 1])


def test_the_cache_gives_back_the_same_bits(skin: CondensedSkin, trials, tmp_path: Path):
    cache = DiskCache(tmp_path)
    assert equal(labelled_trial(skin, "roll", 2, COARSE, cache), trials["roll", 2])
    assert equal(labelled_trial(skin, "roll", 2, COARSE, cache), trials["roll", 2])
    assert len(list(tmp_path.iterdir())) == 1


def test_a_damaged_cache_is_no_answer(skin: CondensedSkin, trials, tmp_path: Path):
    cache = DiskCache(tmp_path)
    labelled_trial(skin, "tap", 2, COARSE, cache)
    (file,) = tmp_path.iterdir()
    cache.put(file.stem, b"something else")
    file.write_bytes(file.read_bytes()[:-7])
    assert equal(labelled_trial(skin, "tap", 2, COARSE, cache), trials["tap", 2])


def test_a_trial_begins_with_quiet_and_slips_in_order(trials):
    for trial in trials.values():
        assert (trial.volts[:300] == 0).all()
        assert trial.motion_s > 0.3
        assert (trial.force_N[:300] == 0).all()
    for seed in range(SEEDS):
        slide = trials["slide", seed]
        assert slide.label == "slip"
        assert slide.motion_s < slide.node_slip_s <= slide.ridge_slip_s <= slide.gross_slip_s
        assert len(slide.volts) / slide.rate_Hz == pytest.approx(
            slide.gross_slip_s + 0.06, abs=0.01
        )


def test_a_hold_stops_before_gross_slip_and_keeps_its_shear(trials):
    for seed in range(SEEDS):
        hold = trials["hold", seed]
        assert np.isnan(hold.gross_slip_s)
        assert abs(hold.force_N[-1, 1]) > 0.02 * hold.force_N[-1, 0]


def test_the_label_follows_from_the_truth(trials):
    for trial in trials.values():
        slipped, lifted = np.isfinite(trial.ridge_slip_s), np.isfinite(trial.lift_off_s)
        wanted = {
            "slip": slipped,
            "lift-off": lifted,
            "slip in a roll": slipped and not lifted,
        }.get(trial.label, not slipped)
        assert wanted, trial


def test_the_normal_force_is_the_one_drawn(trials):
    slide = trials["slide", 0]
    at = round(slide.motion_s * slide.rate_Hz)
    assert slide.force_N[at:, 0] == pytest.approx(slide.traits["normal_force_N"], rel=1e-5)


def test_what_is_heard_is_the_trial_with_noise_of_the_stated_size(trials):
    front_end = StripFrontEndSettings(
        mains_mV=Range(low=0, high=0), gain_mismatch=Range(low=0, high=0)
    )
    trial = trials["slide", 2]
    volts, added = through_front_end(trial, front_end)
    noise = 1e3 * (volts - trial.volts)
    assert noise.std() == pytest.approx(added["noise_mV"], rel=0.1)
    assert np.corrcoef(noise.T)[0, 1] == pytest.approx(0, abs=0.15)
    assert (through_front_end(trial, front_end)[0] == volts).all()
    assert (through_front_end(trial, front_end, hearing=1)[0] != volts).any()


def test_a_slide_in_the_other_direction_drives_the_strips_the_other_way(trials):
    """Before any slip v_d has the sign that direction and place decide, the same in all trials."""
    signs = set()
    for seed in range(SEEDS):
        trial = trials["slide", seed]
        begin, end = (round(t * trial.rate_Hz) for t in (trial.motion_s, trial.node_slip_s))
        v_d = (trial.volts[:, 0] - trial.volts[:, 1])[begin + 2 : max(end, begin + 8)]
        signs.add(np.sign(v_d.sum()) * trial.traits["direction"])
    assert signs == {1.0}


@pytest.mark.parametrize(
    "kind",
    mostly_thorough(
        ("again", "reversal", "tremor", "falling force", "re-grip", "lift-off"),
        ("reversal", "falling force"),
    ),
)
def test_each_further_kind_does_what_its_name_says(skin: CondensedSkin, kind: Kind):
    trial = labelled_trial(skin, kind, 2, COARSE)
    force_N, shear_N = trial.force_N.T
    at = round(trial.motion_s * trial.rate_Hz)
    if kind in ("reversal", "tremor", "re-grip"):
        assert trial.label == "hold"
        assert not len(trial.slips_s)
    if kind == "reversal":
        assert shear_N[at:].max() > 0.05 * force_N[at]
        assert shear_N[at:].min() < -0.05 * force_N[at]
    if kind == "tremor":
        turns = np.count_nonzero(np.diff(np.sign(np.diff(shear_N[-800:]))))
        assert turns == pytest.approx(2 * 0.8 * trial.traits["tremor_Hz"], abs=2)
    if kind == "re-grip":
        assert force_N[-1] == pytest.approx((1 + trial.traits["grip_share"]) * force_N[at], 1e-3)
    if kind == "falling force":
        assert trial.label == "slip"
        slipped = round(trial.ridge_slip_s * trial.rate_Hz)
        assert force_N[slipped] < 0.99 * force_N[at]
    if kind == "lift-off":
        assert trial.label == "lift-off"
        assert force_N[-1] < 0.1 * force_N[at]
    if kind == "again":
        assert len(trial.slips_s) >= 2
        assert (trial.slips_s[:, 1] > trial.slips_s[:, 0]).all()
        assert (trial.slips_s[1:, 0] - trial.slips_s[:-1, 1] >= 0.005 - 1e-9).all()
    if trial.label == "slip":
        assert trial.slips_s[0, 0] == pytest.approx(trial.ridge_slip_s, abs=2e-4)


def test_ticks_of_the_servo_put_steps_on_the_force_and_not_before_it_presses(skin: CondensedSkin):
    share = Range(low=0.01, high=0.01)
    ticking = COARSE.model_copy(update={"tick_share": share})
    trial, plain = (labelled_trial(skin, "tap", 3, one) for one in (ticking, COARSE))
    rests = slice(round((trial.motion_s - 0.08) * 1000), round(trial.motion_s * 1000))
    relative = trial.force_N[rests, 0] / plain.force_N[rests, 0] - 1
    assert 0.004 < relative.std() < 0.06
    assert plain.volts[rests].sum(axis=1).std() < trial.volts[rests].sum(axis=1).std() / 5
    assert (trial.volts[:300] == 0).all()


@pytest.mark.thorough
def test_a_drawn_skin_is_another_for_every_seed(skin: CondensedSkin):
    drawn = COARSE.model_copy(update={"drawn_skin": True})
    trials = [labelled_trial(skin, "tap", seed, drawn) for seed in (0, 1)]
    moduli = {trial.traits["youngs_modulus_MPa"] for trial in trials}
    assert len(moduli) == 2
    assert all(0.85 <= modulus <= 3.4 for modulus in moduli)
    assert {trial.traits["strip_offset_mm"] for trial in trials} <= {0.25, 0.3, 0.35, 0.4, 0.45}


def test_a_record_ends_and_its_truth_with_it(skin: CondensedSkin, trials):
    for trial in trials.values():
        times = [trial.node_slip_s, trial.ridge_slip_s, trial.gross_slip_s, trial.lift_off_s]
        assert not any(at > len(trial.volts) / trial.rate_Hz for at in times)
