"""The film's clamp in the World: the static force from the stage's position, over time.

A history of the force, one value a millisecond of World time, computed when it is asked for and
stored for a while, so that a converter may sample the past. It asks the axis where it was and may
not move it.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from rig.physics.film_clamp import FilmClampSettings, creep_step, push_after

if TYPE_CHECKING:
    from drivers.simulated.world.contact_geometry import Where

Reals = npt.NDArray[np.float64]

GRID_us = 1000
KEPT = 30_000
"""Milliseconds of stored history: longer than any acquisition's way to its reader."""


class ClampedFilm:
    """The static force on the film. Its past never changes: a value lags by one millisecond."""

    def __init__(self, settings: FilmClampSettings, stage_z_mm: Where):
        self.settings = settings
        self._stage_z_mm = stage_z_mm
        (self._at_mm,) = stage_z_mm(np.zeros(1, np.int64)).tolist()
        self._fading_N = 0.0
        self._newest = 0
        """Millisecond of the newest value, which is ``_forces[_count - 1]``."""
        self._forces = np.zeros(2 * KEPT)
        self._forces[0] = self.push_N(self._at_mm, 0)
        self._count = 1

    def preload_N(self, times_s: Reals) -> Reals:  # noqa: N802
        """Return the static force at ascending World times, none in the future; shape of
        `times_s`."""
        if not times_s.size:
            return np.zeros_like(times_s)
        earliest, latest = float(times_s[0]), float(times_s[-1])
        self._catch_up(math.floor(latest * 1e6))
        oldest = self._newest - self._count + 1
        first = max(math.floor(earliest * 1e3) - 2, oldest)
        forces = self._forces[first - oldest : self._count]
        grid = np.arange(first, self._newest + 1) + 1
        force: Reals = np.interp(times_s, grid * (GRID_us * 1e-6), forces)
        return force

    def push_N(self, position_mm: float, t_us: int) -> float:  # noqa: N802
        """Return the force in N of the film on a carriage that stands at `position_mm` at the World
        time `t_us`, positive against it."""
        self._catch_up(t_us - GRID_us)
        return push_after(self.settings, self._fading_N, self._at_mm, position_mm, GRID_us * 1e-6)

    def _catch_up(self, t_us: int) -> None:
        newest = t_us // GRID_us
        if newest <= self._newest:
            return
        first = self._newest + 1
        path = self._stage_z_mm(np.arange(first, newest + 1) * GRID_us)
        path = path[self._newest + 1 - first :]  # a stage that moves has asked for its load
        if not path.size:
            return
        positions = np.concatenate([[self._at_mm], path])
        forces, self._fading_N = creep_step(
            self.settings, self._fading_N, positions, GRID_us * 1e-6
        )
        fresh = forces[1:][-KEPT:]
        if self._count + len(fresh) > len(self._forces):
            kept = self._forces[max(self._count - KEPT, 0) : self._count].copy()
            self._forces[: len(kept)], self._count = kept, len(kept)
        self._forces[self._count : self._count + len(fresh)] = fresh
        self._count += len(fresh)
        self._newest, self._at_mm = newest, float(path[-1])
