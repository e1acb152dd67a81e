"""The paper's simulation 4.2: 550 steps of 1e-6 s of a skin with inertia under given forces.

A rigid plate transmits F_n and F_t (Figure 12, as editable data) to the skin. The results are the
stress difference between the strips of a ridge and its rate (Figure 13). The method is explicit
central differences on the skin's own quadratic elements with a lumped mass. Contact is unilateral
at every node, with Coulomb friction and slip weakening. A step above the stable limit is refused.

Within 0.55 ms a wave crosses the skin a few times, and the slowest surface mode (0.8 kHz) makes
half a cycle: the response is inertial, not a slide in slow motion. The rubber's relaxation of 0.5
ms cannot be integrated explicitly; a short material damping suppresses vibrations of the grid
instead.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from rig.core.settings import Settings
from rig.physics.contact.settings import FrictionSettings
from rig.physics.contact.stepper import OPEN, SLIP_MINUS, SLIP_PLUS, STICK, Statuses
from rig.physics.contact.truth import SlipTruth, SlipWatch
from rig.physics.skin.elasticity import ElasticSkin, strip_areas
from rig.physics.skin.settings import SkinSettings

Floats = NDArray[np.float64]


class LoadPoint(Settings):
    """A corner of the loading history. Forces are linear between corners."""

    step: int = Field(ge=0)
    """Step at which the forces are reached."""
    normal_force_N: float = Field(ge=0)
    """Normal force F_n."""
    tangential_force_N: float
    """Tangential force F_t."""


_UNTIL_RELIEF = (
    LoadPoint(step=0, normal_force_N=0.0, tangential_force_N=0.0),
    LoadPoint(step=140, normal_force_N=4.0, tangential_force_N=0.0),
    LoadPoint(step=200, normal_force_N=4.0, tangential_force_N=1.6),
    LoadPoint(step=300, normal_force_N=4.0, tangential_force_N=1.6),
)
"""F_n alone, then F_t at 0.4 F_n: half of μ_s. With F_t nearer to μ_s the skin would not wait for
step 450: at 0.6 F_n all of ridge 3 slips before step 300, at 0.75 F_n everything slides (decision
0020)."""

NORMAL_RAISED = (
    *_UNTIL_RELIEF,
    LoadPoint(step=340, normal_force_N=6.0, tangential_force_N=1.6),
    LoadPoint(step=380, normal_force_N=6.0, tangential_force_N=1.6),
    LoadPoint(step=460, normal_force_N=6.0, tangential_force_N=4.6),
    LoadPoint(step=550, normal_force_N=6.0, tangential_force_N=4.9),
)
"""Relief at step 300 by a raised normal force (levels assumed: the paper gives the ratio only)."""

TANGENTIAL_LOWERED = (
    *_UNTIL_RELIEF,
    LoadPoint(step=340, normal_force_N=4.0, tangential_force_N=0.8),
    LoadPoint(step=380, normal_force_N=4.0, tangential_force_N=0.8),
    LoadPoint(step=480, normal_force_N=4.0, tangential_force_N=3.0),
    LoadPoint(step=550, normal_force_N=4.0, tangential_force_N=3.3),
)
"""Relief at step 300 by a lowered tangential force (levels assumed)."""

RELIEFS: dict[str, tuple[LoadPoint, ...]] = {
    "normal_raised": NORMAL_RAISED,
    "tangential_lowered": TANGENTIAL_LOWERED,
}
"""The two loading histories, by name."""


class HistorySettings(Settings):
    """Parameters of the simulation of the paper's 4.2."""

    skin: SkinSettings = SkinSettings(elements_per_ridge=6, refinement="uniform")
    """The skin, with uniform elements: the smallest one determines the stable step."""
    friction: FrictionSettings = FrictionSettings()
    """Friction between plate and skin."""
    loads: tuple[LoadPoint, ...] = NORMAL_RAISED
    """Loading history (Figure 12)."""
    steps: int = Field(550, ge=1)
    """Number of steps (paper 4.2)."""
    step_us: float = Field(1.0, gt=0)
    """Time step (paper 4.2: 1e-6 s)."""
    substeps: int = Field(2, ge=1)
    """Explicit steps per step: quadratic elements require shorter ones."""
    damping_us: float = Field(0.2, ge=0)
    """Time constant of the stiffness-proportional damping (assumed)."""
    object_mass_g: float = Field(0.02, gt=0)
    """Mass of the plate along x (assumed small: a heavy plate would absorb F_t)."""
    ridge: int = Field(3, ge=1)
    """Ridge whose stress is recorded; 1 is the leftmost."""
    component: Literal["xx", "yy", "xy"] = "yy"
    """Stress component that is subtracted (paper Figure 11)."""

    @model_validator(mode="after")
    def _is_in_order(self) -> Self:
        steps = [point.step for point in self.loads]
        if len(steps) < 2 or any(b <= a for a, b in pairwise(steps)):
            raise ValueError(f"loads at steps {steps} must be at least two, in rising order")
        if steps[0] != 0 or steps[-1] < self.steps:
            raise ValueError(
                f"loads must cover steps 0 to {self.steps}, they cover {steps[0]} to {steps[-1]}"
            )
        if self.ridge > self.skin.ridges:
            raise ValueError(
                f"ridge {self.ridge} must be at most {self.skin.ridges}, the number of ridges"
            )
        return self

    def forces(self) -> tuple[Floats, Floats]:
        """Return F_n and F_t in N at the end of every substep, two arrays (steps * substeps,)."""
        at = np.arange(1, self.steps * self.substeps + 1) / self.substeps
        corners = [p.step for p in self.loads]
        normal = np.interp(at, corners, [p.normal_force_N for p in self.loads])
        tangential = np.interp(at, corners, [p.tangential_force_N for p in self.loads])
        return normal, tangential


