"""A strip's volts as the rate of the load on it, N/s, through its calibrated level b.

A film with its amplifier answers the rate of its load: far below its pole,

    V = 10^(b/20) / (2 pi) * dF/dt,      b in dB re 1 V/N at 1 Hz (equation 2 of the paper),

because a sine of 1 N peak at 1 Hz has a rate of 2 pi N/s. The inverse is one factor for all
samples, so its error is common to all of them, unlike the volts' noise. The pole takes something
from fast changes and is not divided out, which would raise the noise with the frequency; up to
`flat_to_Hz` it takes less than 1 %.

The record's b contains the gain of the amplifier it was taken with; volts from another gain are
scaled. F is the load on the film that b was calibrated for: on a strip inside a ridge it is the
strip's own share, not the ridge's.
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
"""What the pole may take within the stated band."""


@dataclass(frozen=True)
class LoadScale:
    """What turns a strip's volts into a rate of load."""

    N_s_per_V: Estimate
    """The factor, signed; its error is common to all samples."""
    flat_to_Hz: float
    """Up to here the film's pole takes less than 1 %."""

    def rate_N_s(self, volts: ArrayLike, zero_V: float = 0.0) -> Reals:  # noqa: N802
        """Rate of load (n,) from volts (n,), with `zero_V` what they are at rest."""
        rate: Reals = (np.asarray(volts, dtype=np.float64) - zero_V) * self.N_s_per_V.value
        return rate

    def error_N_s(self, rate_N_s: float) -> float:  # noqa: N802 - the unit keeps its capital
        """Standard error of a rate, N/s, from the calibration alone."""
        return abs(rate_N_s) * self.N_s_per_V.standard_error / abs(self.N_s_per_V.value)


def load_scale(
    b_dB: float, b_error_dB: float, *, polarity: int = 1, corner_Hz: float = math.inf
) -> LoadScale:
    """Scale of a strip of level `b_dB`, dB re 1 V/N at 1 Hz with the gain of its amplifier.

    ValueError for a level that is no number or an error below zero.
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
    """The same through a calibration record; b's error holds noise, load cell and the model's.

    `amplifier_gain` is that of the volts. ConfigurationError where it is given and the record does
    not say with which gain it was taken.
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
    """What a gain adds to a level, dB."""
    return 20 * math.log10(gain)
