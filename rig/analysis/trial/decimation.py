"""From a data acquisition's rate down to 1000 Hz, causally, sample by sample.

The converters that the bench uses have no anti-alias filter, so the strips are sampled at 10 to
50 kS/s and filtered here before every n-th sample is kept. The filter is of finite length (26 ms)
and minimum phase, with the magnitude of a Kaiser-windowed low pass whose stop band begins at
600 Hz, the lowest frequency that folds onto 400 Hz:

- 0 to 400 Hz pass within 0.001 dB: no ripple shapes a spectrum;
- 82 dB are taken from everything from 600 Hz on, so what folds onto 0 to 400 Hz is 82 dB down. What
  folds onto 400 to 500 Hz has passed the transition and is not: nothing there is to be trusted;
- 2.1 to 2.2 ms of delay at low frequency (2.4 at 200 Hz, 4.4 at 400 Hz). `delay_s` is the group
  delay at 0 Hz, by which the centroid of any pulse is late; time stamps are corrected by it.

Linear phase in the same bands takes 13 ms, more than a slip may wait; recursive filters of the same
bands are 0.3 ms faster at best, never quite forget, and promise no equal bytes for every cut of
their input. A step overshoots by a fifth, as it does in any filter of this steepness.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.detector.fir import StreamingFir, frequency_response, kaiser_low_pass, minimum_phase

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]

RATE_Hz = 1000.0
"""What is made of every input rate."""
SLOWEST_Hz, FASTEST_Hz = 10_000.0, 50_000.0
PASS_Hz = 400.0
"""Up to here the response is flat."""
STOP_Hz = 600.0
"""From here on nothing passes."""
STOP_dB = 83.0
"""Asked of the design, whose formulas are good to 1 dB."""


class Decimator:
    """One filter for `channels` equal channels; blocks of any length, the same bytes for each cut.

    Row k of all that `add` has returned lies at input row ``k * factor``; what it shows happened
    `delay_s` earlier. It begins as if the first row had been there for ever. ValueError for a rate
    that is no whole multiple of 1000 Hz between 10 and 50 kHz.
    """

    def __init__(self, rate_Hz: float, channels: int = 2):
        factor = round(rate_Hz / RATE_Hz)
        if not SLOWEST_Hz <= rate_Hz <= FASTEST_Hz or abs(factor * RATE_Hz - rate_Hz) > 1e-9:
            raise ValueError(
                f"rate_Hz {rate_Hz:g} Hz must be a whole multiple of {RATE_Hz:g} Hz between "
                f"{SLOWEST_Hz:g} and {FASTEST_Hz:g} Hz"
            )
        if channels < 1:
            raise ValueError(f"channels {channels} must be at least 1")
        self.rate_Hz = float(rate_Hz)
        self.factor = factor
        taps = minimum_phase(kaiser_low_pass(PASS_Hz, STOP_Hz, STOP_dB, rate_Hz))
        self._filter = StreamingFir(taps, channels, factor)

    @property
    def delay_s(self) -> float:
        """Group delay at 0 Hz: how late the centroid of a pulse comes out."""
        taps = self._filter.taps
        return float(taps @ np.arange(taps.size)) / self.rate_Hz

    def add(self, samples: ArrayLike) -> Reals:
        """What is due after these further rows, (n, channels): (m, channels), m may be 0."""
        return self._filter.add(samples)

    def response(self, frequency_Hz: ArrayLike) -> Complexes:
        """Complex response at input frequencies below half the input rate."""
        return frequency_response(self._filter.taps, frequency_Hz, self.rate_Hz)

    def group_delay_s(self, frequency_Hz: ArrayLike) -> Reals:
        """How late a slowly modulated tone of these frequencies comes out, in the pass band."""
        frequency = np.atleast_1d(np.asarray(frequency_Hz, dtype=np.float64))
        half = 0.05  # Hz on either side: the phase is smooth on this scale
        turned = self.response(frequency + half) / self.response(frequency - half)
        late: Reals = -np.angle(turned) / (4 * np.pi * half)
        return late
