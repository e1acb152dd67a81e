"""Causal filters of finite impulse response: low-pass design, minimum phase, and decimation.

Every output of `StreamingFir` is one dot product of the taps with the latest samples, always summed
in the same order. The output therefore does not depend on how the input was cut into blocks, to the
last bit.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]

SMALLEST = 1e-7
"""Smallest magnitude used in the cepstrum, relative to the largest: zeros on the unit circle have
no logarithm."""
FINENESS, FEWEST_POINTS = 64, 1 << 16
"""Points of the cepstrum per tap, and their least number. The cepstrum folds back onto itself; with
this many points that changes the response by at most 1e-6."""


def kaiser_shape(stop_dB: float) -> float:
    """Return β of Kaiser's window for a stop-band attenuation in dB (Kaiser 1974).

    >>> round(kaiser_shape(60.0), 2)
    5.65
    """
    if stop_dB > 50:
        return 0.1102 * (stop_dB - 8.7)
    above = max(stop_dB - 21, 0.0)
    return 0.5842 * math.pow(above, 0.4) + 0.07886 * above


def kaiser_low_pass(pass_Hz: float, stop_Hz: float, stop_dB: float, rate_Hz: float) -> Reals:
    """Return the linear-phase taps (n,), n odd, of a low-pass filter with gain 1 at 0 Hz.

    The gain is flat up to `pass_Hz` and `stop_dB` down from `stop_Hz` on. Length and shape of the
    window follow Kaiser's formulas (Kaiser 1974), which are accurate to about 1 dB.
    """
    shape = kaiser_shape(stop_dB)
    transition = 2 * math.pi * (stop_Hz - pass_Hz) / rate_Hz
    half = math.ceil((stop_dB - 7.95) / (2.285 * transition) / 2)
    place = np.arange(-half, half + 1)
    turns = (pass_Hz + stop_Hz) / rate_Hz
    taps = np.sinc(turns * place) * np.kaiser(place.size, shape)
    unit_gain: Reals = taps / taps.sum()
    return unit_gain


def minimum_phase(taps: ArrayLike) -> Reals:
    """Return taps (n,) with the same magnitude response and the least possible delay.

    No zero of the result lies outside the unit circle. It is computed from the real cepstrum,
    folded onto its causal half (Oppenheim and Schafer, Discrete-Time Signal Processing, ch. 13).
    The gain at 0 Hz is 1.
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
    """Return the complex response (k,) of taps (n,) at frequencies (k,) in Hz."""
    given = np.asarray(taps, dtype=np.float64)
    turns = np.outer(np.atleast_1d(frequency_Hz), np.arange(given.size)) / rate_Hz
    response: Complexes = np.exp(-2j * np.pi * turns) @ given
    return response


class StreamingFir:
    """Filters `channels` channels alike and computes every `every`-th output only.

    Row k of all rows returned by `add` is the output after input row ``k * every``. The filter
    starts as if the first row had been present forever, so that it does not respond to an offset.
    """

    def __init__(self, taps: ArrayLike, channels: int, every: int = 1):
        self.taps: Reals = np.array(taps, dtype=np.float64)
        self.channels, self.every = channels, every
        self._backwards = np.ascontiguousarray(self.taps[::-1])
        self._latest: Reals | None = None
        """Latest rows (channels, n - 1), which the next outputs need."""
        self._rows = 0

    def add(self, samples: ArrayLike) -> Reals:
        """Filter further rows (n, channels) and return the outputs due, (m, channels); m may be
        0.

        Raises ValueError for rows of another shape.
        """
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
