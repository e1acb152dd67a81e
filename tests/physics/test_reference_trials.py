"""The reference slide and rolls: what a user of the simulated skin sees in v_1, v_2 and v_d."""

import numpy as np
import pytest

from rig.analysis.response.spectrum import share_above
from rig.physics.contact.settings import ContactSettings, Cylinder, FrictionSettings, Plate, Sphere
from rig.physics.skin.condensed import CondensedSkin, build_skin
from rig.physics.skin.settings import SkinSettings
from rig.physics.trials import (
    PressSettings,
    RollSettings,
    SampleSettings,
    SkinTrial,
    SlideSettings,
    high_frequency,
    roll,
    slide,
)


def hf_peak(trial: SkinTrial, ridge: int = 3) -> float:
    """Largest |v_d| in mV above 100 Hz from the shear's beginning until the ridge has slipped."""
    rate = 1 / (trial.time_s[1] - trial.time_s[0])
    fast = np.abs(high_frequency(trial.filtered_v_d, rate))
    end = trial.truth.whole_slip_s[ridge - 1] + 0.02
    window = (trial.time_s > trial.motion_s + 0.01) & (trial.time_s < end)
    return float(fast[window].max() * 1e3)


def v_d_between(trial: SkinTrial, start: float, end: float) -> np.ndarray:
    """Sampled v_d in mV."""
    inside = (trial.sample_time_s > start) & (trial.sample_time_s <= end)
    return trial.v_d[inside] * 1e3


def test_ridges_slip_in_the_order_of_the_reference_case(reference_slide: SkinTrial):
    assert reference_slide.truth.slip_order() == [1, 9, 2, 3, 8, 4, 7, 5, 6]


def test_every_ridge_slips_partly_before_it_slips_whole(reference_slide: SkinTrial):
    truth = reference_slide.truth
    assert (truth.first_slip_s[1:8] < truth.whole_slip_s[1:8] - 0.01).all()
    assert truth.gross_slip_s == pytest.approx(np.max(truth.whole_slip_s))


def test_shear_raises_a_hump_of_3_to_4_millivolts(reference_slide: SkinTrial):
    """Seen between the end of the speed's ramp and the neighbour's slip."""
    hump = v_d_between(reference_slide, 0.52, reference_slide.truth.whole_slip_s[1] - 0.02)
    assert 3.0 <= np.median(hump) <= 4.0
    assert hump.min() > 0


def test_the_neighbours_slip_is_a_small_pulse_with_the_humps_sign_then_a_small_drop(
    reference_slide: SkinTrial,
):
    """+1..+2 mV over the level that follows, and that level is lower (decision 0020)."""
    at = reference_slide.truth.whole_slip_s[1]
    time, v_d = reference_slide.time_s, reference_slide.filtered_v_d * 1e3

    def level(start: float, end: float) -> float:
        return float(np.median(v_d[(time > at + start) & (time < at + end)]))

    pulse = v_d[np.abs(time - at) < 0.01].max() - level(0.01, 0.02)
    assert 1.0 <= pulse <= 2.0
    assert level(-0.02, -0.005) - 0.8 < level(0.01, 0.02) < level(-0.02, -0.005) - 0.2


def test_the_slip_of_ridge_3_is_a_short_impulse_against_the_hump(reference_slide: SkinTrial):
    at = reference_slide.truth.whole_slip_s[2]
    impulse = v_d_between(reference_slide, at - 0.01, at + 0.02).min()
    assert -32 <= impulse <= -28
    fine = reference_slide.filtered_v_d * 1e3
    near = np.abs(reference_slide.time_s - at) < 0.01
    width_ms = (fine[near] < fine[near].min() / 2).sum() * 0.1
    assert 1.5 <= width_ms <= 2.5


