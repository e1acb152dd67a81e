"""Interior of the skin at one instant: displaced outline and stress, for figures.

The contact model contains the nodes of the ridge tops only. Here the whole section is solved again
for given contact forces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.physics.skin.elasticity import ElasticSkin

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class DeformedSkin:
    """Quarter elements of a skin, each with its corners and its stress."""

    corners_mm: Floats
    """Corners at rest, (q, 4, 2)."""
    displacement_mm: Floats
    """Displacement of each corner, (q, 4, 2)."""
    stress_MPa: Floats
    """Stress σ_xx, σ_yy, σ_xy in the middle of each quarter, (q, 3)."""


def relaxed_forces(forces_N: Floats, relaxation_ms: float, step_us: float) -> Floats:
    """Return contact forces (k, 2 m) delayed by the relaxation of the rubber.

    The displacement of a Kelvin-Voigt body is the elastic displacement under these forces.
    """
    alpha = 1.0 / (1.0 + relaxation_ms * 1e3 / step_us)
    felt = np.empty_like(forces_N)
    last = np.zeros(forces_N.shape[1])
    for k, force in enumerate(forces_N):
        last = alpha * force + (1 - alpha) * last
        felt[k] = last
    return felt


def deformed(elastic: ElasticSkin, displacement_mm: Floats, stressing_mm: Floats) -> DeformedSkin:
    """Return the section under a displacement (dofs,), with the stress of another displacement
    (dofs,).

    The two differ while the rubber relaxes, because the stress follows the forces at once.
    """
    places, x_dof, y_dof = _element_nodes(elastic)
    moved = np.stack([displacement_mm[x_dof], displacement_mm[y_dof]], axis=-1)
    corners, displacements = [], []
    for i, j in ((0, 0), (1, 0), (0, 1), (1, 1)):
        ring = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
        corners.append(np.stack([places[a, b] for a, b in ring], axis=1))
        displacements.append(np.stack([moved[a, b] for a, b in ring], axis=1))
    return DeformedSkin(
        corners_mm=np.concatenate(corners),
        displacement_mm=np.concatenate(displacements),
        stress_MPa=_quarter_stress(elastic, stressing_mm),
    )


def _element_nodes(elastic: ElasticSkin) -> tuple[Floats, NDArray[np.int64], NDArray[np.int64]]:
    """Return the 3 x 3 nodes of each element: places (3, 3, e, 2), x and y dofs (3, 3, e)."""
    corner = elastic.mesh.p[:, elastic.mesh.t]
    low, size = corner.min(axis=1), np.ptp(corner, axis=1)
    dofs = elastic.basis.element_dofs
    place = elastic.locations_mm[:, dofs]
    local = np.rint(2 * (place - low[:, None]) / size[:, None]).astype(int)
    vertical = np.zeros(elastic.basis.N, bool)
    vertical[elastic.basis.get_dofs(elements=True).all(["u^2"])] = True
    elements = np.arange(dofs.shape[1])
    places = np.zeros((3, 3, elements.size, 2))
    x_dof = np.zeros((3, 3, elements.size), np.int64)
    y_dof = np.zeros_like(x_dof)
    for row in range(dofs.shape[0]):
        i, j = local[0, row], local[1, row]
        up = vertical[dofs[row]]
        x_dof[i[~up], j[~up], elements[~up]] = dofs[row, ~up]
        y_dof[i[up], j[up], elements[up]] = dofs[row, up]
        places[i, j, elements] = place[:, row].T
    return places, x_dof, y_dof


def _quarter_stress(elastic: ElasticSkin, displacement_mm: Floats) -> Floats:
    lam, mu = elastic.lame
    mapping, element = elastic.mesh.mapping(), elastic.basis.elem
    quarters = []
    for x, y in ((0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75)):
        gradient = np.zeros((2, 2, elastic.mesh.t.shape[1]))
        for j in range(elastic.basis.Nbfun):
            shape = element.gbasis(mapping, np.array([[x], [y]]), j)[0].grad[..., 0]
            gradient += shape * displacement_mm[elastic.basis.element_dofs[j]]
        xx, yy = gradient[0, 0], gradient[1, 1]
        quarters.append(
            np.stack(
                [
                    (lam + 2 * mu) * xx + lam * yy,
                    lam * xx + (lam + 2 * mu) * yy,
                    mu * (gradient[0, 1] + gradient[1, 0]),
                ],
                axis=1,
            )
        )
    return np.concatenate(quarters)
