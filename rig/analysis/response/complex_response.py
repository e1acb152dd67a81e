"""Complex response from two sine fits, with its errors, and the bounds no estimate can beat."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.analysis.response.sine_fit import RecordError, SineFit, scaled_covariance

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]

DB_PER_RELATIVE = 20 / math.log(10)
"""dB in a small relative change of an amplitude: 8.686."""

CLEAR_LOAD = 5.0
"""Standard errors by which a load's amplitude must exceed zero to be divided by."""


@dataclass(frozen=True, eq=False)
class Response:
    """Output over load at one frequency, V/N, with first-order standard errors."""

    frequency_Hz: float
    value: complex
    covariance: Reals
    """Of (real, imaginary) part of ``value``, (2, 2)."""
    coherence: float
    """Squared coherence of the two channels over the parts of the record; NaN with fewer than 2."""

    @property
    def gain_dB(self) -> float:  # noqa: N802
        """20 log10 of the magnitude, dB re 1 V/N (paper eq. 1)."""
        return 20 * math.log10(abs(self.value)) if self.value else -math.inf

    @property
    def gain_standard_error_dB(self) -> float:  # noqa: N802
        """Of the gain."""
        return DB_PER_RELATIVE * self._relative_error(1.0)

    @property
    def phase_deg(self) -> float:
        """Phase of output against load, in (-180, 180]."""
        return math.degrees(math.atan2(self.value.imag, self.value.real))

    @property
    def phase_standard_error_deg(self) -> float:
        """Of the phase."""
        return math.degrees(self._relative_error(1j))

    def _relative_error(self, turn: complex) -> float:
        """Error of the value along its own direction (turn 1) or across it (1j), over its size."""
        if not self.value:
            return math.inf
        unit = turn * self.value / abs(self.value)
        direction = np.array([unit.real, unit.imag])
        return math.sqrt(float(direction @ self.covariance @ direction)) / abs(self.value)


def complex_response(voltage: SineFit, load: SineFit) -> Response:
    """Voltage over load, V/N, from independent fits of simultaneous records (V and N).

    Errors to first order, H = V / L: dH = dV / L - H dL / L, each a rotation and scaling of its
    channel's 2 x 2 covariance (JCGM 102:2011, 6.2; the bivariate form of the GUM's law). Raises
    RecordError where frequencies differ or the load does not stand out of its noise.
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
    by_voltage = scaled_covariance(voltage.covariance, 1 / load.phasor)
    by_load = scaled_covariance(load.covariance, -value / load.phasor)
    covariance = by_voltage + by_load
    coherence = _coherence(voltage.block_phasors, load.block_phasors)
    return Response(load.frequency_Hz, value, covariance, coherence)


def cramer_rao_amplitude(noise_rms: float, n: int) -> float:
    """Least standard error of a tone's amplitude in n samples of white noise: sigma sqrt(2/n)."""
    return noise_rms * math.sqrt(2 / n)


def cramer_rao_phase_deg(noise_rms: float, amplitude: float, n: int) -> float:
    """Least standard error in deg of the phase of a tone of known frequency."""
    return math.degrees(cramer_rao_amplitude(noise_rms, n) / amplitude)


def cramer_rao_gain_dB(noise_rms: float, amplitude: float, n: int) -> float:  # noqa: N802
    """Least standard error in dB of a tone's level."""
    return DB_PER_RELATIVE * cramer_rao_amplitude(noise_rms, n) / amplitude


def cramer_rao_duration(
    noise_rms: float, amplitude: float, rate: float, standard_error_dB: float
) -> float:
    """Shortest record in s at ``rate`` (1/s) whose level can be known to ``standard_error_dB``."""
    relative = standard_error_dB / DB_PER_RELATIVE
    return 2 * (noise_rms / (amplitude * relative)) ** 2 / rate


def quantisation_rms(step: float) -> float:
    """Error of a converter of the given step, spread evenly: step / sqrt(12).

    Holds where noise of half a step or more moves the codes; it adds in power to the noise.
    """
    return step / math.sqrt(12)


def _coherence(voltage: Complexes, load: Complexes) -> float:
    if voltage.size != load.size or voltage.size < 2:
        return math.nan
    power = float(np.vdot(voltage, voltage).real * np.vdot(load, load).real)
    return float(abs(np.vdot(load, voltage)) ** 2) / power if power else math.nan