def test_the_impulse_has_a_high_frequency_part_and_the_hump_has_none(reference_slide: SkinTrial):
    """Reference: 37 % above 100 Hz around the slip, 2 % before; windows of 64 ms and 95 ms."""
    at = reference_slide.truth.whole_slip_s[2]
    around = share_above(v_d_between(reference_slide, at - 0.032, at + 0.032), 1000.0, 100.0)
    before = share_above(v_d_between(reference_slide, at - 0.1, at - 0.005), 1000.0, 100.0)
    assert 0.32 <= around <= 0.42
    assert before <= 0.02


def test_the_hf_peak_is_that_of_the_converged_mesh(reference_slide: SkinTrial):
    """16.3 mV here; the reference's 18.7 mV is one sampling phase on a mesh that is not converged
    (decision 0020)."""
    assert hf_peak(reference_slide) == pytest.approx(16.3, rel=0.03)


@pytest.mark.parametrize(
    ("speed_mm_s", "slide_s", "lead_ms"), [(0.3, 0.6, 166.0), (0.5, 0.4, 100.0), (6.0, 0.12, 9.0)]
)
def test_ridge_3_leads_gross_slip(skin6: CondensedSkin, speed_mm_s, slide_s, lead_ms):
    trial = slide(skin6, SlideSettings(speed_mm_s=speed_mm_s, slide_s=slide_s))
    lead = trial.truth.gross_slip_s - trial.truth.whole_slip_s[2]
    assert lead * 1e3 == pytest.approx(lead_ms, rel=0.03)


@pytest.mark.parametrize(
    ("ratio", "peaks_mV"),
    [
        (0.7, (36.3, 50.1, 34.1, 2.2)),
        pytest.param(0.85, (5.7, 9.8, 3.4, 0.74), marks=pytest.mark.thorough),
        pytest.param(0.95, (0.82, 0.86, 0.59, 0.39), marks=pytest.mark.thorough),
    ],
)
def test_without_a_drop_or_with_a_long_one_there_is_no_impulse(skin6, ratio, peaks_mV):
    """HF peak against μ_k/μ_s at D_c 1, 3, 10, 30 µm: from 0.95 or at 30 µm nothing to find.

    The reference's table has the same shape. Its first row agrees within 15 %; its smaller drops
    are up to 2.3 times larger at D_c below 10 µm, where no mesh here has converged (decision 0020).
    """
    for distance, expected in zip((1.0, 3.0, 10.0, 30.0), peaks_mV, strict=True):
        friction = FrictionSettings(kinetic_coefficient=0.8 * ratio, weakening_distance_um=distance)
        trial = slide(skin6, SlideSettings(contact=ContactSettings(friction=friction)))
        assert hf_peak(trial) == pytest.approx(expected, rel=0.05), distance


@pytest.mark.parametrize(("start_x_mm", "peaks_mV"), [(-6.5, (-11.7, -14.3)), (-5.0, (5.7, -3.8))])
def test_a_roll_shows_both_patterns_of_figure_19_without_an_impulse(
    skin8: CondensedSkin, start_x_mm, peaks_mV
):
    trial = roll(skin8, RollSettings(start_x_mm=start_x_mm))
    rolling = trial.sample_time_s > trial.motion_s
    volts = trial.sampled[rolling] * 1e3
    seen = [volts[np.abs(volts[:, c]).argmax(), c] for c in (0, 1)]
    assert seen == pytest.approx(peaks_mV, rel=0.05)
    assert share_above(trial.v_d[rolling], 1000.0, 100.0) <= 0.004
    assert np.isnan(trial.truth.whole_slip_s[2])


def test_an_axis_that_is_off_shears_the_skin_and_may_slip_ridge_3(skin6: CondensedSkin):
    force, slips = [], []
    for offset in (0.0, 2.0, 5.0):
        trial = roll(skin6, RollSettings(axis_offset_mm=offset))
        force.append(np.abs(trial.block.tangential_force_N[-1]))
        slips.append(bool(np.isfinite(trial.truth.whole_slip_s[2])))
    assert force[0] < 0.1
    assert force[1] == pytest.approx(1.4, abs=0.15)
    assert slips == [False, False, True]


