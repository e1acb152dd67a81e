"""Objects, friction and relaxation as settings. The defaults are the reference case (assumed)."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from rig.core.settings import Settings


class FrictionSettings(Settings):
    """Coulomb friction at every node, with slip weakening and healing (decision 0078).

    μ = μ_k + (μ_s - μ_k) ψ, where ψ is the share of the bonds between skin and object that are
    whole. Slip breaks them: ψ falls by a factor of exp(-D/D_c) over a distance D. While a node
    sticks or creeps, they form again: 1 - ψ falls by a factor of exp(-t/t_h) over a time t. After a
    long slide and a rest of t the static coefficient is therefore μ_s - (μ_s - μ_k) exp(-t/t_h).
    When a node lifts off and touches again, ψ is 1.
    """

    static_coefficient: float = 0.8
    """Static coefficient μ_s."""
    kinetic_coefficient: float = 0.65
    """Kinetic coefficient μ_k, at most μ_s."""
    weakening_distance_um: float = Field(5.0, gt=0)
    """Weakening distance D_c. Without it the drop of friction would depend on the mesh."""
    healing_time_ms: float = Field(20.0, gt=0)
    """Healing time t_h: time constant with which friction recovers at rest."""
    healing_speed_mm_s: float = Field(0.001, gt=0)
    """Speed of slip up to which friction heals (assumed); slower than any commanded slide."""

    @model_validator(mode="after")
    def _weakens(self) -> Self:
        for name in ("static_coefficient", "kinetic_coefficient"):
            value = getattr(self, name)
            if value < 0:
                raise ValueError(
                    f"{name} {value} (no unit) must be at least 0: "
                    "friction below zero would drive the motion"
                )
        if self.kinetic_coefficient > self.static_coefficient:
            raise ValueError(
                f"kinetic_coefficient {self.kinetic_coefficient} (no unit) must be at most "
                f"static_coefficient {self.static_coefficient}: friction weakens with slip"
            )
        return self


class ContactSettings(Settings):
    """Parameters of the motion of skin and object in time."""

    friction: FrictionSettings = FrictionSettings()
    """Friction between skin and object."""
    relaxation_time_ms: float = Field(0.5, ge=0)
    """Relaxation time τ of the Kelvin-Voigt rubber, K (u + τ du/dt) = f; 0 is purely elastic."""
    step_us: float = Field(100.0, gt=0)
    """Time step. Above 250 µs the impulse of a slip is no longer resolved."""
    object_mass_kg: float = Field(0.1, gt=0)
    """Mass of the object (assumed). It matters only if the tangential force is given."""


class Plate(Settings):
    """A rigid flat plate."""

    shape: Literal["plate"] = "plate"
    """Kind of object."""


class Cylinder(Settings):
    """A rigid cylinder (roller) with its axis along the width of the skin."""

    shape: Literal["cylinder"] = "cylinder"
    """Kind of object."""
    radius_mm: float = Field(30.0, gt=0)
    """Radius of the cylinder."""


class Sphere(Settings):
    """A rigid semi-spherical head, as plane slices across the width (decision 0020)."""

    shape: Literal["sphere"] = "sphere"
    """Kind of object."""
    radius_mm: float = Field(30.0, gt=0)
    """Radius of the sphere."""
    slices: int = Field(5, ge=1, le=50)
    """Slices over half of the contact's extent along the width; the other half mirrors them."""


Object = Annotated[Plate | Cylinder | Sphere, Field(discriminator="shape")]
"""An object that is pressed on the skin."""
