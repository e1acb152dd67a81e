"""From a strip's stress to volts: stress → charge → circuit → amplifier, at the step rate.

The rational two-node circuit of the paper's Figure 6 with its Table 1 (nodal analysis; the printed
equation 4 is not used here):

    H(s) = G d33 R_PV R_i s / [R_PV (1 + s R_i C_i) + R_i (1 + s R_PV C_PV)
                               + R_s (1 + s R_PV C_PV) (1 + s R_i C_i)],   R_s = R1 + R2

Discretised exactly for a stress that is linear between steps. Sampling belongs to the DAQ.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from rig.settings import Settings

Floats = NDArray[np.float64]


class TransducerSettings(Settings):
    """A film strip with its amplifier (paper Table 1; gain, area, d33 and R1 + R2 assumed)."""

    film_capacitance_pF: float = Field(30.0, gt=0)
    film_resistance_ohm: float = Field(8.0e5, gt=0)
    input_capacitance_pF: float = Field(1.5, gt=0)
    input_resistance_ohm: float = Field(3.0e5, gt=0)
    series_resistance_ohm: float = Field(0.0, ge=0)
    """R1 + R2; the paper does not give them."""
    d33_C_N: float = Field(2.5e-11, gt=0)
    """Piezoelectric constant (assumed; the literature has 2.0e-11 to 3.3e-11)."""
    area_mm2: float = Field(8.0, gt=0)
    """Area on which the stress acts."""
    gain: float = Field(1000.0, gt=0)
    """Amplifier gain of the skin's channels."""
    output_limit_V: float = Field(10.0, gt=0)
    """The output clips at plus and minus this."""

    def response(self, frequency_Hz: Floats) -> NDArray[np.complex128]:
        """H at the given frequencies, complex V per N, without the clip."""
        s = 2j * math.pi * np.asarray(frequency_Hz, float)
        numerator, denominator = self.polynomials()
        response: NDArray[np.complex128] = np.polyval(numerator, s) / np.polyval(denominator, s)
        return response

    def polynomials(self) -> tuple[Floats, Floats]:
        """Numerator and denominator of H(s), highest power first, V per N."""
        Rp, Ri, Rs = self.film_resistance_ohm, self.input_resistance_ohm, self.series_resistance_ohm
        Cp, Ci = self.film_capacitance_pF * 1e-12, self.input_capacitance_pF * 1e-12
        numerator = np.array([self.gain * self.d33_C_N * Rp * Ri, 0.0])
        film, amplifier = np.array([Rp * Cp, 1.0]), np.array([Ri * Ci, 1.0])
        denominator: Floats = Rp * amplifier + Ri * film
        if Rs > 0:
            denominator = np.concatenate([[0.0], denominator]) + Rs * np.convolve(film, amplifier)
        return numerator, denominator


class TransducerChain:
    """Volts of several equal channels from their stress, block by block."""

    def __init__(self, settings: TransducerSettings, step_s: float, channels: int = 2):
        if step_s <= 0:
            raise ValueError(f"step_s {step_s} s must be above 0 s: time runs forward")
        self.settings = settings
        A, b, self._c, self._d = _state_space(*settings.polynomials())
        self._A, self._b_now, self._b_next = _ramp_invariant(A, b, step_s)
        self._x = np.zeros((b.size, channels))
        self._last: Floats | None = None

    def advance(self, stress_MPa: Floats) -> Floats:
        """Volts (k, channels) of stress (k, channels); the first call's first row is at rest."""
        force_N = np.asarray(stress_MPa, float) * self.settings.area_mm2
        if not force_N.shape[0]:
            return np.zeros_like(force_N)
        last = force_N[0] if self._last is None else self._last
        before = np.vstack([last[None, :], force_N[:-1]])
        drive = (
            self._b_now[None, :, None] * before[:, None, :]
            + self._b_next[None, :, None] * force_N[:, None, :]
        )
        volts = np.empty_like(force_N)
        x, A, c = self._x, self._A, self._c
        for k, pushed in enumerate(drive):
            x = A @ x + pushed
            volts[k] = c @ x
        self._x, self._last = x, force_N[-1].copy()
        volts += self._d * force_N
        return np.clip(volts, -self.settings.output_limit_V, self.settings.output_limit_V)


def _state_space(numerator: Floats, denominator: Floats) -> tuple[Floats, Floats, Floats, float]:
    """Controllable canonical form (A, b, c, d) of a proper rational function."""
    order = denominator.size - 1
    a = denominator / denominator[0]
    n = np.concatenate([np.zeros(order + 1 - numerator.size), numerator]) / denominator[0]
    d = float(n[0])
    A = np.zeros((order, order))
    A[0] = -a[1:]
    A[1:, :-1] = np.eye(order - 1)
    b = np.zeros(order)
    b[0] = 1.0
    return A, b, n[1:] - d * a[1:], d


def _ramp_invariant(A: Floats, b: Floats, step_s: float) -> tuple[Floats, Floats, Floats]:
    """Exact step for an input that is linear between the steps: x' = A x + b0 f_k + b1 f_k+1."""
    from scipy.linalg import expm

    order = b.size
    big = np.zeros((order + 2, order + 2))
    big[:order, :order] = A * step_s
    big[:order, order] = b * step_s
    big[order, order + 1] = 1.0
    moved = expm(big)
    b_next = moved[:order, order + 1]
    return moved[:order, :order], moved[:order, order] - b_next, b_next