@dataclass(frozen=True)
class History:
    """Response of the skin, one row per step."""

    step: NDArray[np.int64]
    """Step number, 1 to n, (n,)."""
    normal_force_N: Floats
    """Given normal force, (n,)."""
    tangential_force_N: Floats
    """Given tangential force, (n,)."""
    friction_force_N: Floats
    """Part of F_t that friction transmits to the skin, (n,)."""
    stress_MPa: Floats
    """Mean stress of S1 and S2, (n, 2)."""
    status: Statuses
    """Status of every contact node, (n, m)."""
    ridge_of_node: NDArray[np.int64]
    """Ridge of every contact node, 0 for the leftmost, (m,)."""
    truth: SlipTruth
    """Times of slip in s; one step is `step_us`."""
    stable_step_us: float
    """Largest explicit step that is stable on this mesh."""
    shots: dict[int, Floats]
    """Displacements (dofs,) of the whole section in mm, by the steps that were asked for."""

    @property
    def difference(self) -> Floats:
        """Stress of S1 minus that of S2, in MPa, (n,)."""
        difference: Floats = self.stress_MPa[:, 0] - self.stress_MPa[:, 1]
        return difference


def run_history(settings: HistorySettings, shots: tuple[int, ...] = ()) -> History:
    """Simulate the history and record the whole section at the steps `shots`.

    Raises ValueError, which names the limit, if the step is unstable.
    """
    body = _Body(settings)
    stable_us = body.stable_step_us()
    substep_us = settings.step_us / settings.substeps
    if substep_us > stable_us:
        raise ValueError(
            f"step of {settings.step_us:g} us in {settings.substeps} substeps is "
            f"{substep_us:g} us, above the stable limit of {stable_us:.4g} us for this mesh and "
            f"damping: take at least {math.ceil(settings.step_us / stable_us)} substeps or larger "
            "elements"
        )
    return _march(settings, body, stable_us, shots)


