"""The paper's simulation 4.2 and the design map."""

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.sparse import diags
from scipy.sparse.linalg import eigsh
from tiers import mostly_thorough

from rig.physics import loading_history
from rig.physics.contact.stepper import OPEN
from rig.physics.design_map import MapSettings, design_map
from rig.physics.loading_history import (
    NORMAL_RAISED,
    RELIEFS,
    History,
    HistorySettings,
    LoadPoint,
    run_history,
)
from rig.physics.skin.elasticity import ElasticSkin
from rig.physics.skin.settings import SkinSettings


@pytest.fixture(scope="module", params=mostly_thorough(sorted(RELIEFS), default=["normal_raised"]))
def history(request: pytest.FixtureRequest) -> History:
    return run_history(HistorySettings(loads=RELIEFS[request.param]))


def mean_rate(history: History, start: int, end: int) -> float:
    """Mean rate of the stress difference between two steps, MPa a step."""
    difference = history.difference
    return float((difference[end - 1] - difference[start - 1]) / (end - start))


def test_the_history_has_the_papers_550_steps(history: History):
    assert history.step.size == 550
    assert history.normal_force_N[299] == pytest.approx(4.0)
    assert (history.tangential_force_N[:139] == 0).all()


def test_both_reliefs_lower_the_ratio_of_the_forces_at_300(history: History):
    ratio = history.tangential_force_N / history.normal_force_N
    assert ratio[370] < 0.7 * ratio[290]
    assert ratio[480] > 0.9 * 0.8, "near the static coefficient again"


def test_slip_is_partial_before_300_and_gross_after_450(history: History):
    slips = history.status > 1
    touches = history.status != OPEN
    early = slice(200, 300)
    assert slips[early].any(axis=1).all()
    assert not (slips[early].sum(axis=1) == touches[early].sum(axis=1)).any()
    assert 450e-6 < history.truth.gross_slip_s <= 530e-6


def test_the_stress_difference_rises_until_ridge_3_slips_whole_and_then_falls(history: History):
    whole = round(history.truth.whole_slip_s[2] * 1e6)
    assert 435 <= whole <= 465
    before, after = (
        mean_rate(history, whole - 60, whole - 10),
        mean_rate(history, whole, whole + 20),
    )
    assert before > 0
    assert after < 0
    assert before - after > 0.1e-3


def test_every_force_is_passed_on_while_friction_holds(history: History):
    held = slice(220, 300)
    assert history.friction_force_N[held] == pytest.approx(1.6, rel=0.1)
    limit = 0.8 * history.normal_force_N
    assert (history.friction_force_N <= limit + 1e-9).all()


@pytest.mark.parametrize(("ratio", "gross"), [(0.6, False), (0.75, True)])
@pytest.mark.thorough
def test_nearer_to_the_static_coefficient_ridge_3_would_slip_before_the_relief(ratio, gross):
    """The paper wants F_t/F_n "close to the static friction coefficient" (0.8 here) from 200 to
    300 and ridge 3 whole at 450: this skin cannot do both (decision 0020)."""
    loads = tuple(
        p.model_copy(update={"tangential_force_N": 4.0 * ratio}) if 200 <= p.step <= 300 else p
        for p in NORMAL_RAISED
    )
    truth = run_history(HistorySettings(loads=loads)).truth
    assert truth.whole_slip_s[2] < 300e-6
    assert (truth.gross_slip_s < 300e-6) == gross


def test_waves_and_first_modes_are_those_of_the_reference_rubber():
    """Shear wave 22.8 m/s, pressure wave 116 m/s; 827, 1169, 1633 Hz."""
    settings = HistorySettings()
    lam, mu = ElasticSkin(settings.skin).lame
    density = settings.skin.density_kg_m3
    assert np.sqrt(mu * 1e6 / density) == pytest.approx(22.8, abs=0.1)
    assert np.sqrt((lam + 2 * mu) * 1e6 / density) == pytest.approx(116, abs=1)
    body = loading_history._Body(settings)
    scale = diags(1 / np.sqrt(body.mass))
    squares = eigsh(
        (scale @ body.stiffness @ scale).tocsc(), k=3, sigma=0, which="LM",
        return_eigenvectors=False,
    )  # fmt: skip
    modes = np.sort(np.sqrt(squares)) / (2 * np.pi)
    assert modes == pytest.approx([827, 1169, 1633], rel=0.01)


def test_a_step_above_the_stable_limit_is_refused_with_the_limit():
    with pytest.raises(ValueError, match=r"1 us, above the stable limit of 0\.513\d us") as caught:
        run_history(HistorySettings(substeps=1))
    assert "take at least 2 substeps" in str(caught.value)
    with pytest.raises(ValueError, match="above the stable limit"):
        run_history(HistorySettings(skin=SkinSettings(elements_per_ridge=6)))


def test_the_skin_alone_runs_away_just_above_the_limit_and_not_below():
    settings = HistorySettings(skin=SkinSettings(ridges=3, elements_per_ridge=3))
    body = loading_history._Body(settings)
    largest = {}
    for factor in (0.98, 1.03):
        dt = body.stable_step_us() * factor * 1e-6
        u = 1e-6 * np.random.default_rng(0).normal(size=body.mass.size)
        v = np.zeros_like(u)
        for _ in range(2000):
            v -= dt / body.mass * (body.stiffness @ (u + settings.damping_us * 1e-6 * v))
            u += dt * v
        largest[factor] = np.abs(u).max()
    assert largest[0.98] < 1e-4
    assert largest[1.03] > 1e3


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ({"loads": NORMAL_RAISED[::-1]}, "rising order"),
        ({"loads": NORMAL_RAISED[:-1]}, "cover steps 0 to 550"),
        ({"ridge": 12}, "ridge 12 must be at most 9"),
    ],
)
def test_a_history_that_cannot_be_is_refused(bad, words):
    with pytest.raises(ValidationError, match=words):
        HistorySettings(**bad)


@pytest.mark.thorough
def test_the_history_is_data_that_can_be_edited():
    """Without tangential force nothing slips as a whole and the skin stays symmetric."""
    only_normal = tuple(
        LoadPoint(step=p.step, normal_force_N=p.normal_force_N, tangential_force_N=0.0)
        for p in NORMAL_RAISED
    )
    history = run_history(HistorySettings(loads=only_normal, ridge=5))
    assert np.isnan(history.truth.gross_slip_s)
    assert np.abs(history.difference).max() < 1e-6 * np.abs(history.stress_MPa).max()


@pytest.mark.thorough
def test_the_map_finds_the_reference_strips_where_the_slide_does():
    """At the reference place the map is the reference slide's v_d; the outside reads most."""
    settings = MapSettings(
        skin=SkinSettings(elements_per_ridge=6),
        offsets_mm=(0.2, 0.35, 0.5), bottoms_mm=(0.0,), strip_width_mm=0.4,
    )  # fmt: skip
    found = design_map(settings)
    third = 2
    sigma_yy = 1
    assert found.hump_V[third, 0, 1, sigma_yy] == pytest.approx(3.8e-3, rel=0.1)
    assert found.peak_V[third, 0, 1, sigma_yy] == pytest.approx(16.0e-3, rel=0.05)
    assert (np.diff(found.peak_V[third, 0, :, sigma_yy]) > 0).all()
    assert (np.diff(found.hump_V[third, 0, :, sigma_yy]) > 0).all()
    with pytest.raises(ValueError, match="leaves the rubber"):
        design_map(settings.model_copy(update={"offsets_mm": (0.6,)}))
