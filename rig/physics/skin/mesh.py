"""Mesh of the skin: a tensor grid of rectangles with the grooves removed.

In a graded mesh the elements are concentrated at the corners of the ridges. At the foot the stress
is singular, and under shear the last nodes to stick are those at a top corner. The impulse of a
slipping ridge therefore depends on the resolution of these places (decision 0020).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rig.physics.skin.settings import SkinSettings

if TYPE_CHECKING:
    from skfem import MeshQuad

Floats = NDArray[np.float64]

TOP_POWER = 1.25
"""Exponent of the grading along the top of a ridge: 1 is uniform, 2 makes cells grow linearly from
the corner."""
FOOT_POWER = 2.0
"""Exponent of the grading along the height, in body and ridge."""
GROOVE_POWER = 3.0
"""Exponent of the grading across a groove."""
MARGIN_POWER = 2.0
"""Exponent of the grading in the margins beside the outer ridges."""


def skin_mesh(settings: SkinSettings) -> MeshQuad:
    """Return the mesh in mm, with the body below y = 0 and the ridges above it; x is in bench
    coordinates."""
    from skfem import MeshQuad

    mesh = MeshQuad.init_tensor(_along_x(settings), _along_y(settings))
    middle = mesh.p[:, mesh.t].mean(axis=1)
    axes = np.asarray(settings.ridge_axes_mm())
    off_axis = np.abs(middle[0][:, None] - axes[None, :]).min(axis=1)
    kept = (middle[1] < 0) | (off_axis < settings.top_mm / 2)
    return mesh.restrict(np.flatnonzero(kept))


def _along_x(settings: SkinSettings) -> Floats:
    n, half = settings.elements_per_ridge, settings.top_mm / 2
    graded = settings.refinement == "graded"
    size = settings.top_mm / n
    groove = settings.pitch_mm - settings.top_mm
    in_groove = n if graded else max(1, round(groove / size))
    in_margin = max(2, round(2 * n / 3)) if graded else max(1, round(settings.margin_mm / size))
    axes = settings.ridge_axes_mm()
    left, right = axes[0] - half, axes[-1] + half
    outer = MARGIN_POWER if graded else 1.0
    pieces = [_to_end(left - settings.margin_mm, left, in_margin, outer)]
    for number, axis in enumerate(axes):
        top = TOP_POWER if graded else 1.0
        pieces.append(_to_both(axis - half, axis + half, n, top)[1:])
        if number + 1 < len(axes):
            between = GROOVE_POWER if graded else 1.0
            pieces.append(_to_both(axis + half, axes[number + 1] - half, in_groove, between)[1:])
    last = _to_end(right + settings.margin_mm, right, in_margin, outer)[::-1]
    return np.concatenate([*pieces, last[1:]])


def _along_y(settings: SkinSettings) -> Floats:
    n = settings.elements_per_ridge
    if settings.refinement == "uniform":
        size = settings.top_mm / n
        body = np.linspace(-settings.body_mm, 0.0, max(2, round(settings.body_mm / size / 1.5)) + 1)
        ridge = np.linspace(0.0, settings.height_mm, max(1, round(settings.height_mm / size)) + 1)
    else:
        body = _to_end(-settings.body_mm, 0.0, 2 * n, FOOT_POWER)
        ridge = _to_both(0.0, settings.height_mm, n, FOOT_POWER)
    return np.concatenate([body, ridge[1:]])


def _to_end(start: float, end: float, cells: int, power: float) -> Floats:
    """Return a grid from `start` to `end` whose cells shrink towards `end`."""
    xi = np.linspace(0.0, 1.0, cells + 1)
    grid: Floats = start + (end - start) * (1.0 - (1.0 - xi) ** power)
    grid[-1] = end
    return grid


def _to_both(start: float, end: float, cells: int, power: float) -> Floats:
    """Return a grid from `start` to `end` whose cells shrink towards both ends,
    mirror-symmetric."""
    xi = np.linspace(-1.0, 1.0, cells + 1)
    shape = np.sign(xi) * (1.0 - (1.0 - np.abs(xi)) ** power)
    grid: Floats = (start + end) / 2 + (end - start) / 2 * shape
    grid[0], grid[-1] = start, end
    return grid