class _Body:
    """Matrices of the skin, reduced to its free degrees of freedom, in N, mm, s and tonnes."""

    def __init__(self, settings: HistorySettings):
        self.settings = settings
        skin = ElasticSkin(settings.skin)
        free = self._free = skin.free
        self._dofs = skin.basis.N
        place = np.full(skin.basis.N, -1)
        place[free] = np.arange(free.size)
        self.stiffness = skin.stiffness.tocsr()[free][:, free].tocsr()
        self.mass = skin.lumped_mass_t()[free]
        x_dofs, y_dofs = skin.contact_dofs
        self.tangential, self.vertical = place[x_dofs], place[y_dofs]
        rows = skin.mean_stress_rows(strip_areas(settings.skin, settings.ridge - 1))
        which = {"xx": 0, "yy": 1, "xy": 2}[settings.component]
        self.stress_rows: Any = rows[[which, 3 + which]][:, free].tocsr()
        x = skin.locations_mm[0][x_dofs]
        axes = np.asarray(settings.skin.ridge_axes_mm())
        self.ridge = np.abs(x[:, None] - axes[None, :]).argmin(axis=1).astype(np.int64)
        self.gap = settings.skin.gap_at(x)

    def whole(self, u: Floats) -> Floats:
        """Return the displacements of all degrees of freedom, including the fixed ones."""
        displacement = np.zeros(self._dofs)
        displacement[self._free] = u
        return displacement

    def stable_step_us(self) -> float:
        """Return the limit of central differences with lagged damping, from the largest
        eigenfrequency."""
        from scipy.sparse import diags
        from scipy.sparse.linalg import eigsh

        scale = diags(1.0 / np.sqrt(self.mass))
        start = np.ones(self.mass.size)
        largest = eigsh(
            scale @ self.stiffness @ scale,
            k=1, which="LA", tol=1e-3, v0=start, return_eigenvectors=False,
        )[0]  # fmt: skip
        omega = math.sqrt(float(largest))
        half = omega * self.settings.damping_us * 1e-6 / 2
        return 2 / omega * (math.sqrt(1 + half**2) - half) * 1e6


def _march(
    settings: HistorySettings, body: _Body, stable_us: float, shots: tuple[int, ...] = ()
) -> History:
    dt = settings.step_us * 1e-6 / settings.substeps
    normal, tangential = settings.forces()
    u = np.zeros(body.mass.size)
    v = np.zeros_like(u)
    plate = _Plate(settings, body, dt)
    stress = np.empty((settings.steps, 2))
    status = np.empty((settings.steps, body.ridge.size), np.int8)
    passed = np.empty(settings.steps)
    kept: dict[int, Floats] = {}
    for k in range(normal.size):
        v -= dt / body.mass * (body.stiffness @ (u + settings.damping_us * 1e-6 * v))
        plate.touch(u, v, normal[k], tangential[k])
        u += dt * v
        if (k + 1) % settings.substeps == 0:
            row = k // settings.substeps
            stress[row] = body.stress_rows @ u
            status[row] = plate.status
            passed[row] = plate.friction_N
            if row + 1 in shots:
                kept[row + 1] = body.whole(u)
    watch = SlipWatch(body.ridge, settings.step_us * 1e-6, since_s=_shear_begins_s(settings))
    watch.add(status)
    last = slice(settings.substeps - 1, None, settings.substeps)
    return History(
        step=np.arange(1, settings.steps + 1),
        normal_force_N=normal[last],
        tangential_force_N=tangential[last],
        friction_force_N=passed,
        stress_MPa=stress,
        status=status,
        ridge_of_node=body.ridge,
        truth=watch.truth(),
        stable_step_us=stable_us,
        shots=kept,
    )


def _shear_begins_s(settings: HistorySettings) -> float:
    before = [p.step for p in settings.loads if p.tangential_force_N == 0.0]
    return max(before, default=0) * settings.step_us * 1e-6


