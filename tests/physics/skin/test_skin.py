"""The skin: refused settings, equilibrium, symmetry, and a cache that is never trusted blindly."""

from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from rig.core.cache import DiskCache
from rig.physics.contact.settings import FrictionSettings
from rig.physics.skin import condensed
from rig.physics.skin.condensed import CondensedSkin, build_skin
from rig.physics.skin.elasticity import ElasticSkin, Rectangle
from rig.physics.skin.settings import SkinSettings, StripSettings

SMALL = SkinSettings(ridges=3, elements_per_ridge=3)


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ({"poissons_ratio": 0.5}, ("0.5", "below 0.5", "lock")),
        ({"poissons_ratio": -0.1}, ("-0.1", "at least 0")),
        ({"top_mm": 2.0}, ("2.0 mm", "pitch of 2.0 mm", "overlap")),
        ({"strips": {"offset_mm": 0.6}}, ("0.8", "0.7 mm", "leave")),
        ({"strips": {"offset_mm": 0.1}}, ("-0.1", "overlap")),
        ({"strips": {"top_mm": 1.2}}, ("1.2", "1 mm", "leave the rubber")),
        ({"strips": {"top_mm": 0.0}}, ("0.0 mm", "height")),
        ({"youngs_modulus_MPa": 0.0}, ("greater than 0",)),
        ({"no_such_key": 1}, ("Extra inputs",)),
    ],
)
def test_a_skin_that_cannot_be_is_refused_with_value_limit_and_reason(bad, words):
    with pytest.raises(ValidationError) as caught:
        SkinSettings(**bad)
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ({"static_coefficient": -0.1, "kinetic_coefficient": -0.2}, ("-0.1", "at least 0")),
        ({"kinetic_coefficient": 0.9}, ("0.9", "at most", "0.8", "weakens")),
        ({"weakening_distance_um": 0.0}, ("greater than 0",)),
    ],
)
def test_friction_that_cannot_be_is_refused_with_value_limit_and_reason(bad, words):
    with pytest.raises(ValidationError) as caught:
        FrictionSettings(**bad)
    for word in words:
        assert word in str(caught.value)


def test_compliance_is_symmetric_and_stores_energy(skin6: CondensedSkin):
    W = skin6.compliance_mm_N
    assert np.array_equal(W, W.T)
    assert np.linalg.eigvalsh(W).min() > 0


def test_the_skin_is_its_own_mirror_image(skin6: CondensedSkin):
    m = skin6.nodes
    flip = np.concatenate([np.arange(m)[::-1], m + np.arange(m)[::-1]])
    sign = np.concatenate([np.ones(m), -np.ones(m)])
    W = skin6.compliance_mm_N
    mirrored = sign[:, None] * W[np.ix_(flip, flip)] * sign[None, :]
    assert np.abs(mirrored - W).max() < 1e-9 * np.abs(W).max()
    rows = skin6.stress_rows_MPa_N
    component_sign = np.array([1.0, 1.0, -1.0])[None, None, :, None]
    seen = component_sign * rows[::-1, ::-1][..., flip] * sign
    assert np.abs(seen - rows).max() < 1e-8 * np.abs(rows).max()