def test_a_sphere_may_press_harder_than_its_slices_cover_by_default(skin6: CondensedSkin):
    settings = RollSettings(
        body=Sphere(slices=2), press=PressSettings(normal_force_N=9.0), roll_s=0.02, settle_s=0.0
    )
    trial = roll(skin6, settings)
    assert trial.block.normal_force_N[-1] == pytest.approx(9.0, rel=1e-9)


def test_a_sphere_rolls_with_the_signs_of_a_cylinder(skin6: CondensedSkin):
    sphere = roll(skin6, RollSettings(body=Sphere()))
    cylinder = roll(skin6, RollSettings())
    for trial in (sphere, cylinder):
        rolling = trial.sample_time_s > trial.motion_s
        volts = trial.sampled[rolling]
        peaks = [volts[np.abs(volts[:, c]).argmax(), c] for c in (0, 1)]
        assert peaks[0] > 0 > peaks[1]
    assert sphere.block.normal_force_N[-1] == pytest.approx(4.0, rel=1e-9)


def test_gross_slip_takes_a_travel_of_0_15_mm(reference_slide: SkinTrial):
    at = np.searchsorted(reference_slide.time_s, reference_slide.truth.gross_slip_s)
    assert reference_slide.block.position_mm[at] == pytest.approx(0.15, abs=0.01)


@pytest.mark.thorough
def test_what_the_strips_read_does_not_hang_on_the_mesh(skin_cache, skin6, reference_slide):
    """From 6 to 12 elements a ridge: HF peak within 15 %, whole slips within 1 ms.

    Ridge 8 is the exception: it slips 2.1 ms later at 12 elements than at 6, 0.6 ms later than
    at 8 (decision 0020).
    """
    skin12 = build_skin(SkinSettings(elements_per_ridge=12), skin_cache)
    trials = [slide(skin6, SlideSettings()), reference_slide, slide(skin12, SlideSettings())]
    peaks = [hf_peak(trial) for trial in trials]
    assert max(peaks) < 1.15 * min(peaks)
    whole = np.array([trial.truth.whole_slip_s for trial in trials])
    spread_ms = np.ptp(whole, axis=0) * 1e3
    assert np.delete(spread_ms, 7).max() <= 1.0
    assert spread_ms[7] <= 2.5
    assert np.ptp(whole[1:], axis=0).max() <= 1e-3


@pytest.mark.parametrize(
    ("step_us", "peak_mV", "late_ms"), [(1000.0, 5.8, 1.8), (250.0, 13.6, 0.6), (50.0, 17.4, 0.1)]
)
def test_a_coarse_step_blunts_the_impulse(skin8, step_us, peak_mV, late_ms):
    """Friction weakens one step late: first order in the step; 100 µs gives 16.3 mV."""
    trial = slide(skin8, SlideSettings(contact=ContactSettings(step_us=step_us)))
    assert hf_peak(trial) == pytest.approx(peak_mV, rel=0.03)
    assert trial.truth.whole_slip_s[2] == pytest.approx(0.68625 + late_ms * 1e-3, abs=2e-4)


def test_trials_that_cannot_be_are_refused():
    small = build_skin(SkinSettings(ridges=1, elements_per_ridge=2))
    with pytest.raises(ValueError, match="plate cannot roll"):
        roll(small, RollSettings(body=Plate()))
    with pytest.raises(ValueError, match="rate_Hz 3000 Hz must divide"):
        slide(small, SlideSettings(ridge=1, sample=SampleSettings(rate_Hz=3000.0)))
    with pytest.raises(ValueError, match="filter_Hz 6000 Hz must be below half"):
        slide(small, SlideSettings(ridge=1, sample=SampleSettings(filter_Hz=6000.0)))
    with pytest.raises(ValueError, match="watched_ridge 4 must lie between"):
        slide(small, SlideSettings(ridge=5))
    with pytest.raises(ValueError, match="greater than 0"):
        Cylinder(radius_mm=0.0)
