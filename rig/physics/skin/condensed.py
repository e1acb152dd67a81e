"""The skin reduced to what contact needs: compliance of the contact nodes and stress rows of the
strips.

It is computed once per settings object and stored in a cache under its hash. A cache entry that
does not contain what this module stores is computed again.
"""

from __future__ import annotations

import io
import zipfile
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rig.core.cache import Cache, NoCache
from rig.core.settings import fingerprint
from rig.physics.skin.settings import SkinSettings

if TYPE_CHECKING:
    from rig.physics.skin.elasticity import ElasticSkin

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_FORMAT = 1
_MODULUS_MPa = SkinSettings().youngs_modulus_MPa
"""Young's modulus for which a skin is condensed."""
_ARRAYS = ("contact_x_mm", "ridge", "gap_mm", "compliance_mm_N", "stress_rows_MPa_N")


@dataclass(frozen=True)
class CondensedSkin:
    """A skin reduced to its m contact nodes, from left to right.

    A vector f of contact forces (2 m,) contains the pressing forces first (positive pushes the skin
    down), then the tangential forces on the skin (positive towards +x), all in N.
    """

    settings: SkinSettings
    """Geometry and material."""
    contact_x_mm: Floats
    """Positions of the nodes in bench coordinates, (m,)."""
    ridge: Ints
    """Ridge of each node, 0 for the leftmost, (m,)."""
    gap_mm: Floats
    """Distance of each node to a flat plate that touches the highest point, (m,)."""
    compliance_mm_N: Floats
    """Symmetric matrix W of u = W f, (2 m, 2 m): downward, then tangential displacements."""
    stress_rows_MPa_N: Floats
    """Mean stress per unit of f, (ridges, 2 strips, 3 components xx yy xy, 2 m)."""

    @property
    def nodes(self) -> int:
        """Number m of contact nodes."""
        return int(self.contact_x_mm.size)

    @property
    def stiffest_N_mm(self) -> float:  # noqa: N802 - the unit keeps its capital
        """Pressing plus dragging stiffness in N/mm with every node stuck to the object.

        It is an upper limit: while fewer nodes are in contact the force rises less steeply.
        """
        stiffness = np.linalg.inv(self.compliance_mm_N)
        m = self.nodes
        pressing, dragging = stiffness[:m, :m].sum(), stiffness[m:, m:].sum()
        return float(pressing + dragging + 2 * abs(stiffness[:m, m:].sum()))

    def tributary_mm(self) -> Floats:
        """Return the length of ridge top that each node represents, (m,)."""
        length = np.zeros(self.nodes)
        for ridge in range(self.settings.ridges):
            at = np.flatnonzero(self.ridge == ridge)
            edges = np.diff(self.contact_x_mm[at])
            length[at[:-1]] += edges / 2
            length[at[1:]] += edges / 2
        return length


def build_skin(settings: SkinSettings, cache: Cache | None = None) -> CondensedSkin:
    """Return the condensed skin of `settings`, from the cache if it is there.

    Skins that differ in Young's modulus only share one entry: displacements under given forces are
    inversely proportional to it, stresses do not depend on it.
    """
    cache = NoCache() if cache is None else cache
    stored_as = settings.model_copy(update={"youngs_modulus_MPa": _MODULUS_MPa})
    key = f"skin-{_FORMAT}-{fingerprint(stored_as)}"
    stored = cache.get(key)
    skin = None if stored is None else _unpack(stored_as, stored)
    if skin is None:
        skin = condense(stored_as)
        cache.put(key, _pack(skin))
    if settings == stored_as:
        return skin
    softer = _MODULUS_MPa / settings.youngs_modulus_MPa
    return replace(skin, settings=settings, compliance_mm_N=softer * skin.compliance_mm_N)


def condense(settings: SkinSettings) -> CondensedSkin:
    """Assemble, factor and condense the skin's own mesh, without a cache."""
    from rig.physics.skin.elasticity import ElasticSkin

    return condense_elements(ElasticSkin(settings))


def condense_elements(elastic: ElasticSkin) -> CondensedSkin:
    """Condense given finite elements."""
    from rig.physics.skin.elasticity import strip_areas

    settings = elastic.settings
    x_dofs, _ = elastic.contact_dofs
    x = elastic.locations_mm[0][x_dofs]
    influence = elastic.influence
    compliance = elastic.contact_loads().T @ influence
    areas = [area for ridge in range(settings.ridges) for area in strip_areas(settings, ridge)]
    rows = elastic.mean_stress_rows(areas) @ influence
    axes = np.asarray(settings.ridge_axes_mm())
    ridge = np.abs(x[:, None] - axes[None, :]).argmin(axis=1)
    return CondensedSkin(
        settings=settings,
        contact_x_mm=x,
        ridge=ridge.astype(np.int64),
        gap_mm=settings.gap_at(x),
        compliance_mm_N=np.ascontiguousarray((compliance + compliance.T) / 2),
        stress_rows_MPa_N=np.ascontiguousarray(rows.reshape(settings.ridges, 2, 3, 2 * x.size)),
    )


def _pack(skin: CondensedSkin) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **{name: getattr(skin, name) for name in _ARRAYS})
    return buffer.getvalue()


def _unpack(settings: SkinSettings, content: bytes) -> CondensedSkin | None:
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in _ARRAYS}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    m = settings.ridges * (2 * settings.elements_per_ridge + 1)
    shapes = ((m,), (m,), (m,), (2 * m, 2 * m), (settings.ridges, 2, 3, 2 * m))
    for name, shape in zip(_ARRAYS, shapes, strict=True):
        if arrays[name].shape != shape or not np.isfinite(arrays[name]).all():
            return None
    return CondensedSkin(settings=settings, **arrays)
