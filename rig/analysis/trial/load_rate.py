"""Converts the volts of a strip to the rate of the load on it, in N/s, with its calibrated level b.

A film with its amplifier responds to the rate of its load. Far below its pole

    V = 10^(b/20) / (2 pi) * dF/dt,      b in dB re 1 V/N at 1 Hz (equation 2 of the paper)

because a sine of 1 N peak at 1 Hz has a rate of 2 pi N/s. The inverse is one factor for all
samples, so its error is common to all of them, unlike the noise of the volts. The pole attenuates
fast changes. It is not divided out, because that would raise the noise with frequency; up to
`flat_to_Hz` it takes less than 1 %.

The b of a record includes the gain of the amplifier used for the calibration; volts from another
gain are scaled. F is the load on the film for which b was calibrated. For a strip in a ridge it is
the strip's own share of the load, not that of the ridge.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.analysis.estimate import Estimate
from rig.analysis.response.complex_response import DB_PER_RELATIVE
from rig.core.errors import ConfigurationError
from rig.instruments.calibration import FilmCalibration

Reals = NDArray[np.float64]

FLAT = 0.01
"""Largest attenuation by the pole within the stated band, as a fraction."""


@dataclass(frozen=True)
class LoadScale:
    """Factor from the volts of a strip to the rate of its load."""

    N_s_per_V: Estimate
    """The factor in N/(V s), signed. Its error is common to all samples."""
    flat_to_Hz: float
    """Frequency up to which the pole of the film takes less than 1 %."""

    def rate_N_s(self, volts: ArrayLike, zero_V: float = 0.0) -> Reals:  # noqa: N802
        """Return the rate of the load (n,) in N/s from volts (n,), given the volts at rest."""
        rate: Reals = (np.asarray(volts, dtype=np.float64) - zero_V) * self.N_s_per_V.value
        return rate

    def error_N_s(self, rate_N_s: float) -> float:  # noqa: N802 - the unit keeps its capital
        """Return the standard error of a rate in N/s, from the calibration alone."""
        return abs(rate_N_s) * self.N_s_per_V.standard_error / abs(self.N_s_per_V.value)


def load_scale(
    b_dB: float, b_error_dB: float, *, polarity: int = 1, corner_Hz: float = math.inf
) -> LoadScale:
    """Return the scale of a strip with level `b_dB`, in dB re 1 V/N at 1 Hz, with its amplifier's
    gain.

    Raises ValueError for a level that is not finite or a negative error.

    >>> round(load_scale(0.0, 0.1).N_s_per_V.value, 3)  # 1 V/N at 1 Hz: 1 V is 2 pi N/s
    6.283
    """
    if not (math.isfinite(b_dB) and b_error_dB >= 0 and polarity in (-1, 1)):
        raise ValueError(
            f"b_dB {b_dB:g} and its error {b_error_dB:g} must be numbers, the error at least 0, "
            f"and polarity {polarity} must be 1 or -1"
        )
    factor = polarity * 2 * math.pi * 10 ** (-b_dB / 20)
    size = Estimate.of_logarithm(math.log(abs(factor)), b_error_dB / DB_PER_RELATIVE, "N/(V s)")
    if polarity < 0:
        size = Estimate(-size.value, size.standard_error, -size.high, -size.low, size.unit)
    return LoadScale(size, corner_Hz * math.sqrt((1 - FLAT) ** -2 - 1))


def load_scale_of_record(record: FilmCalibration, amplifier_gain: float | None = None) -> LoadScale:
    """Return the scale from a calibration record. The error of b includes noise, load cell and
    model.

    `amplifier_gain` is the gain with which the volts were measured. Raises ConfigurationError if it
    is given and the record does not state the gain of the calibration.
    """
    level = record.b_dB.value if record.b_dB.value is not None else math.nan
    if amplifier_gain is not None:
        if record.amplifier_gain is None:
            raise ConfigurationError(
                f"the record of film {record.sensor!r} does not say its amplifier's gain",
                "calibrate it from a run whose bench file states the gain",
            )
        level += amplifier_dB(amplifier_gain / record.amplifier_gain)
    error = math.hypot(math.sqrt(record.covariance[0][0]), record.gain_model_error_dB)
    corner_Hz = 1 / record.inverse_corner_s if record.inverse_corner_s > 0 else math.inf
    return load_scale(level, error, polarity=record.polarity, corner_Hz=corner_Hz)


def amplifier_dB(gain: float) -> float:  # noqa: N802 - the unit keeps its capital
    """Return a gain in dB.

    >>> amplifier_dB(10.0)
    20.0
    """
    return 20 * math.log10(gain)
