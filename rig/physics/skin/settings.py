"""Geometry and material of the skin as one settings object. The defaults are the reference case.

The paper (2.2, 4.1) gives nine ridges, 20 mm of width, silicone rubber and a pair of strips in the
third ridge, but no dimensions. Every value marked "assumed" is a choice that a laboratory replaces
by its own measurement.
"""

from __future__ import annotations

from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from rig.core.settings import Settings


class StripSettings(Settings):
    """Position of the two film strips S1 and S2 in a ridge (assumed; paper Figure 11)."""

    offset_mm: float = Field(0.35, gt=0)
    """Distance of the middle of a strip from the axis of its ridge; S1 at -offset, S2 at
    +offset."""
    width_mm: float = Field(0.4, gt=0)
    """Extent of a strip along x."""
    bottom_mm: float = 0.0
    """Lower edge above the foot of the ridge; a negative value is inside the body."""
    top_mm: float = 0.35
    """Upper edge above the foot of the ridge."""

    @model_validator(mode="after")
    def _has_height(self) -> Self:
        if self.top_mm <= self.bottom_mm:
            raise ValueError(
                f"strip top {self.top_mm} mm must lie above its bottom {self.bottom_mm} mm: "
                "a strip without height has no mean stress"
            )
        return self


class SkinSettings(Settings):
    """A ridged skin under plane strain, bottom fixed, ridges upwards; x = 0 is its middle.

    ``gap_mm`` of the condensed skin is the distance to a flat plate that just touches. It is
    composed of a finger radius over the whole skin and a crown radius on each ridge. The curvatures
    affect the gap only; the mesh is flat (they are below 2 % of the width of a ridge).
    """

    ridges: int = Field(9, ge=1, le=99)
    """Number of ridges (paper 2.2: nine)."""
    pitch_mm: float = Field(2.0, gt=0)
    """Distance between the axes of neighbouring ridges (assumed)."""
    top_mm: float = Field(1.4, gt=0)
    """Width of a ridge; its sides are vertical (assumed)."""
    height_mm: float = Field(1.0, gt=0)
    """Height of a ridge above the body (assumed)."""
    body_mm: float = Field(6.0, gt=0)
    """Thickness of the body below the ridges (assumed)."""
    margin_mm: float = Field(3.0, gt=0)
    """Length of the body beyond the outer ridges' sides (assumed)."""
    width_mm: float = Field(20.0, gt=0)
    """Width out of the plane (paper 4.1)."""
    crown_radius_mm: float = Field(12.0, gt=0)
    """Radius of each ridge's top (assumed)."""
    finger_radius_mm: float = Field(750.0, gt=0)
    """Radius of the whole skin (assumed; set so that nine ridges touch at 4 N)."""
    axis_x_mm: float = 0.0
    """Position of the middle of the skin on the x axis of the bench."""
    youngs_modulus_MPa: float = Field(1.7, gt=0)
    """Young's modulus of the silicone rubber (assumed)."""
    poissons_ratio: float = 0.48
    """Poisson's ratio (assumed); 0.5 would lock displacement elements."""
    density_kg_m3: float = Field(1100.0, gt=0)
    """Density (assumed), used only by the loading history with inertia."""
    strips: StripSettings = StripSettings()
    """The two strips, at the same place in every ridge."""
    elements_per_ridge: int = Field(8, ge=2, le=40)
    """Quadratic elements along the top of a ridge; use at least 6."""
    refinement: Literal["graded", "uniform"] = "graded"
    """``graded`` concentrates elements at the corners, where stress is singular; ``uniform`` makes
    them alike, which explicit dynamics needs."""

    @model_validator(mode="after")
    def _is_possible(self) -> Self:
        if not 0 <= self.poissons_ratio < 0.5:
            raise ValueError(
                f"poissons_ratio {self.poissons_ratio} (no unit) must be at least 0 and below 0.5: "
                "at 0.5 the material is incompressible and displacement elements lock"
            )
        if self.top_mm >= self.pitch_mm:
            raise ValueError(
                f"top_mm {self.top_mm} mm must be below the pitch of {self.pitch_mm} mm: "
                "neighbouring ridges would overlap"
            )
        inside = self.strips.offset_mm - self.strips.width_mm / 2
        outside = self.strips.offset_mm + self.strips.width_mm / 2
        if inside < 0 or outside > self.top_mm / 2:
            raise ValueError(
                f"strips from {inside:g} to {outside:g} mm of the ridge's axis must lie between 0 "
                f"and {self.top_mm / 2:g} mm (half of top_mm): they would overlap or leave it"
            )
        if self.strips.top_mm > self.height_mm or self.strips.bottom_mm < -self.body_mm:
            raise ValueError(
                f"strips from {self.strips.bottom_mm:g} to {self.strips.top_mm:g} mm must lie "
                f"between {-self.body_mm:g} and {self.height_mm:g} mm: they would leave the rubber"
            )
        return self

    def ridge_axes_mm(self) -> tuple[float, ...]:
        """Return the x of the axis of each ridge, from left to right, in bench coordinates."""
        middle = (self.ridges - 1) / 2
        return tuple(self.axis_x_mm + (i - middle) * self.pitch_mm for i in range(self.ridges))

    def gap_at(self, x_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distance in mm, (n,), of the points `x_mm` (n,) on the ridge tops to a flat
        plate that touches the highest of them."""
        axes = np.asarray(self.ridge_axes_mm())
        to_axis = np.abs(x_mm[:, None] - axes[None, :]).min(axis=1)
        over_all = (x_mm - self.axis_x_mm) ** 2 / (2 * self.finger_radius_mm)
        together = over_all + to_axis**2 / (2 * self.crown_radius_mm)
        gap: NDArray[np.float64] = together - together.min()
        return gap