class _Plate:
    """A rigid plate on the nodes of the skin. It gives each node the impulse that contact requires.

    In the normal direction it has no inertia: its height is such that the pressing forces add up to
    F_n. Along x it has a small mass, so that its motion is defined when every node slips.
    """

    def __init__(self, settings: HistorySettings, body: _Body, dt: float):
        self._friction = settings.friction
        self._gap = body.gap
        self._x, self._y = body.tangential, body.vertical
        self._per_N = dt / body.mass[self._x]
        self._dt = dt
        self._mass = settings.object_mass_g * 1e-6
        self._speed = 0.0
        self._bonded = np.ones(body.ridge.size)
        self.status: Statuses = np.zeros(body.ridge.size, np.int8)
        self.friction_N = 0.0

    def touch(self, u: Floats, v: Floats, normal_N: float, tangential_N: float) -> None:
        """Correct the velocities `v` such that the end of the step satisfies contact and
        friction."""
        stiffness = 1.0 / (self._per_N * self._dt)
        height = self._gap - u[self._y] - self._dt * v[self._y]
        pressing = _pressing(height, stiffness, normal_N)
        f = self._friction
        mu = f.kinetic_coefficient + (f.static_coefficient - f.kinetic_coefficient) * self._bonded
        limit = mu * pressing
        drag = _Drag(v[self._x].copy(), 1.0 / self._per_N, limit)
        self._speed = drag.plate_speed(self._speed, tangential_N, self._mass / self._dt)
        force = drag.forces(self._speed)
        v[self._y] -= self._per_N * pressing
        v[self._x] += self._per_N * force
        self._judge(v[self._x] - self._speed, pressing, force, limit)
        self.friction_N = float(force.sum())

    def _judge(self, slide: Floats, pressing: Floats, force: Floats, limit: Floats) -> None:
        slips = (np.abs(force) >= limit * (1 - 1e-12)) & (pressing > 0)
        law, speed = self._friction, np.abs(slide) * slips
        self._bonded *= np.exp(-speed * self._dt / (law.weakening_distance_um * 1e-3))
        rests = speed <= law.healing_speed_mm_s
        left = math.exp(-self._dt / (law.healing_time_ms * 1e-3))
        self._bonded = np.where(rests, 1 - (1 - self._bonded) * left, self._bonded)
        self._bonded[pressing <= 0] = 1.0
        direction = np.where(force > 0, SLIP_PLUS, SLIP_MINUS)
        self.status = np.where(pressing <= 0, OPEN, np.where(slips, direction, STICK)).astype(
            np.int8
        )


def _pressing(height: Floats, stiffness: Floats, total_N: float) -> Floats:
    """Return the forces p = max(0, k (d - height)) with the approach d for which they add up to
    the total."""
    if total_N <= 0:
        return np.zeros_like(height)
    order = np.argsort(height, kind="stable")
    h, k = height[order], stiffness[order]
    summed_k, summed_kh = np.cumsum(k), np.cumsum(k * h)
    approach = (total_N + summed_kh) / summed_k
    touching = int(np.flatnonzero(approach >= h)[-1])
    forces: Floats = np.maximum(0.0, stiffness * (approach[touching] - height))
    return forces


@dataclass(frozen=True)
class _Drag:
    """Friction of all nodes as a function of the plate's speed: each is linear until it slips."""

    velocity: Floats
    stiffness: Floats
    limit: Floats

    def forces(self, speed: float) -> Floats:
        """Return the force on each node when the plate moves at `speed`."""
        forces: Floats = np.clip(self.stiffness * (speed - self.velocity), -self.limit, self.limit)
        return forces

    def plate_speed(self, before: float, given_N: float, inertia: float) -> float:
        """Return the speed at which friction and inertia balance the given force, found exactly.

        Friction against speed is an increasing, piecewise linear function. Its corners are where a
        node starts or stops sticking.
        """
        sticks = self.limit > 0
        k, width = self.stiffness[sticks], self.limit[sticks] / self.stiffness[sticks]
        corners = np.concatenate([self.velocity[sticks] - width, self.velocity[sticks] + width])
        order = np.argsort(corners, kind="stable")
        corners = corners[order]
        slope = np.cumsum(np.concatenate([k, -k])[order]) + inertia
        asked = given_N + inertia * before
        if not corners.size:
            return asked / inertia
        first = -float(self.limit.sum()) + inertia * float(corners[0])
        reached = first + np.concatenate([[0.0], np.cumsum(slope[:-1] * np.diff(corners))])
        at = int(np.searchsorted(reached, asked)) - 1
        if at < 0:
            return float(corners[0] + (asked - first) / inertia)
        return float(corners[at] + (asked - reached[at]) / slope[at])
