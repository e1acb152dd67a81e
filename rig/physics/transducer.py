"""Converts the stress of a strip to volts: stress → charge → circuit → amplifier, at the step rate.

The circuit is the rational reading of ``rig.physics.pvdf`` with the paper's Table 1 (equation 4 is
not used here), discretised exactly for a stress that is linear between steps. Sampling is done by
the data acquisition, not here.
"""

from __future__ import annotations

import math
from itertools import accumulate

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from rig.core.settings import Settings
from rig.physics import pvdf
from rig.physics.pvdf import SKIN_STRIP, CircuitSettings

Floats = NDArray[np.float64]

SERIES = 18
"""Terms of the series, after which the sum no longer changes for |a| up to 1."""


class TransducerSettings(Settings):
    """A film strip in a ridge with its amplifier."""

    circuit: CircuitSettings = SKIN_STRIP.model_copy(update={"gain": 1000.0})
    """Circuit of film and amplifier: Table 1, with the gain of the skin's channels (assumed)."""
    area_mm2: float = Field(default=8.0, gt=0)
    """Area on which the stress acts (the paper's 3.1 gives it for the indentor of the sweep)."""
    output_limit_V: float = Field(default=10.0, gt=0)
    """Voltage at which the output clips, in both directions (assumed)."""

    def response(self, frequency_Hz: ArrayLike) -> NDArray[np.complex128]:
        """Return the complex response in V per MPa of stress at the given frequencies, without
        clipping.

        It has the shape of `frequency_Hz`.
        """
        response: NDArray[np.complex128] = self.area_mm2 * pvdf.circuit(frequency_Hz, self.circuit)
        return response


class TransducerChain:
    """Computes the volts of several equal channels from their stress, block by block."""

    def __init__(self, settings: TransducerSettings, step_s: float, channels: int = 2):
        """Begin at rest, with steps of `step_s`. Raises ValueError for one that is not above 0
        s."""
        if step_s <= 0:
            raise ValueError(f"step_s {step_s} s must be above 0 s: time runs forward")
        self.settings = settings
        A, b, self._c, self._d = _state_space(*map(np.array, pvdf.polynomials(settings.circuit)))
        self._A, self._b_now, self._b_next = _ramp_invariant(A, b, step_s)
        self._x = np.zeros((b.size, channels))
        self._last: Floats | None = None

    def advance(self, stress_MPa: Floats) -> Floats:
        """Return the volts (k, channels) for further stress (k, channels).

        The first row of the first call is taken as the state of rest.
        """
        force_N = np.asarray(stress_MPa, float) * self.settings.area_mm2
        if not force_N.shape[0]:
            return np.zeros_like(force_N)
        last = force_N[0] if self._last is None else self._last
        before = np.vstack([last[None, :], force_N[:-1]])
        drive = (
            self._b_now[None, :, None] * before[:, None, :]
            + self._b_next[None, :, None] * force_N[:, None, :]
        )
        states = self._states(drive)
        self._x, self._last = states[-1].copy(), force_N[-1].copy()
        volts: Floats = np.einsum("o,koc->kc", self._c, states) + self._d * force_N
        return np.clip(volts, -self.settings.output_limit_V, self.settings.output_limit_V)

    def _states(self, drive: Floats) -> Floats:
        """Return the states after each step of a drive, both (k, order, channels)."""
        # Table 1 gives a system of first order, for which plain numbers are ten times as fast.
        if drive.shape[1] == 1:
            a = float(self._A[0, 0])
            columns = []
            for x, pushes in zip(self._x[0].tolist(), drive[:, 0].T.tolist(), strict=True):
                columns.append(list(accumulate(pushes, lambda x, push: a * x + push, initial=x)))
            return np.array(columns).T[1:, None, :]
        states = np.empty_like(drive)
        x = self._x
        for k, pushed in enumerate(drive):
            states[k] = x = self._A @ x + pushed
        return states


def _state_space(numerator: Floats, denominator: Floats) -> tuple[Floats, Floats, Floats, float]:
    """Return the controllable canonical form (A, b, c, d) of a proper rational function."""
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
    """Return the exact step for an input that is linear between steps: x' = A x + b0 f_k + b1
    f_k+1."""
    order = b.size
    # Table 1 gives a system of first order: a closed form, without importing scipy.linalg.
    if order == 1:
        decay, held, rising = _exponentials(float(A[0, 0]) * step_s)
        driven = step_s * b
        return np.array([[decay]]), driven * (held - rising), driven * rising
    from scipy.linalg import expm

    big = np.zeros((order + 2, order + 2))
    big[:order, :order] = A * step_s
    big[:order, order] = b * step_s
    big[order, order + 1] = 1.0
    moved = expm(big)
    b_next = moved[:order, order + 1]
    return moved[:order, :order], moved[:order, order] - b_next, b_next


def _exponentials(a: float) -> tuple[float, float, float]:
    """Return exp(a), (exp(a) - 1) / a and (exp(a) - 1 - a) / a², accurate to the last digits."""
    # For small a the formulas below lose digits by cancellation; the series does not.
    if abs(a) > 1:
        decay, held = math.exp(a), math.expm1(a) / a
        return decay, held, (held - 1) / a
    rising = sum(a**k / math.factorial(k + 2) for k in reversed(range(SERIES)))
    held = 1 + a * rising
    return 1 + a * held, held, rising