@pytest.mark.parametrize("refinement", ["graded", "uniform"])
def test_a_ridge_carries_what_presses_and_drags_it(refinement: str):
    """Virtual work: stress averaged over the whole ridge balances the load exactly.

    The ridge is averaged in two parts whose border cuts through elements.
    """
    settings = SMALL.model_copy(update={"refinement": refinement})
    elastic = ElasticSkin(settings)
    m = elastic.contact_dofs[0].size
    force = np.zeros(2 * m)
    middle = np.arange(m // 3, 2 * m // 3)
    force[middle] = 0.03
    force[m + middle] = 0.01
    axis, half = settings.ridge_axes_mm()[1], settings.top_mm / 2
    parts = [
        Rectangle(axis - half, axis + half, 0.0, 0.37),
        Rectangle(axis - half, axis + half, 0.37, settings.height_mm),
    ]
    lower, upper = (elastic.mean_stress_rows(parts) @ (elastic.influence @ force)).reshape(2, 3)
    mean = 0.37 * lower + 0.63 * upper
    area = settings.top_mm * settings.width_mm
    assert mean[1] * area == pytest.approx(-force[:m].sum(), rel=1e-9)
    assert mean[2] * area == pytest.approx(force[m:].sum(), rel=1e-9)


def test_a_confined_block_has_the_textbook_modulus():
    """Pressed all over its top and much wider than high, a block is in uniaxial strain."""
    settings = SkinSettings(
        ridges=1, pitch_mm=61, top_mm=60, height_mm=1, body_mm=1, margin_mm=0.1,
        elements_per_ridge=40, refinement="uniform", poissons_ratio=0.3,
        strips=StripSettings(offset_mm=5, width_mm=4, bottom_mm=0, top_mm=0.5),
    )  # fmt: skip
    skin = condensed.condense(settings)
    weights = np.ones(skin.nodes)
    weights[1::2], weights[2:-1:2] = 4, 2
    pressure = 0.01
    load = np.zeros(2 * skin.nodes)
    load[: skin.nodes] = weights / weights.sum() * pressure * 60 * settings.width_mm
    down = (skin.compliance_mm_N @ load)[skin.nodes // 2]
    modulus = 1.7 * 0.7 / (1.3 * 0.4)
    assert down == pytest.approx(2 * pressure / modulus, rel=1e-3)
    stress = skin.stress_rows_MPa_N[0, 0] @ load
    assert stress[1] == pytest.approx(-pressure, rel=1e-3)
    assert stress[0] == pytest.approx(-pressure * 0.3 / 0.7, rel=1e-2)


def test_a_skin_moved_in_x_is_the_same_skin():
    moved = condensed.condense(SMALL.model_copy(update={"axis_x_mm": 7.3}))
    here = condensed.condense(SMALL)
    assert moved.contact_x_mm - here.contact_x_mm == pytest.approx(7.3)
    assert moved.gap_mm == pytest.approx(here.gap_mm, abs=1e-12)
    scale = np.abs(here.compliance_mm_N).max()
    assert np.abs(moved.compliance_mm_N - here.compliance_mm_N).max() < 1e-10 * scale


def _count_builds(monkeypatch: pytest.MonkeyPatch) -> list[SkinSettings]:
    built: list[SkinSettings] = []
    really = condensed.condense

    def counting(settings: SkinSettings) -> CondensedSkin:
        built.append(settings)
        return really(settings)

    monkeypatch.setattr(condensed, "condense", counting)
    return built


def test_the_cache_saves_the_second_build_and_changes_nothing(tmp_path: Path, monkeypatch):
    built = _count_builds(monkeypatch)
    cache = DiskCache(tmp_path)
    first, second = build_skin(SMALL, cache), build_skin(SMALL, cache)
    assert len(built) == 1
    assert np.array_equal(first.compliance_mm_N, second.compliance_mm_N)
    assert np.array_equal(first.stress_rows_MPa_N, second.stress_rows_MPa_N)
    build_skin(SMALL.model_copy(update={"poissons_ratio": 0.47}), cache)
    assert len(built) == 2


@pytest.mark.parametrize("damage", ["flip", "cut", "empty", "foreign"])
def test_a_damaged_cache_is_rebuilt_not_trusted(tmp_path: Path, monkeypatch, damage: str):
    built = _count_builds(monkeypatch)
    cache = DiskCache(tmp_path)
    first = build_skin(SMALL, cache)
    (entry,) = tmp_path.iterdir()
    raw = bytearray(entry.read_bytes())
    if damage == "flip":
        raw[len(raw) // 2] ^= 1
    entry.write_bytes({"flip": raw, "cut": raw[:-7], "empty": b"", "foreign": b"x" * 900}[damage])
    again = build_skin(SMALL, cache)
    assert len(built) == 2
    assert np.array_equal(first.compliance_mm_N, again.compliance_mm_N)
    build_skin(SMALL, cache)
    assert len(built) == 2


def test_a_sound_entry_with_the_wrong_content_is_rebuilt(monkeypatch):
    built = _count_builds(monkeypatch)

    class Foreign:
        def get(self, key: str) -> bytes | None:
            return b"PK\x03\x04 not what was stored"

        def put(self, key: str, content: bytes) -> None:
            pass

    build_skin(SMALL, Foreign())
    assert len(built) == 1


def test_skins_of_another_stiffness_share_the_cached_one_and_are_right(tmp_path: Path, monkeypatch):
    cache = DiskCache(tmp_path)
    build_skin(SMALL, cache)
    softer = SMALL.model_copy(update={"youngs_modulus_MPa": 0.6})
    by_hand = condensed.condense(softer)
    monkeypatch.setattr(condensed, "condense", lambda _: pytest.fail("condensed anew"))
    found = build_skin(softer, cache)
    assert found.settings == softer
    assert found.compliance_mm_N == pytest.approx(by_hand.compliance_mm_N, rel=1e-9, abs=1e-12)
    assert found.stress_rows_MPa_N == pytest.approx(by_hand.stress_rows_MPa_N, rel=1e-6, abs=1e-9)
