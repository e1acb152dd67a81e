"""A rigid cylinder dragged on a half-plane: the stick zone of Cattaneo and Mindlin."""

import numpy as np
import pytest

from rig.physics.contact.settings import ContactSettings, Cylinder, FrictionSettings
from rig.physics.contact.stepper import OPEN, STICK, ContactStepper
from rig.physics.skin.condensed import condense_elements
from rig.physics.skin.elasticity import ElasticSkin
from rig.physics.skin.settings import SkinSettings, StripSettings

ELEMENT_MM = 0.05
HALF_CONTACT_MM = 0.5
BLOCK_MM = 60.0
"""Sixty contact widths long and half as deep: as good as a half-plane."""
FRICTION = 0.5


def half_plane() -> ElasticSkin:
    """Equal elements under the contact, growing away from it; only the middle can touch."""
    from skfem import MeshQuad

    middle = np.arange(0, 0.7 + 1e-9, ELEMENT_MM)
    away = [middle[-1]]
    size = ELEMENT_MM
    while away[-1] < BLOCK_MM / 2:
        size *= 1.25
        away.append(away[-1] + size)
    right = np.concatenate([middle, np.asarray(away[1:]) * 1.0])
    right[-1] = BLOCK_MM / 2 if right[-1] < BLOCK_MM / 2 * 1.1 else right[-1]
    depth = np.concatenate([[0.0], np.cumsum(ELEMENT_MM * 1.25 ** np.arange(25))])
    depth = depth[depth < BLOCK_MM / 2 * 1.1]
    settings = SkinSettings(
        ridges=1, pitch_mm=BLOCK_MM, top_mm=1.4, height_mm=float(depth[-1] / 2),
        body_mm=float(depth[-1] / 2), margin_mm=BLOCK_MM / 2, poissons_ratio=0.49,
        crown_radius_mm=1e9, finger_radius_mm=1e9,
        strips=StripSettings(offset_mm=0.3, width_mm=0.2),
    )  # fmt: skip
    x = np.concatenate([-right[:0:-1], right])
    y = settings.height_mm - depth[::-1]
    y[0] = -settings.body_mm
    return ElasticSkin(settings, MeshQuad.init_tensor(x, y))


@pytest.fixture(scope="module")
def dragged() -> list[tuple[float, float, float]]:
    """(Q/μP, a, c) along a slow drag under constant load."""
    skin = condense_elements(half_plane())
    s, radius = skin.settings, 30.0
    stiffness = s.youngs_modulus_MPa / (1 - s.poissons_ratio**2)
    load = HALF_CONTACT_MM**2 * np.pi * stiffness / (4 * radius) * s.width_mm
    contact = ContactSettings(
        friction=FrictionSettings(static_coefficient=FRICTION, kinetic_coefficient=FRICTION),
        relaxation_time_ms=0.0,
    )
    stepper = ContactStepper(
        skin, contact, Cylinder(radius_mm=radius), watched_ridge=0, keep_forces=True
    )
    stepper.advance(load * np.linspace(0.02, 1, 50), 0.0)
    block = stepper.advance(np.full(800, load), 4e-5 * np.arange(1, 801))

    def half_width(inside: np.ndarray) -> float:
        x = skin.contact_x_mm[inside]
        return float(np.ptp(x) / 2) if x.size else 0.0

    return [
        (q, half_width(status != OPEN), half_width(status == STICK))
        for q, status in zip(
            block.tangential_force_N / (FRICTION * load), block.status, strict=True
        )
    ]


@pytest.mark.parametrize(
    ("load_ratio", "stick"), [(0.1, 0.949), (0.25, 0.866), (0.5, 0.707), (0.75, 0.5), (0.9, 0.316)]
)
def test_the_stick_zone_shrinks_as_cattaneo_and_mindlin_say(dragged, load_ratio, stick):
    ratio, a, c = min(dragged, key=lambda row: abs(row[0] - load_ratio))
    assert ratio == pytest.approx(load_ratio, abs=0.01)
    assert a == pytest.approx(HALF_CONTACT_MM, abs=ELEMENT_MM)
    assert np.sqrt(1 - load_ratio) == pytest.approx(stick, abs=1e-3)
    assert c == pytest.approx(stick * HALF_CONTACT_MM, abs=ELEMENT_MM)
