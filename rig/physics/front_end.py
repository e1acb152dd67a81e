"""Errors that a channel of the data acquisition adds to a signal: broadband noise and mains hum.

These are pure functions that return sizes only. The caller draws the random numbers.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from rig.core.settings import Settings
from rig.physics.modal import Reals


class FrontEndSettings(Settings):
    """Noise and hum of one channel, referred to its input (the film)."""

    noise_density_V_sqrtHz: float = Field(default=2e-6, ge=0)
    """One-sided white noise density referred to the film (assumed; 2 uV/sqrt(Hz) or more)."""
    noise_bandwidth_Hz: float = Field(default=30e3, gt=0)
    """Equivalent noise bandwidth of amplifier and converter input (assumed). The converters have no
    anti-alias filter, so at low sampling rates all of it folds into the record."""
    mains_amplitude_mV: float = Field(default=0.1, ge=0)
    """Peak amplitude of the mains pick-up (assumed)."""
    mains_frequency_Hz: float = Field(default=50.02, gt=0)
    """Mains frequency (assumed), which is never exactly the nominal one."""


def noise_rms(settings: FrontEndSettings, rate: float) -> float:
    """Return the standard deviation in V of one sample at ``rate`` (samples/s); samples are
    independent.

    Its square is density² * max(rate / 2, bandwidth). Below twice the bandwidth the noise folds,
    and each sample carries all of it. Above, the density in the band is constant; this is slightly
    pessimistic, because the samples stay white up to half the rate.
    """
    band = max(rate / 2, settings.noise_bandwidth_Hz)
    return float(settings.noise_density_V_sqrtHz * np.sqrt(band))


def mains_hum(settings: FrontEndSettings, times: ArrayLike, phase_rad: float = 0.0) -> Reals:
    """Return the pick-up in V at ``times`` in s: a sine with ``phase_rad`` at time 0, shape of
    ``times``."""
    turns = settings.mains_frequency_Hz * np.asarray(times, dtype=float)
    hum: Reals = 1e-3 * settings.mains_amplitude_mV * np.sin(2 * np.pi * turns + phase_rad)
    return hum
