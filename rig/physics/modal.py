"""Linear systems in modal form, driven by piecewise sinusoids and exact at any time.

A rational transfer function with simple poles is a sum of independent first-order modes,

    x_k' = p_k x_k + b_k u,      y_o = Re(sum_k C[o, k] x_k) + D[o] u

For u(t) = offset + amplitude sin(2 pi f t + phase) each mode has a closed solution: a constant, a
sinusoid and a decaying exponential. Nothing is integrated step by step. An output is therefore
exact to rounding at whatever times a converter samples it, however far apart, and the state moves
over any interval in one step. Of a pair of complex conjugate poles only one is stored, and its
output row is doubled. There is no input or output, no randomness and no unit here: the caller's
zeros, poles and gains determine the units.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]

NEGLIGIBLE_TRANSIENT = 1e-12
"""A transient below this fraction of its output's steady state is omitted."""

CLOSEST_POLES = 1e-6
"""Poles closer to each other than this fraction of their size are treated as repeated."""

_SAME_POLE = 1e-12
_SMALLEST_GRID = 64
_BLOCK = 256
_STACK = 32
"""Blocks per matrix product: few enough that BLAS stays on the calling thread."""
_VANISHED = -150.0


@dataclass(frozen=True)
class ZeroPoleGain:
    """A real rational transfer function gain * prod(s - zeros) / prod(s - poles), s in rad/s."""

    zeros: tuple[complex, ...] = ()
    """Zeros in rad/s; complex ones in conjugate pairs."""
    poles: tuple[complex, ...] = ()
    """Poles in rad/s; complex ones in conjugate pairs."""
    gain: float = 1.0
    """Gain factor."""

    def __mul__(self, other: ZeroPoleGain) -> ZeroPoleGain:
        """Return the two functions in series, without loading each other."""
        return ZeroPoleGain(
            self.zeros + other.zeros, self.poles + other.poles, self.gain * other.gain
        )

    def response(self, frequency: ArrayLike) -> Complexes:
        """Return the complex response at frequencies in Hz, with the shape of ``frequency``."""
        s = 2j * np.pi * np.asarray(frequency, dtype=float)
        value = np.full(s.shape, self.gain, dtype=complex)
        for zero in self.zeros:
            value = value * (s - zero)
        for pole in self.poles:
            value = value / (s - pole)
        return value


@dataclass(frozen=True)
class SineDrive:
    """An input offset + amplitude sin(2 pi frequency t + phase), from t = 0 on."""

    frequency_Hz: float = 0.0
    """Frequency, in Hz."""
    amplitude: float = 0.0
    """Peak amplitude."""
    phase_rad: float = 0.0
    """Phase at t = 0."""
    offset: float = 0.0
    """Constant part."""

    def after(self, interval_s: float) -> SineDrive:
        """Return the same signal with its time origin moved later by ``interval_s``."""
        cycles = self.frequency_Hz * interval_s
        phase = self.phase_rad + 2 * math.pi * (cycles - math.floor(cycles))
        phase = math.remainder(phase, 2 * math.pi)
        return SineDrive(self.frequency_Hz, self.amplitude, phase, self.offset)

    @property
    def phasor(self) -> complex:
        """Complex amplitude U such that the alternating part is Re(U exp(2 pi j f t))."""
        return cmath.rect(self.amplitude, self.phase_rad - math.pi / 2)


