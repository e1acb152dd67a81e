"""Advances a contact in time, step by step or in blocks.

``ContactStepper`` holds one plane contact (plate or cylinder) with its whole state. The same inputs
from the same state give the same bytes, whatever the block lengths. Volts, clocks and instruments
are not part of it. A step for which no consistent set of sticking, slipping and open nodes is found
raises ``ConvergenceError`` and leaves the state unchanged.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.physics.contact.settings import ContactSettings, Cylinder, Plate
from rig.physics.skin.condensed import CondensedSkin

Floats = NDArray[np.float64]
Statuses = NDArray[np.int8]

OPEN, STICK, SLIP_PLUS, SLIP_MINUS = 0, 1, 2, 3
"""Status of a node: not in contact; no relative motion; friction on the skin towards +x; towards
-x."""

_LINE = 8
"""Numbers in a cache line of the processor."""

Control = Literal["force", "position"]
"""Quantity that is commanded in a direction."""


class ConvergenceError(RuntimeError):
    """Raised when a step has no consistent active set. The message states the step and what was
    commanded."""


@dataclass(frozen=True)
class ContactBlock:
    """Result of k steps of a contact; arrays have one row per step."""

    approach_mm: Floats
    """Distance of the object below the height at which it touches the undeformed skin, (k,)."""
    normal_force_N: Floats
    """Normal force F_n, (k,)."""
    position_mm: Floats
    """Position x of the object, (k,)."""
    tangential_force_N: Floats
    """Tangential force F_t of the object on the skin, positive towards +x, (k,)."""
    dissipated_mJ: Floats
    """Work of friction in each step, (k,); never negative."""
    contact_area_mm2: Floats
    """Area of the nodes in contact, (k,)."""
    iterations: Floats
    """Active sets tried in each step, (k,)."""
    ridge_normal_N: Floats
    """Pressing force of each ridge, (k, ridges)."""
    ridge_tangential_N: Floats
    """Tangential force on each ridge, (k, ridges)."""
    status: Statuses
    """Status of each node, (k, m)."""
    stress_MPa: Floats
    """Stresses σ_xx, σ_yy, σ_xy of S1 and S2 in the watched ridge, (k, 2, 3)."""
    forces_N: Floats
    """Contact forces, pressing then tangential, (k, 2 m); (0, 2 m) unless they were asked for."""


def concatenate(blocks: list[ContactBlock]) -> ContactBlock:
    """Join consecutive blocks into one."""
    parts = {f.name: np.concatenate([getattr(b, f.name) for b in blocks]) for f in _FIELDS}
    return ContactBlock(**parts)


_FIELDS = fields(ContactBlock)


@dataclass
class ContactState:
    """Complete state of a contact between two steps.

    Displacements of open nodes may be those of an earlier step. The present ones are the compliance
    times ``filtered_N``, the force behind the rule of the time step. ``drift_mm`` is how far open
    nodes could have moved when each was last computed. ``bonded`` is the share of whole bonds ψ.
    """

    downward_mm: Floats
    sideways_mm: Floats
    bonded: Floats
    friction: Floats
    slopes: Floats
    status: Statuses
    held_status: Statuses
    force_N: Floats
    filtered_N: Floats
    drift_mm: Floats
    slots: NDArray[np.int64]
    owner: NDArray[np.int64]
    integers: NDArray[np.int64]
    scalars: Floats
    inverse: Floats

    def copy(self) -> ContactState:
        """Return an independent copy."""
        return replace(self, **{f.name: getattr(self, f.name).copy() for f in fields(self)})


class ContactStepper:
    """One plane contact between a skin and a plate or a cylinder.

    At the start the object is at `position_mm` without contact, and the skin is at rest.
    `watched_ridge` (0 is the leftmost) is the ridge whose strips are read; in the paper it is the
    third, 2.

    Raises ValueError for a ridge that the skin does not have.
    """

    def __init__(
        self,
        skin: CondensedSkin,
        settings: ContactSettings,
        body: Plate | Cylinder,
        *,
        position_mm: float = 0.0,
        watched_ridge: int = 2,
        keep_forces: bool = False,
    ):
        """Begin without contact, with the object at `position_mm`. Stresses are those of the ridge
        `watched_ridge`, counted from 0. Raises ValueError for a ridge that the skin lacks."""
        if not 0 <= watched_ridge < skin.settings.ridges:
            raise ValueError(
                f"watched_ridge {watched_ridge} must lie between 0 and {skin.settings.ridges - 1}: "
                f"the skin has {skin.settings.ridges} ridges"
            )
        self.skin = skin
        self.settings = settings
        self.body = body
        self.watched_ridge = watched_ridge
        self.keep_forces = keep_forces
        self._rows = np.ascontiguousarray(
            skin.stress_rows_MPa_N[watched_ridge].reshape(6, 2 * skin.nodes)
        )
        self._tributary = skin.tributary_mm() * skin.settings.width_mm
        self._constants = self._make_constants()
        size = 2 * skin.nodes + 2
        self._work = _aligned(16, size)
        self._listed = np.zeros(4, np.int64)
        self._nodes = np.zeros((7, size), np.int64)
        self._packed = _aligned(size, size)
        self._compact = _aligned(skin.nodes, size)
        self._answers = _aligned(skin.nodes, size)
        self._slides = _aligned(skin.nodes, skin.nodes)
        self._small = _aligned(skin.nodes, skin.nodes)
        self._state = self._initial_state(position_mm)

    @property
    def step_s(self) -> float:
        """Time step, in s."""
        return self.settings.step_us * 1e-6

    @property
    def state(self) -> ContactState:
        """Copy of the present state. Assign one to return to it."""
        return self._state.copy()

    @state.setter
    def state(self, state: ContactState) -> None:
        # Copied into the existing arrays, because those are aligned to cache lines.
        for field in fields(state):
            getattr(self._state, field.name)[...] = getattr(state, field.name)
        # The lists belonged to the previous state.
        self._listed[:] = 0

    @property
    def position_mm(self) -> float:
        """Position x of the object, in mm."""
        return float(self._state.scalars[1])

    def displacement_mm(self) -> tuple[Floats, Floats]:
        """Return downward and tangential displacement of the contact nodes, two arrays (m,)."""
        moved = self.skin.compliance_mm_N @ self._state.filtered_N
        return moved[: self.skin.nodes], moved[self.skin.nodes :]

    def advance(
        self,
        normal: ArrayLike,
        tangential: ArrayLike,
        *,
        rotation_rad: ArrayLike | None = None,
        normal_control: Control = "force",
        tangential_control: Control = "position",
    ) -> ContactBlock:
        """Advance by as many steps as `normal` and `tangential` have values, shape (k,) or ().

        `normal` is F_n in N (at least 0) or the approach in mm. `tangential` is x of the object in
        mm or F_t in N. `rotation_rad` is the rotation during each step, positive if it rolls
        towards +x (x is then that of the cylinder's axis).

        Raises ValueError for inputs out of range, and ConvergenceError if a step has no consistent
        solution; the steps before it remain done.
        """
        kernel = _kernel()
        normals, tangents = _paired(normal, tangential)
        rotations = self._rotations(rotation_rad, normals.size)
        if normal_control == "force" and normals.size and normals.min() < 0:
            raise ValueError(
                f"normal force {normals.min():g} N must be at least 0 N: the object cannot pull"
            )
        k, m = normals.size, self.skin.nodes
        summary = np.empty((k, kernel.SUMMARY))
        ridge_forces = np.empty((k, 2, self.skin.settings.ridges))
        statuses = np.empty((k, m), np.int8)
        stresses = np.empty((k, 6))
        forces = np.empty((k if self.keep_forces else 0, 2 * m))
        modes = np.array([normal_control == "force", tangential_control == "force"], np.int64)
        s = self._state
        done = kernel.advance(
            self.skin.compliance_mm_N, self.skin.contact_x_mm, self.skin.gap_mm, self._tributary,
            self.skin.ridge, self._constants, modes, normals, tangents, rotations,
            s.downward_mm, s.sideways_mm, s.bonded, s.friction, s.slopes, s.status, s.held_status,
            s.force_N, s.filtered_N, s.drift_mm, s.slots, s.owner, s.integers, s.scalars, s.inverse,
            self._work, self._listed, self._nodes, self._packed, self._compact, self._answers,
            self._slides, self._small,
            self._rows, summary, ridge_forces, statuses, stresses, forces,
        )  # fmt: skip
        if done < k:
            raise ConvergenceError(
                f"contact step {done + 1} of {k} found no consistent set of sticking, slipping and "
                f"open nodes (normal {normal_control} {normals[done]:g}, tangential "
                f"{tangential_control} {tangents[done]:g}); a smaller step_us than "
                f"{self.settings.step_us:g} may help"
            )
        return ContactBlock(
            approach_mm=summary[:, kernel.OUT_D],
            normal_force_N=summary[:, kernel.OUT_FN],
            position_mm=summary[:, kernel.OUT_X],
            tangential_force_N=summary[:, kernel.OUT_FT],
            dissipated_mJ=summary[:, kernel.OUT_DISSIPATED],
            contact_area_mm2=summary[:, kernel.OUT_AREA],
            iterations=summary[:, kernel.OUT_ITERATIONS],
            ridge_normal_N=ridge_forces[:, 0],
            ridge_tangential_N=ridge_forces[:, 1],
            status=statuses,
            stress_MPa=stresses.reshape(k, 2, 3),
            forces_N=forces,
        )

    def _rotations(self, rotation_rad: ArrayLike | None, size: int) -> Floats:
        if rotation_rad is None:
            return np.zeros(size)
        rotations = np.array(np.broadcast_to(np.asarray(rotation_rad, float), (size,)))
        if isinstance(self.body, Plate) and rotations.any():
            raise ValueError("a plate does not rotate: rotation_rad must be 0 rad for a plate")
        return rotations

    def _make_constants(self) -> Floats:
        dt, friction = self.step_s, self.settings.friction
        return np.array(
            [
                1.0 / (1.0 + self.settings.relaxation_time_ms * 1e-3 / dt),
                friction.static_coefficient,
                friction.kinetic_coefficient,
                friction.weakening_distance_um * 1e-3,
                np.exp(-dt / (friction.healing_time_ms * 1e-3)),
                friction.healing_speed_mm_s * dt,
                self.settings.object_mass_kg * 1e-3 / dt**2,
                dt,
                1.0 / self.body.radius_mm if isinstance(self.body, Cylinder) else 0.0,
            ]
        )

    def _initial_state(self, position_mm: float) -> ContactState:
        m = self.skin.nodes
        n = 2 * m + 2
        return ContactState(
            downward_mm=np.zeros(m),
            sideways_mm=np.zeros(m),
            bonded=np.ones(m),
            friction=np.full(m, self.settings.friction.static_coefficient),
            slopes=np.zeros(m),
            status=np.zeros(m, np.int8),
            held_status=np.zeros(m, np.int8),
            force_N=np.zeros(2 * m),
            filtered_N=np.zeros(2 * m),
            drift_mm=np.zeros(m),
            slots=np.full((2, m), -1, np.int64),
            owner=np.zeros((n, 2), np.int64),
            integers=np.zeros(8, np.int64),
            scalars=np.array([0.0, position_mm, 0.0, 0.0]),
            inverse=_aligned(n, n),
        )


@cache
def _kernel() -> ModuleType:
    """Return the compiled step, which takes its time to load."""
    from rig.core.cache import place_numba_cache

    place_numba_cache(Path(__file__).parent)
    from rig.physics.contact import kernel

    return kernel


def _aligned(rows: int, columns: int) -> Floats:
    """Return zeros (rows, columns) whose rows start at a cache line of the processor; it may be
    wider."""
    width = -(-columns // _LINE) * _LINE
    room = np.zeros(rows * width + _LINE)
    first = -(room.ctypes.data // room.itemsize) % _LINE
    return room[first : first + rows * width].reshape(rows, width)


def _paired(normal: ArrayLike, tangential: ArrayLike) -> tuple[Floats, Floats]:
    """Return both inputs as contiguous, finite arrays of the same length."""
    a, b = np.asarray(normal, float), np.asarray(tangential, float)
    if a.shape != b.shape or not a.ndim:
        a, b = np.broadcast_arrays(np.atleast_1d(a), np.atleast_1d(b))
    if a.ndim != 1 or not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError("normal and tangential must be finite numbers of shape (k,) or ()")
    return np.ascontiguousarray(a), np.ascontiguousarray(b)
