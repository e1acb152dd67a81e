"""Finite elements of the skin: stiffness, mass, factorisation and mean stress of the strips.

Quadratic (Q2) elements of scikit-fem, plane strain, linear elastic, bottom fixed. Units are N, mm
and MPa. The width out of the plane is included, so that forces are those of the whole skin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rig.physics.skin.mesh import skin_mesh
from rig.physics.skin.settings import SkinSettings

if TYPE_CHECKING:
    from skfem import MeshQuad

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_LOADS_AT_ONCE = 4

STRESSES = ("xx", "yy", "xy")
"""Order of the stress components in every array."""


@dataclass(frozen=True)
class Rectangle:
    """A rectangle in the section of the skin over which stress is averaged, in mm."""

    left_mm: float
    """Left edge, x."""
    right_mm: float
    """Right edge, x."""
    bottom_mm: float
    """Lower edge, y."""
    top_mm: float
    """Upper edge, y."""


class ElasticSkin:
    """Finite elements of one skin. Expensive results are computed on first use and stored."""

    def __init__(self, settings: SkinSettings, mesh: MeshQuad | None = None):
        """Use the skin's own mesh, or another mesh of the same outline."""
        from skfem import Basis, ElementQuad2, ElementVector

        self.settings = settings
        self.mesh = skin_mesh(settings) if mesh is None else mesh
        self.basis: Any = Basis(self.mesh, ElementVector(ElementQuad2()), intorder=4)
        self.locations_mm: Floats = self.basis.doflocs

    @cached_property
    def lame(self) -> tuple[float, float]:
        """Lamé's constants λ and μ, in MPa."""
        E, nu = self.settings.youngs_modulus_MPa, self.settings.poissons_ratio
        return E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu))

    @cached_property
    def stiffness(self) -> Any:
        """Stiffness of all degrees of freedom as a CSC matrix, in N/mm."""
        from skfem.models.elasticity import linear_elasticity

        matrix = linear_elasticity(*self.lame).assemble(self.basis)
        return (matrix * self.settings.width_mm).tocsc()

    def lumped_mass_t(self) -> Floats:
        """Return the diagonal mass of all degrees of freedom in tonnes, by Lobatto's rule on the
        elements.

        Shape (degrees of freedom,).
        """
        corners = self.mesh.p[:, self.mesh.t]
        low, size = corners.min(axis=1), np.ptp(corners, axis=1)
        dofs = self.basis.element_dofs
        local = np.rint(2 * (self.locations_mm[:, dofs] - low[:, None]) / size[:, None])
        weight = np.where(local == 1, 4 / 6, 1 / 6).prod(axis=0) * size.prod(axis=0)
        mass = np.zeros(self.basis.N)
        np.add.at(mass, dofs, weight)
        return mass * self.settings.density_kg_m3 * 1e-12 * self.settings.width_mm

    @cached_property
    def free(self) -> Ints:
        """Degrees of freedom above the fixed bottom."""
        lowest = self.locations_mm[1] < -self.settings.body_mm + 1e-9
        return np.flatnonzero(~lowest).astype(np.int64)

    @cached_property
    def contact_dofs(self) -> tuple[Ints, Ints]:
        """Degrees of freedom of the ridge tops in x and in y, each from left to right."""
        axes = np.asarray(self.settings.ridge_axes_mm())

        def on_ridge_top(p: Any) -> Any:
            off_axis = np.abs(p[0][..., None] - axes).min(axis=-1)
            inside = off_axis < self.settings.top_mm / 2 + 1e-9
            return inside & (p[1] > self.settings.height_mm - 1e-9)

        on_top = self.basis.get_dofs(on_ridge_top)
        by_component = (on_top.all(["u^1"]), on_top.all(["u^2"]))
        ordered = [d[np.argsort(self.locations_mm[0][d], kind="stable")] for d in by_component]
        return ordered[0].astype(np.int64), ordered[1].astype(np.int64)

    @cached_property
    def _factor(self) -> Any:
        from scipy.sparse.linalg import splu

        free = self.free
        return splu(
            self.stiffness[free][:, free].tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            options={"SymmetricMode": True},
            diag_pivot_thresh=0.0,
        )

    def solve(self, forces_N: Floats) -> Floats:
        """Return the displacements (dofs, loads) in mm under nodal forces of the same shape,
        bottom fixed.

        A few loads are solved at a time. With many, the inner products of the solver become large
        enough for the threads of the linear algebra library, which cost more than they gain here:
        eight at a time take more than twice as long at 8 elements per ridge.
        """
        displacement = np.zeros_like(forces_N)
        for start in range(0, forces_N.shape[1], _LOADS_AT_ONCE):
            part = slice(start, start + _LOADS_AT_ONCE)
            loads = np.asfortranarray(forces_N[self.free, part])
            displacement[self.free, part] = self._factor.solve(loads)
        return displacement

    def contact_loads(self) -> Any:
        """Return the sparse matrix that maps contact forces (pressing, tangential), (2 m,), to
        nodal forces."""
        from scipy.sparse import csc_matrix

        x_dofs, y_dofs = self.contact_dofs
        m = x_dofs.size
        sign = np.concatenate([-np.ones(m), np.ones(m)])
        rows = np.concatenate([y_dofs, x_dofs])
        return csc_matrix((sign, (rows, np.arange(2 * m))), shape=(self.basis.N, 2 * m))

    @cached_property
    def influence(self) -> Floats:
        """Displacements (dofs, 2 m) in mm/N under unit contact forces, pressing first."""
        return self.solve(self.contact_loads().toarray())

    def mean_stress_rows(self, areas: Sequence[Rectangle]) -> Any:
        """Return the sparse map (3 areas, dofs) from displacements to mean σ_xx, σ_yy, σ_xy in
        MPa."""
        from scipy.sparse import csr_matrix

        cells, local, weights, owner = self._quadrature(areas)
        lam, mu = self.lame
        element, mapping = self.basis.elem, self.mesh.mapping()
        area = np.zeros(len(areas))
        np.add.at(area, owner, weights.sum(axis=1))
        rows, columns, values = [], [], []
        for j in range(self.basis.Nbfun):
            gradient = element.gbasis(mapping, local, j, tind=cells)[0].grad
            g = np.einsum("abcq,cq->abc", gradient, weights) / area[owner]
            stress = np.stack(
                [
                    (lam + 2 * mu) * g[0, 0] + lam * g[1, 1],
                    lam * g[0, 0] + (lam + 2 * mu) * g[1, 1],
                    mu * (g[0, 1] + g[1, 0]),
                ]
            )
            for component in range(3):
                rows.append(3 * owner + component)
                columns.append(self.basis.element_dofs[j, cells])
                values.append(stress[component])
        entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
        return csr_matrix(entries, shape=(3 * len(areas), self.basis.N))

    def _quadrature(self, areas: Sequence[Rectangle]) -> tuple[Ints, Floats, Floats, Ints]:
        """Return the Gauss points of each part of a cell inside an area: cells, local points,
        weights, area.

        The mesh need not follow the edges of the areas: each cell is cut, so the mean is exact.
        """
        corners = self.mesh.p[:, self.mesh.t]
        low, high = corners.min(axis=1), corners.max(axis=1)
        point, weight = np.polynomial.legendre.leggauss(3)
        px, py = (a.ravel() for a in np.meshgrid(point, point))
        w = np.outer(weight, weight).ravel() / 4
        cells, local, weights, owner = [], [], [], []
        for number, area in enumerate(areas):
            start = np.maximum(low, [[area.left_mm], [area.bottom_mm]])
            stop = np.minimum(high, [[area.right_mm], [area.top_mm]])
            cut = np.flatnonzero(((stop - start) > 1e-12).all(axis=0))
            a, b = start[:, cut], stop[:, cut]
            points = np.stack(
                [
                    (a[0] + b[0])[:, None] / 2 + (b[0] - a[0])[:, None] / 2 * px,
                    (a[1] + b[1])[:, None] / 2 + (b[1] - a[1])[:, None] / 2 * py,
                ]
            )
            cells.append(cut)
            local.append(self.mesh.mapping().invF(points, tind=cut))
            weights.append(np.prod(b - a, axis=0)[:, None] * w)
            owner.append(np.full(cut.size, number))
        return (
            np.concatenate(cells).astype(np.int64),
            np.concatenate(local, axis=1),
            np.concatenate(weights),
            np.concatenate(owner).astype(np.int64),
        )


def strip_areas(settings: SkinSettings, ridge: int) -> tuple[Rectangle, Rectangle]:
    """Return the areas of S1 and S2 in ridge number `ridge` (0 is the leftmost)."""
    axis, strip = settings.ridge_axes_mm()[ridge], settings.strips
    half = strip.width_mm / 2

    def at(x: float) -> Rectangle:
        return Rectangle(x - half, x + half, strip.bottom_mm, strip.top_mm)

    return at(axis - strip.offset_mm), at(axis + strip.offset_mm)