@dataclass(frozen=True, eq=False)
class ModalSystem:
    """A stable system of simple poles with one input and several outputs.

    ``poles`` (n_modes,) in rad/s, ``inputs`` b (n_modes,), ``outputs`` C (n_outputs, n_modes),
    ``direct`` D (n_outputs,). Create it with :meth:`from_chains`.
    """

    poles: Complexes
    inputs: Complexes
    outputs: Complexes
    direct: Reals

    @classmethod
    def from_chains(cls, chains: Sequence[ZeroPoleGain]) -> ModalSystem:
        """Return the partial fractions of one transfer function per output; equal poles are
        shared.

        Raises ValueError for a chain that is improper, unstable, not real (a complex zero or pole
        without its conjugate) or has repeated poles, and for nearly equal poles of two chains.
        """
        for chain in chains:
            _check(chain)
        poles = _union([_upper(chain.poles) for chain in chains])
        outputs = np.zeros((len(chains), len(poles)), dtype=complex)
        direct = np.zeros(len(chains))
        for row, chain in enumerate(chains):
            if len(chain.zeros) == len(chain.poles):
                direct[row] = chain.gain
            for pole in _upper(chain.poles):
                column = int(np.argmin(np.abs(np.array(poles) - pole)))
                weight = 2.0 if pole.imag else 1.0
                outputs[row, column] = weight * _residue(chain, pole)
        return cls(
            np.array(poles, dtype=complex), np.ones(len(poles), dtype=complex), outputs, direct
        )

    @property
    def n_outputs(self) -> int:
        """Number of outputs."""
        return len(self.direct)

    def rest(self) -> Complexes:
        """Return the state of a system that has never been driven, (n_modes,)."""
        return np.zeros(len(self.poles), dtype=complex)

    def steady_state(self, frequency: ArrayLike) -> Complexes:
        """Return the complex response H of every output at frequencies in Hz, (..., n_outputs).

        An input Re(U exp(j w t)) gives Re(H U exp(j w t)) once transients have decayed.
        """
        s = 2j * np.pi * np.asarray(frequency, dtype=float)[..., None]
        upper = self.inputs / (s - self.poles)
        lower = self.inputs.conj() / (s - self.poles.conj())
        response: Complexes = (
            upper @ self.outputs.T + lower @ self.outputs.conj().T
        ) / 2 + self.direct
        return response

    def ring_down(self, fraction: float = 0.01) -> float:
        """Return the time in s after which the slowest mode has decayed to ``fraction`` of its
        start."""
        return float(math.log(1 / fraction) / np.min(-self.poles.real))

    def settled(self, drive: SineDrive) -> Complexes:
        """Return the state at t = 0 of a system that has been under ``drive`` forever,
        (n_modes,)."""
        return self._forced(drive, 0.0)

    def advance(self, state: Complexes, drive: SineDrive, interval_s: float) -> Complexes:
        """Return the state ``interval_s`` after t = 0 under ``drive``, given the state at t = 0.

        To continue with the same signal, pass ``drive.after(interval_s)`` next time.
        """
        free = state - self._forced(drive, 0.0)
        moved: Complexes = self._forced(drive, interval_s) + free * np.exp(self.poles * interval_s)
        return moved

    def evaluate(
        self,
        state: Complexes,
        drive: SineDrive,
        times: ArrayLike,
        outputs: Sequence[int] | None = None,
    ) -> Reals:
        """Return the outputs at ``times`` >= 0 (s after the state), (len(times), n_outputs).

        ``outputs`` selects some of them, in that order. The result is exact to rounding (about
        1e-15 times the number of radians since t = 0). The transient of a mode that at the first of
        the times is below 1e-12 of its output's steady state is omitted. Evenly spaced times are
        recognised; they cost two short tables and one matrix product in place of one exponential
        each.
        """
        t = np.asarray(times, dtype=float)
        rows = list(range(self.n_outputs)) if outputs is None else list(outputs)
        if not t.size or not rows:
            return np.zeros((t.size, len(rows)))
        return self.driven(state, drive, rows).at(t)

    def driven(self, state: Complexes, drive: SineDrive, outputs: Sequence[int]) -> DrivenOutputs:
        """Return what `evaluate` needs for one state and drive, to be evaluated repeatedly."""
        rows = list(outputs)
        return DrivenOutputs(
            frequency_Hz=drive.frequency_Hz,
            poles=self.poles,
            steady=self.steady_state(drive.frequency_Hz)[rows] * drive.phasor,
            constant=self.steady_state(0.0)[rows].real * drive.offset,
            transient=self.outputs[rows] * (state - self._forced(drive, 0.0)),
        )

    def _forced(self, drive: SineDrive, time_s: float) -> Complexes:
        """Return the particular solution: the state that remains periodic under ``drive``."""
        later = drive.after(time_s)
        omega = 2j * np.pi * drive.frequency_Hz
        up = later.phasor / 2 / (omega - self.poles)
        down = np.conj(later.phasor) / 2 / (-omega - self.poles)
        state: Complexes = self.inputs * (up + down - drive.offset / self.poles)
        return state


@dataclass(frozen=True, eq=False)
class DrivenOutputs:
    """Outputs under one drive, starting from one state."""

    frequency_Hz: float
    """Frequency of the drive."""
    poles: Complexes
    """Poles of the system, (m,)."""
    steady: Complexes
    """Complex amplitudes of the steady state, (k,)."""
    constant: Reals
    """Constant parts, (k,)."""
    transient: Complexes
    """Complex amplitudes of the transients at t = 0, (k, m)."""

    def at(self, t: Reals) -> Reals:
        """Return the outputs at times >= 0 (s after the state), (len(t), k); `t` must not be
        empty."""
        size = np.abs(self.transient) * np.exp(self.poles.real * float(t.min()))
        limit = NEGLIGIBLE_TRANSIENT * (np.abs(self.steady) + np.abs(self.constant))
        kept = (size > limit[:, None]).any(axis=0)
        rates = np.concatenate([[2j * np.pi * self.frequency_Hz], self.poles[kept]])
        weights = np.concatenate([self.steady[:, None], self.transient[:, kept]], axis=1)
        return _sum_of_exponentials(rates, weights, t) + self.constant


def resonance(frequency_Hz: float, quality: float, level_dB: float) -> ZeroPoleGain:
    """Return a second-order section: 1 far from ``frequency_Hz``, and ``level_dB`` high (or deep)
    at it.

    The poles have the given quality factor. The zeros have the same frequency, and their damping is
    scaled by the level: (s^2 + s w g/Q + w^2) / (s^2 + s w/Q + w^2) with g = 10^(level/20).
    """
    scale = 10 ** (level_dB / 20)
    return ZeroPoleGain(_pair(frequency_Hz, quality / scale), _pair(frequency_Hz, quality))


