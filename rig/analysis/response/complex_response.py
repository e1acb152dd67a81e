"""Complex response from two sine fits, with its errors, and the lowest errors that any estimate can
have."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rig.analysis.response.sine_fit import RecordError, SineFit, scaled_covariance

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]

DB_PER_RELATIVE = 20 / math.log(10)
"""Change of a level in dB per small relative change of an amplitude: 8.686."""

CLEAR_LOAD = 5.0
"""Standard errors by which the amplitude of a load must exceed zero before it is divided by."""


@dataclass(frozen=True, eq=False)
class Response:
    """Output over load at one frequency in V/N, with first-order standard errors."""

    frequency_Hz: float
    """Frequency of the load."""
    value: complex
    """Complex response, in V/N."""
    covariance: Reals
    """Covariance of the (real, imaginary) part of ``value``, (2, 2)."""
    coherence: float
    """Squared coherence of the two channels over the parts of the record; NaN with fewer than 2
    parts."""
    leakage: Reals = field(default_factory=lambda: np.zeros((2, 2)))
    """Part of ``covariance`` that is due to mains lines that were not fitted, (2, 2)."""

    @property
    def gain_dB(self) -> float:  # noqa: N802
        """Gain, 20 log10 of the magnitude, in dB re 1 V/N (paper eq. 1)."""
        return 20 * math.log10(abs(self.value)) if self.value else -math.inf

    @property
    def gain_standard_error_dB(self) -> float:  # noqa: N802
        """Standard error of the gain, in dB."""
        return DB_PER_RELATIVE * self._relative_error(self.covariance, 1.0)

    @property
    def gain_noise_dB(self) -> float:  # noqa: N802
        """Part of it, in dB, that a longer record at this frequency reduces: noise without
        leakage."""
        return DB_PER_RELATIVE * self._relative_error(self.covariance - self.leakage, 1.0)

    @property
    def phase_deg(self) -> float:
        """Phase of output against load in degrees, in (-180, 180]."""
        return math.degrees(math.atan2(self.value.imag, self.value.real))

    @property
    def phase_standard_error_deg(self) -> float:
        """Standard error of the phase, in degrees."""
        return math.degrees(self._relative_error(self.covariance, 1j))

    def _relative_error(self, covariance: Reals, turn: complex) -> float:
        """Return the relative error of the value along its own direction (turn 1) or across it
        (1j)."""
        if not self.value:
            return math.inf
        unit = turn * self.value / abs(self.value)
        direction = np.array([unit.real, unit.imag])
        return math.sqrt(max(float(direction @ covariance @ direction), 0.0)) / abs(self.value)


def complex_response(voltage: SineFit, load: SineFit) -> Response:
    """Return voltage over load in V/N, from independent fits of simultaneous records in V and N.

    Errors are first order: with H = V / L, dH = dV / L - H dL / L. Each term is a rotation and
    scaling of the 2 x 2 covariance of its channel (JCGM 102:2011, 6.2, the bivariate form of the
    GUM's law).

    Raises RecordError if the frequencies differ or the load does not exceed its noise.
    """
    if voltage.frequency_Hz != load.frequency_Hz:
        raise RecordError(
            f"voltage was fitted at {voltage.frequency_Hz:g} Hz, load at {load.frequency_Hz:g} Hz"
        )
    if load.amplitude <= CLEAR_LOAD * load.standard_error or not load.amplitude:
        raise RecordError(
            f"no load at {load.frequency_Hz:g} Hz: {load.amplitude:.3g} N with a standard error of "
            f"{load.standard_error:.3g} N",
            "check that the vibrator is driven and the load cell connected",
        )
    value = voltage.phasor / load.phasor

    def carried(by_voltage: Reals, by_load: Reals) -> Reals:
        return scaled_covariance(by_voltage, 1 / load.phasor) + scaled_covariance(
            by_load, -value / load.phasor
        )

    leakage = carried(voltage.leakage, load.leakage)
    covariance = carried(voltage.covariance, load.covariance) + leakage
    coherence = _coherence(voltage.block_phasors, load.block_phasors)
    return Response(load.frequency_Hz, value, covariance, coherence, leakage)


def cramer_rao_amplitude(noise_rms: float, n: int) -> float:
    """Return the least standard error of the amplitude of a tone in n samples of white noise:
    sigma sqrt(2/n).

    >>> cramer_rao_amplitude(0.01, n=200)
    0.001
    """
    return noise_rms * math.sqrt(2 / n)


def cramer_rao_phase_deg(noise_rms: float, amplitude: float, n: int) -> float:
    """Return the least standard error in degrees of the phase of a tone of known frequency."""
    return math.degrees(cramer_rao_amplitude(noise_rms, n) / amplitude)


def cramer_rao_gain_dB(noise_rms: float, amplitude: float, n: int) -> float:  # noqa: N802
    """Return the least standard error in dB of the level of a tone."""
    return DB_PER_RELATIVE * cramer_rao_amplitude(noise_rms, n) / amplitude


def cramer_rao_duration(
    noise_rms: float, amplitude: float, rate: float, standard_error_dB: float
) -> float:
    """Return the shortest record in s at ``rate`` (1/s) that can determine a level to
    ``standard_error_dB``."""
    relative = standard_error_dB / DB_PER_RELATIVE
    return 2 * (noise_rms / (amplitude * relative)) ** 2 / rate


def quantisation_rms(step: float) -> float:
    """Return the rms error of a converter with the given step, evenly distributed: step /
    sqrt(12).

    It holds if noise of at least half a step moves the codes. Its power adds to that of the noise.
    """
    return step / math.sqrt(12)


def _coherence(voltage: Complexes, load: Complexes) -> float:
    if voltage.size != load.size or voltage.size < 2:
        return math.nan
    power = float(np.vdot(voltage, voltage).real * np.vdot(load, load).real)
    return float(abs(np.vdot(load, voltage)) ** 2) / power if power else math.nan
