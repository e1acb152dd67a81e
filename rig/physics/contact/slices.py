"""The semi-spherical head as plane slices across the width, and the choice of a stepper.

A sphere pressed on the skin touches only part of the width (6.9 of 20 mm for R = 30 mm at 4 N).
Each slice is a plane contact of a cylinder with the radius of the sphere and carries its share of
the load, q(y) proportional to 1 - (y/a)² as in Hertz's solution, with the Hertz radius a at that
load. The slices do not influence each other. The strips run along the width and read the mean over
it, which is zero beside the contact.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.physics.contact.settings import ContactSettings, Cylinder, Plate, Sphere
from rig.physics.contact.stepper import (
    ContactBlock,
    ContactState,
    ContactStepper,
    Control,
    ConvergenceError,
)
from rig.physics.skin.condensed import CondensedSkin
from rig.physics.skin.settings import SkinSettings

Floats = NDArray[np.float64]

LARGEST_FORCE_N = 8.0
"""Force whose Hertz contact the slices of a sphere cover, unless a trial presses harder."""


def hertz_radius(skin: SkinSettings, radius_mm: float, force_N: ArrayLike) -> Floats:
    """Return the contact radius in mm of a rigid sphere on a half-space of the skin's rubber.

    It has the shape of `force_N`.
    """
    stiffness = skin.youngs_modulus_MPa / (1 - skin.poissons_ratio**2)
    force = np.asarray(force_N, float)
    radius: Floats = np.cbrt(3 * force * radius_mm / (4 * stiffness))
    return radius


def hertz_force(skin: SkinSettings, radius_mm: float, approach_mm: ArrayLike) -> Floats:
    """Return the force in N of a rigid sphere at an approach on the same half-space.

    It has the shape of `approach_mm`.
    """
    stiffness = skin.youngs_modulus_MPa / (1 - skin.poissons_ratio**2)
    depth = np.clip(np.asarray(approach_mm, float), 0.0, None)
    force: Floats = 4 / 3 * stiffness * np.sqrt(radius_mm) * depth**1.5
    return force


class SlicedStepper:
    """A sphere on the skin: the interface of ``ContactStepper`` over several plane slices.

    `largest_force_N` determines the slices: they cover the Hertz contact at that force. The
    position of the object is commanded. A tangential force would have to be shared among slices
    that do not influence each other, so it is refused. A larger normal force is refused too, or,
    with `beyond`, carried by the existing slices: with the right size, but not in the right place.

    Raises ValueError if the contact at `largest_force_N` would be wider than the skin.
    """

    def __init__(
        self,
        skin: CondensedSkin,
        settings: ContactSettings,
        body: Sphere,
        *,
        position_mm: float = 0.0,
        watched_ridge: int = 2,
        keep_forces: bool = False,
        largest_force_N: float = LARGEST_FORCE_N,
        beyond: bool = False,
    ):
        """Begin without contact, with the object at `position_mm`. The slices cover the contact of
        `largest_force_N`; a larger force is refused unless `beyond` allows it. Raises ValueError
        where that contact would be wider than the skin."""
        self.skin = skin
        self.settings = settings
        self.body = body
        extent = float(hertz_radius(skin.settings, body.radius_mm, largest_force_N))
        if 2 * extent > skin.settings.width_mm:
            raise ValueError(
                f"sphere radius_mm {body.radius_mm} mm would touch {2 * extent:.1f} mm at "
                f"{largest_force_N:g} N, above the skin's width of {skin.settings.width_mm} mm: "
                "use a cylinder"
            )
        self.slice_mm = extent / body.slices
        self._largest_N = math.inf if beyond else largest_force_N
        roller = Cylinder(radius_mm=body.radius_mm)
        self._slices = [
            ContactStepper(
                skin,
                settings,
                roller,
                position_mm=position_mm,
                watched_ridge=watched_ridge,
                keep_forces=keep_forces,
            )
            for _ in range(body.slices)
        ]

    @property
    def step_s(self) -> float:
        """Time step, in s."""
        return self._slices[0].step_s

    @property
    def position_mm(self) -> float:
        """Position x of the object, in mm."""
        return self._slices[0].position_mm

    @property
    def state(self) -> list[ContactState]:
        """Copy of the state of every slice, from the middle outwards."""
        return [s.state for s in self._slices]

    @state.setter
    def state(self, states: list[ContactState]) -> None:
        for stepper, state in zip(self._slices, states, strict=True):
            stepper.state = state

    def displacement_mm(self) -> tuple[Floats, Floats]:
        """Return downward and tangential displacements in mm, each (slices x nodes,)."""
        downward, sideways = zip(*(s.displacement_mm() for s in self._slices), strict=True)
        return np.concatenate(downward), np.concatenate(sideways)

    def shares(self, force_N: ArrayLike) -> Floats:
        """Return the share of the load of each slice, (k, slices). Each column stands for two
        mirrored slices; a row sums to 1/2."""
        force = np.atleast_1d(np.asarray(force_N, float))
        radius = hertz_radius(self.skin.settings, self.body.radius_mm, force)[:, None]
        edges = np.arange(self.body.slices + 1) * self.slice_mm
        inside = np.clip(edges[None, :] / np.where(radius > 0, radius, np.inf), 0.0, 1.0)
        carried = 0.75 * (inside - inside**3 / 3)
        parts = np.diff(carried, axis=1)
        held = parts.sum(axis=1, keepdims=True)
        shares: Floats = np.divide(0.5 * parts, held, out=np.zeros_like(parts), where=held > 0)
        return shares

    def advance(
        self,
        normal: ArrayLike,
        tangential: ArrayLike,
        *,
        rotation_rad: ArrayLike | None = None,
        normal_control: Control = "force",
        tangential_control: Control = "position",
    ) -> ContactBlock:
        """Advance like ``ContactStepper.advance``. An approach is converted to F_n by Hertz's law.
        Raises ValueError for a tangential force in place of a position, and for a normal force
        above the largest one.

        The statuses of the result are those of the middle slice; forces and dissipation are sums,
        stresses means over the width. If one slice finds no solution, all remain as they were
        before the call.
        """
        if tangential_control == "force":
            raise ValueError(
                "body sphere takes a commanded position only, not a tangential force: "
                "use a plate or a cylinder"
            )
        skin, radius = self.skin.settings, self.body.radius_mm
        values = np.atleast_1d(np.asarray(normal, float))
        by_force = normal_control == "force"
        force = values if by_force else hertz_force(skin, radius, values)
        if force.size and force.max() > self._largest_N * (1 + 1e-9):
            raise ValueError(
                f"normal force {force.max():g} N must be at most {self._largest_N:g} N: "
                "the slices cover the contact of that force; give a larger largest_force_N"
            )
        per_slice = self.shares(force) * force[:, None] * skin.width_mm / self.slice_mm
        before = self.state
        try:
            blocks = [
                stepper.advance(per_slice[:, k], tangential, rotation_rad=rotation_rad)
                for k, stepper in enumerate(self._slices)
            ]
        except (ConvergenceError, ValueError):
            self.state = before
            raise
        return self._joined(blocks, force)

    def _joined(self, blocks: list[ContactBlock], force: Floats) -> ContactBlock:
        weight = 2 * self.slice_mm / self.skin.settings.width_mm

        def total(name: str) -> Floats:
            joined: Floats = weight * np.sum([getattr(b, name) for b in blocks], axis=0)
            return joined

        skin, radius = self.skin.settings, self.body.radius_mm
        return ContactBlock(
            approach_mm=hertz_radius(skin, radius, force) ** 2 / radius,
            normal_force_N=total("normal_force_N"),
            position_mm=blocks[0].position_mm,
            tangential_force_N=total("tangential_force_N"),
            dissipated_mJ=total("dissipated_mJ"),
            contact_area_mm2=total("contact_area_mm2"),
            iterations=np.max([b.iterations for b in blocks], axis=0),
            ridge_normal_N=total("ridge_normal_N"),
            ridge_tangential_N=total("ridge_tangential_N"),
            status=blocks[0].status,
            stress_MPa=total("stress_MPa"),
            forces_N=total("forces_N"),
        )


def make_stepper(
    skin: CondensedSkin,
    settings: ContactSettings,
    body: Plate | Cylinder | Sphere,
    *,
    position_mm: float = 0.0,
    watched_ridge: int = 2,
    keep_forces: bool = False,
    largest_force_N: float = LARGEST_FORCE_N,
) -> ContactStepper | SlicedStepper:
    """Return the stepper for an object. `largest_force_N` matters only for a sphere."""
    if isinstance(body, Sphere):
        return SlicedStepper(
            skin,
            settings,
            body,
            position_mm=position_mm,
            watched_ridge=watched_ridge,
            keep_forces=keep_forces,
            largest_force_N=largest_force_N,
        )
    return ContactStepper(
        skin,
        settings,
        body,
        position_mm=position_mm,
        watched_ridge=watched_ridge,
        keep_forces=keep_forces,
    )
