"""Causal filters of finite impulse response: low-pass designs, minimum phase, and a decimator.

Every output of `StreamingFir` is one dot product of the taps with the latest samples, in one order
of summation, so that it gives the same bytes however its input was cut into blocks.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]

SMALLEST = 1e-7
"""Of the largest response: zeros on the unit circle have no logarithm."""
FINENESS, FEWEST_POINTS = 64, 1 << 16
"""Points of the cepstrum for each tap, and at least: it folds back onto itself, which then changes
the response by 1e-6 at most."""


def kaiser_shape(stop_dB: float) -> float:
    """β of Kaiser's window for an attenuation of the stop band (Kaiser 1974)."""
    if stop_dB > 50:
        return 0.1102 * (stop_dB - 8.7)
    above = max(stop_dB - 21, 0.0)
    return 0.5842 * math.pow(above, 0.4) + 0.07886 * above


def kaiser_low_pass(pass_Hz: float, stop_Hz: float, stop_dB: float, rate_Hz: float) -> Reals:
    """Linear-phase taps (n,), n odd, of gain 1 at 0 Hz: flat up to `pass_Hz`, `stop_dB` down from
    `stop_Hz` on. Kaiser's window and his formulas for its shape and length (Kaiser 1974)."""
    shape = kaiser_shape(stop_dB)
    transition = 2 * math.pi * (stop_Hz - pass_Hz) / rate_Hz
    half = math.ceil((stop_dB - 7.95) / (2.285 * transition) / 2)
    place = np.arange(-half, half + 1)
    turns = (pass_Hz + stop_Hz) / rate_Hz
    taps = np.sinc(turns * place) * np.kaiser(place.size, shape)
    unit_gain: Reals = taps / taps.sum()
    return unit_gain


def minimum_phase(taps: ArrayLike) -> Reals:
    """Taps (n,) of the same magnitude response with the least delay: no zero outside the circle.

    From the real cepstrum, folded onto its causal half (Oppenheim and Schafer, Discrete-Time Signal
    Processing, ch. 13); their gain at 0 Hz is 1.
    """
    given = np.asarray(taps, dtype=np.float64)
    points = max(FEWEST_POINTS, 1 << math.ceil(math.log2(FINENESS * given.size)))
    magnitude = np.abs(np.fft.rfft(given, points))
    cepstrum = np.fft.irfft(np.log(np.maximum(magnitude, SMALLEST * magnitude.max())), points)
    cepstrum[1 : points // 2] *= 2
    cepstrum[points // 2 + 1 :] = 0
    causal = np.fft.irfft(np.exp(np.fft.rfft(cepstrum)), points)[: given.size]
    unit_gain: Reals = causal / causal.sum()
    return unit_gain


def frequency_response(taps: ArrayLike, frequency_Hz: ArrayLike, rate_Hz: float) -> Complexes:
    """Complex response at frequencies (k,): (k,)."""
    given = np.asarray(taps, dtype=np.float64)
    turns = np.outer(np.atleast_1d(frequency_Hz), np.arange(given.size)) / rate_Hz
    response: Complexes = np.exp(-2j * np.pi * turns) @ given
    return response


class StreamingFir:
    """One filter for `channels` equal channels, of whose outputs every `every`-th is computed.

    Row k of all that `add` has returned is what is known after input row ``k * every``. It begins
    as if the first row had been there for ever.
    """

    def __init__(self, taps: ArrayLike, channels: int, every: int = 1):
        self.taps: Reals = np.array(taps, dtype=np.float64)
        self.channels, self.every = channels, every
        self._backwards = np.ascontiguousarray(self.taps[::-1])
        self._latest: Reals | None = None
        """(channels, n - 1): the rows before the next one."""
        self._rows = 0

    def add(self, samples: ArrayLike) -> Reals:
        """What is due after these further rows, (n, channels): (m, channels), m may be 0."""
        block = np.asarray(samples, dtype=np.float64)
        if block.ndim != 2 or block.shape[1] != self.channels:
            raise ValueError(f"samples of shape {block.shape} must be (n, {self.channels})")
        if not len(block):
            return np.empty((0, self.channels))
        length = self.taps.size
        if self._latest is None:
            self._latest = np.repeat(block[0][:, None], length - 1, axis=1)
        seen = np.concatenate([self._latest, block.T], axis=1)
        first = -self._rows % self.every
        due = range(first, len(block), self.every)
        out = np.empty((len(due), self.channels))
        for channel, row in enumerate(seen):
            out[:, channel] = [row[k : k + length].dot(self._backwards) for k in due]
        self._rows += len(block)
        self._latest = seen[:, seen.shape[1] - (length - 1) :]
        return out
