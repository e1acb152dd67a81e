"""Figures of the skin model."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import pytest
from legible import faults
from matplotlib.patches import Polygon
from tiers import mostly_thorough

from rig.figures.skin import draw_deformed, draw_map
from rig.figures.style import STYLE
from rig.physics.design_map import DesignMap, MapSettings
from rig.physics.skin.elasticity import ElasticSkin, strip_areas
from rig.physics.skin.field import deformed
from rig.physics.skin.settings import SkinSettings

SETTINGS = SkinSettings(ridges=3, elements_per_ridge=4)


def test_strips_are_drawn_where_the_deformed_mesh_has_them() -> None:
    elastic = ElasticSkin(SETTINGS)
    # A shear that the mesh follows exactly: x moves by 0.1 y, y stays.
    shear = np.zeros(elastic.basis.N)
    x_dofs = elastic.basis.get_dofs(elements=True).all(["u^1"])
    shear[x_dofs] = 0.1 * elastic.locations_mm[1, x_dofs]
    skin = deformed(elastic, shear, shear)
    figure = draw_deformed([("sheared", skin)], SETTINGS, 1, "Test")
    magnified = float(figure.get_suptitle().rsplit("× ", 1)[1])
    outlines = [p for p in figure.axes[0].patches if isinstance(p, Polygon)]
    assert len(outlines) == 2 * SETTINGS.ridges
    area = strip_areas(SETTINGS, 0)[0]
    corner = outlines[0].get_xy()[0]
    expected = area.left_mm + magnified * 0.1 * area.bottom_mm, area.bottom_mm
    np.testing.assert_allclose(corner, expected, atol=1e-9)
    assert [axes for axes in figure.axes if axes.get_xlabel().startswith("$σ")], "a colour bar"
    with mpl.rc_context(STYLE):
        assert faults(figure) == []


@pytest.mark.parametrize("ridge", mostly_thorough([1, 3], default=[3]))
def test_a_map_has_a_colour_bar_for_each_quantity(ridge: int) -> None:
    settings = MapSettings(skin=SETTINGS)
    shape = (3, len(settings.bottoms_mm), len(settings.offsets_mm), 3)
    values = 1e-3 * np.random.default_rng(0).standard_normal(shape)
    figure = draw_map(DesignMap(settings, 5 * values, 20 * np.abs(values)), ridge)
    labels = [axes.get_xlabel() for axes in figure.axes]
    assert f"hump of ridge {ridge} (mV)" in labels
    assert f"HF peak of ridge {ridge} (mV)" in labels
    with mpl.rc_context(STYLE):
        assert faults(figure) == []
