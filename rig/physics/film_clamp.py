"""The film in its clamp as the stage and the force sensor meet it: a spring that creeps.

The indentor of the vibrator presses the film against the force sensor's probe (paper 3.1, 25 N on
8 mm2). Between them lie film, glue and the sensor's own compliance: a standard linear solid with
one-sided contact. Positive displacement is compression. All values are assumed.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from rig.core.settings import Settings

Reals = NDArray[np.float64]


class FilmClampSettings(Settings):
    """Compliance of the clamped film (assumed; the paper gives none)."""

    contact_mm: float = Field(default=12.4, gt=0)
    """Stage position at which the indentor just touches the film."""
    stiffness_N_mm: float = Field(default=80.0, gt=0)
    """Static stiffness, after all creep."""
    creep_stiffness_N_mm: float = Field(default=8.0, ge=0)
    """Further stiffness against a fast compression; it relaxes."""
    creep_s: float = Field(default=3.0, gt=0)
    """Time constant of that relaxation."""
    gain_per_newton_dB: float = Field(default=0.02, ge=-1, le=1)
    """Change of the film's gain with preload, about the nominal preload."""
    nominal_preload_N: float = Field(default=25.0, gt=0)
    """Preload at which the film's gain is the nominal one."""


def creep_step(
    settings: FilmClampSettings, fading_N: float, position_mm: Reals, step_s: float
) -> tuple[Reals, float]:
    """Force at successive positions (n,), `step_s` apart, and the fading part at the last.

    `fading_N` is the relaxing part of the force at ``position_mm[0]``. Between positions the
    motion is linear, for which the step is exact:
    q' = -q / tau + k1 x', x the compression; F = k x + q, never a pull. Returns forces in N (n,).
    """
    decay = math.exp(-step_s / settings.creep_s)
    gain = settings.creep_s / step_s * (1 - decay) * settings.creep_stiffness_N_mm
    forces: list[float] = []
    before = max(float(position_mm[0]) - settings.contact_mm, 0.0)
    for position in position_mm.tolist():  # a few at a time, mostly: arrays would cost more
        compression = max(position - settings.contact_mm, 0.0)
        if forces:
            fading_N = decay * fading_N + gain * (compression - before)
        before = compression
        force = max(settings.stiffness_N_mm * compression + fading_N, 0.0)
        forces.append(force if compression > 0 else 0.0)
    return np.array(forces), fading_N


def push_after(
    settings: FilmClampSettings, fading_N: float, from_mm: float, to_mm: float, step_s: float
) -> float:
    """Force in N at the end of one step of `creep_step`, without the arrays."""
    before = max(from_mm - settings.contact_mm, 0.0)
    after = max(to_mm - settings.contact_mm, 0.0)
    if not after:
        return 0.0
    decay = math.exp(-step_s / settings.creep_s)
    gain = settings.creep_s / step_s * (1 - decay) * settings.creep_stiffness_N_mm
    fading = decay * fading_N + gain * (after - before)
    return max(settings.stiffness_N_mm * after + fading, 0.0)


def preload_gain(settings: FilmClampSettings, preload_N: Reals) -> Reals:
    """Factor on the film's response at a preload: none without contact."""
    change_dB = settings.gain_per_newton_dB * (preload_N - settings.nominal_preload_N)
    factor: Reals = np.where(preload_N > 0, 10 ** (change_dB / 20), 0.0)
    return factor