def lag(frequency_Hz: float) -> ZeroPoleGain:
    """Return a first-order low-pass with unit gain at DC and its corner at ``frequency_Hz``."""
    omega = 2 * np.pi * frequency_Hz
    return ZeroPoleGain((), (complex(-omega),), omega)


def _pair(frequency_Hz: float, quality: float) -> tuple[complex, complex]:
    """Return the two roots of s^2 + s w/Q + w^2."""
    omega = 2 * math.pi * frequency_Hz
    half = 1 / (2 * quality)
    if half < 1:
        root = omega * complex(-half, math.sqrt(1 - half**2))
        return root, root.conjugate()
    # By subtraction the slow root would lose digits; in this form it does not.
    slow = -omega / (half + math.sqrt(half**2 - 1))
    return complex(omega**2 / slow), complex(slow)


def _check(chain: ZeroPoleGain) -> None:
    if len(chain.zeros) > len(chain.poles):
        raise ValueError(f"improper: {len(chain.zeros)} zeros, {len(chain.poles)} poles")
    for roots in (chain.zeros, chain.poles):
        for root in roots:
            if not any(abs(root.conjugate() - other) <= _SAME_POLE * abs(root) for other in roots):
                raise ValueError(f"{root} rad/s has no complex conjugate")
    for index, pole in enumerate(chain.poles):
        if not pole.real < 0:
            raise ValueError(f"unstable: pole at {pole} rad/s")
        for other in chain.poles[:index]:
            if abs(pole - other) <= CLOSEST_POLES * abs(pole):
                raise ValueError(f"repeated pole near {pole} rad/s: partial fractions need simple")


def _upper(poles: Sequence[complex]) -> list[complex]:
    """Return the real poles and the upper one of each conjugate pair."""
    return [complex(pole) for pole in poles if pole.imag >= 0]


def _union(chains: Sequence[Sequence[complex]]) -> list[complex]:
    """Return every pole once. Raises ValueError for poles of two chains that are nearly equal."""
    union: list[complex] = []
    for pole in (pole for chain in chains for pole in chain):
        nearest = min((abs(pole - other) for other in union), default=math.inf)
        if nearest <= _SAME_POLE * abs(pole):
            continue
        if nearest <= CLOSEST_POLES * abs(pole):
            raise ValueError(f"two outputs have nearly equal poles near {pole} rad/s")
        union.append(pole)
    return union


def _residue(chain: ZeroPoleGain, pole: complex) -> complex:
    """Return the residue at a simple pole. Numerator and denominator factors alternate, to avoid
    overflow."""
    others = list(chain.poles)
    others.remove(min(others, key=lambda other: abs(other - pole)))
    value = complex(chain.gain)
    for index, other in enumerate(others):
        if index < len(chain.zeros):
            value *= pole - chain.zeros[index]
        value /= pole - other
    for zero in chain.zeros[len(others) :]:
        value *= pole - zero
    return value


def _sum_of_exponentials(rates: Complexes, weights: Complexes, t: Reals) -> Reals:
    """Return Re(weights @ exp(rates t)), transposed: (len(t), n_outputs)."""
    step = _even_step(t)
    if step is None:
        return (weights @ _exp(rates[:, None] * t)).real.T
    stacks = -(-t.size // (_BLOCK * _STACK))
    starts = t[0] + step * _BLOCK * np.arange(stacks * _STACK)
    start_table = _exp(_reduced(rates, starts))
    block_table = _exp(rates[:, None] * (step * np.arange(_BLOCK)))
    right = np.concatenate([block_table.real, -block_table.imag])
    outputs = np.empty((t.size, len(weights)))
    for row, weight in enumerate(weights):
        left = weight[:, None] * start_table
        left_rows = np.concatenate([left.real, left.imag]).T.reshape(stacks, _STACK, -1)
        outputs[:, row] = (left_rows @ right).reshape(-1)[: t.size]
    return outputs


def _even_step(t: Reals) -> float | None:
    """Return the spacing if the times are an even grid to their own rounding, else None."""
    if t.ndim != 1 or t.size < _SMALLEST_GRID:
        return None
    step = float(t[-1] - t[0]) / (t.size - 1)
    if step <= 0:
        return None
    rounding = 4 * np.finfo(float).eps * max(abs(float(t[0])), abs(float(t[-1])))
    even = np.abs(t - (t[0] + step * np.arange(t.size))).max() <= rounding
    return step if even else None


def _reduced(rates: Complexes, t: Reals) -> Complexes:
    """Return ``rates`` times ``t`` with whole turns of the imaginary part removed."""
    turns = rates.imag[:, None] / (2 * np.pi) * t
    return rates.real[:, None] * t + 2j * np.pi * (turns - np.floor(turns))


def _exp(exponents: Complexes) -> Complexes:
    """Return the exponential, exactly 0 below 1e-65: products with denormal numbers are slow."""
    return np.where(exponents.real > _VANISHED, np.exp(exponents), 0)
