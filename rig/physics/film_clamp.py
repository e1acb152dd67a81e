"""Mechanics of a film in its clamp, as the stage and the force sensor experience them: a spring
that creeps.

The indentor of the vibrator presses the film against the probe of the force sensor (paper 3.1, 25 N
on 8 mm²). Film, glue and the compliance of the sensor lie between them: a standard linear solid
with one-sided contact. A positive displacement compresses. All values are assumed.
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
    """Additional stiffness against a fast compression, which relaxes."""
    creep_s: float = Field(default=3.0, gt=0)
    """Time constant of that relaxation."""
    gain_per_newton_dB: float = Field(default=0.02, ge=-1, le=1)
    """Change of the film's gain with preload, about the nominal preload."""
    gain_per_load_decade_dB: float = Field(default=0.0, ge=-20, le=20)
    """Change of the film's gain by decade of the sinusoidal load, about 1 N. 0 for a linear film,
    as the paper reports (3.2, data2 (i))."""
    nominal_preload_N: float = Field(default=25.0, gt=0)
    """Preload at which the film has its nominal gain."""


def creep_step(
    settings: FilmClampSettings, fading_N: float, position_mm: Reals, step_s: float
) -> tuple[Reals, float]:
    """Return the forces (n,) in N at successive positions (n,), `step_s` apart, and the relaxing
    part at the end.

    `fading_N` is the relaxing part of the force at ``position_mm[0]``. The motion between two
    positions is linear, for which the step is exact: q' = -q / tau + k1 x' with the compression x,
    and F = k x + q, which never pulls.
    """
    decay = math.exp(-step_s / settings.creep_s)
    gain = settings.creep_s / step_s * (1 - decay) * settings.creep_stiffness_N_mm
    forces: list[float] = []
    before = max(float(position_mm[0]) - settings.contact_mm, 0.0)
    # Plain numbers: there are mostly a few positions, for which arrays would cost more.
    for position in position_mm.tolist():
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
    """Return the force in N at the end of one step of `creep_step`, without arrays."""
    before = max(from_mm - settings.contact_mm, 0.0)
    after = max(to_mm - settings.contact_mm, 0.0)
    if not after:
        return 0.0
    decay = math.exp(-step_s / settings.creep_s)
    gain = settings.creep_s / step_s * (1 - decay) * settings.creep_stiffness_N_mm
    fading = decay * fading_N + gain * (after - before)
    return max(settings.stiffness_N_mm * after + fading, 0.0)


def preload_gain(settings: FilmClampSettings, preload_N: Reals) -> Reals:
    """Return the factor on the film's response at a preload: 0 without contact.

    It has no unit, and the shape of the preloads, which are in N.
    """
    change_dB = settings.gain_per_newton_dB * (preload_N - settings.nominal_preload_N)
    factor: Reals = np.where(preload_N > 0, 10 ** (change_dB / 20), 0.0)
    return factor


def load_gain(settings: FilmClampSettings, load_N: Reals) -> Reals:
    """Return the factor on the film's response under a sinusoidal load, peak in N; 1 without
    one.

    It has no unit, and the shape of the loads.
    """
    if not settings.gain_per_load_decade_dB:
        return np.ones_like(load_N)
    decades = np.log10(np.where(load_N > 0, load_N, 1.0))
    factor: Reals = 10 ** (settings.gain_per_load_decade_dB * decades / 20)
    return factor
