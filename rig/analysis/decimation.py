"""From a data acquisition's rate down to 1000 Hz, causally, sample by sample.

The converters that the bench uses have no anti-alias filter, so the strips are sampled at 10 to
50 kS/s and filtered here before every n-th sample is kept. The filter is an inverse Chebyshev of
order 14 whose stop band begins at 600 Hz, the lowest frequency that folds onto 400 Hz:

- 0 to 400 Hz pass within 0.01 dB, monotonically: no ripple shapes a spectrum;
- 82 dB are taken from everything from 600 Hz on, so what folds onto 0 to 400 Hz is 82 dB down. What
  folds onto 400 to 500 Hz has passed the transition and is not: nothing there is to be trusted;
- 1.9 ms of delay at low frequency (2.2 at 200 Hz, 4.3 at 400 Hz). `delay_s` is the group delay at
  0 Hz, by which the centroid of any pulse is late; time stamps are corrected by it.

Linear phase in the same bands takes 250 taps at 10 kS/s and 12.5 ms, more than a slip may wait. An
elliptic filter of order 8 meets the bands too, but has 2.0 ms at 0 Hz, 10 ms at 400 Hz, and rings
for longer; an analogue-like Butterworth of order 4 at 400 Hz is half as late and takes only 14 dB
at 600 Hz. A step overshoots by a fifth, as it does in any filter of this steepness.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]

RATE_Hz = 1000.0
"""What is made of every input rate."""
SLOWEST_Hz, FASTEST_Hz = 10_000.0, 50_000.0
PASS_Hz = 400.0
"""Up to here the response is flat."""
STOP_Hz = 600.0
"""From here on nothing passes."""
STOP_dB = 82.0
ORDER = 14


class Decimator:
    """One filter for `channels` equal channels; blocks of any length, the same bytes for each cut.

    Row k of all that `add` has returned lies at input row ``k * factor``; what it shows happened
    `delay_s` earlier. It begins as if the first row had been there for ever. ValueError for a rate
    that is no whole multiple of 1000 Hz between 10 and 50 kHz.
    """

    def __init__(self, rate_Hz: float, channels: int = 2):
        from scipy.signal import cheby2

        factor = round(rate_Hz / RATE_Hz)
        if not SLOWEST_Hz <= rate_Hz <= FASTEST_Hz or abs(factor * RATE_Hz - rate_Hz) > 1e-9:
            raise ValueError(
                f"rate_Hz {rate_Hz:g} Hz must be a whole multiple of {RATE_Hz:g} Hz between "
                f"{SLOWEST_Hz:g} and {FASTEST_Hz:g} Hz"
            )
        if channels < 1:
            raise ValueError(f"channels {channels} must be at least 1")
        self.rate_Hz = float(rate_Hz)
        self.channels = channels
        self.factor = factor
        self._sections: Reals = np.asarray(
            cheby2(ORDER, STOP_dB, STOP_Hz, fs=rate_Hz, output="sos")
        )
        self._state: Reals | None = None
        self._rows = 0

    @property
    def delay_s(self) -> float:
        """Group delay at 0 Hz: how late the centroid of a pulse comes out."""
        k = np.arange(3.0)
        zeros, poles = self._sections[:, :3], self._sections[:, 3:]
        late = (zeros @ k) / zeros.sum(axis=1) - (poles @ k) / poles.sum(axis=1)
        return float(late.sum()) / self.rate_Hz

    def add(self, samples: ArrayLike) -> Reals:
        """What is due after these further rows, (n, channels): (m, channels), m may be 0."""
        from scipy.signal import sosfilt, sosfilt_zi

        block = np.asarray(samples, dtype=np.float64)
        if block.ndim != 2 or block.shape[1] != self.channels:
            raise ValueError(f"samples of shape {block.shape} must be (n, {self.channels})")
        if not len(block):
            return np.empty((0, self.channels))
        if self._state is None:
            self._state = sosfilt_zi(self._sections)[:, :, None] * block[0]
        filtered, self._state = sosfilt(self._sections, block, axis=0, zi=self._state)
        first = -self._rows % self.factor
        self._rows += len(block)
        kept: Reals = np.ascontiguousarray(filtered[first :: self.factor])
        return kept

    def response(self, frequency_Hz: ArrayLike) -> Complexes:
        """Complex response at input frequencies below half the input rate."""
        from scipy.signal import freqz_sos

        _, response = freqz_sos(self._sections, np.atleast_1d(frequency_Hz), fs=self.rate_Hz)
        values: Complexes = np.asarray(response, dtype=np.complex128)
        return values

    def group_delay_s(self, frequency_Hz: ArrayLike) -> Reals:
        """How late a slowly modulated tone of these frequencies comes out, in the pass band."""
        frequency = np.atleast_1d(np.asarray(frequency_Hz, dtype=np.float64))
        half = 0.05  # Hz on either side: the phase is smooth on this scale
        turned = self.response(frequency + half) / self.response(frequency - half)
        late: Reals = -np.angle(turned) / (4 * np.pi * half)
        return late
