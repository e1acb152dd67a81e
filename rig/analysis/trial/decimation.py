"""Causal decimation from the rate of a data acquisition to 1000 Hz, sample by sample.

The converters of the bench have no anti-alias filter. The strips are therefore sampled at 10 to 50
kS/s and filtered here before every n-th sample is used. The filter has finite length (26 ms) and
minimum phase, with the magnitude of a Kaiser-windowed low-pass filter. Its stop band begins at 600
Hz, the lowest frequency that folds onto 400 Hz:

- 0 to 400 Hz pass within 0.001 dB, so that no ripple shapes a spectrum;
- everything from 600 Hz on is attenuated by 82 dB, so what folds onto 0 to 400 Hz is 82 dB down.
  What folds onto 400 to 500 Hz has passed the transition band and is not attenuated as much: do not
  trust anything there;
- the delay at low frequency is 2.1 to 2.2 ms (2.4 ms at 200 Hz, 4.4 ms at 400 Hz). `delay_s` is the
  group delay at 0 Hz, by which the centroid of any pulse is late; time stamps are corrected by it.

A linear-phase filter with the same bands has a delay of 13 ms, too long for a slip. Recursive
filters with the same bands are at best 0.3 ms faster, never completely forget, and do not give the
same bytes for every division of their input into blocks (decision 0035). A step overshoots by a
fifth, as it does in any filter this steep.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.detector.fir import StreamingFir, frequency_response, kaiser_low_pass, minimum_phase

Reals = NDArray[np.float64]
Complexes = NDArray[np.complex128]

DECIMATED_Hz = 1000.0
"""Output rate, in Hz, whatever the input rate."""
SLOWEST_Hz, FASTEST_Hz = 10_000.0, 50_000.0
"""Input rates that are accepted, in Hz."""
PASS_Hz = 400.0
"""End of the pass band, in Hz."""
STOP_Hz = 600.0
"""Beginning of the stop band, in Hz."""
STOP_dB = 83.0
"""Attenuation asked of the design, whose formulas are accurate to 1 dB."""


class Decimator:
    """Filters and decimates `channels` channels in blocks of any length.

    The output does not depend on the division into blocks, to the last bit. Row k of all rows that
    `add` returned lies at input row ``k * factor`` and shows what happened `delay_s` earlier. The
    filter starts as if the first row had been present forever.

    >>> decimator = Decimator(rate_Hz=10_000.0, channels=2)
    >>> decimator.add(np.zeros((25, 2))).shape
    (3, 2)
    >>> round(1e3 * decimator.delay_s, 2)  # ms
    2.14
    """

    def __init__(self, rate_Hz: float, channels: int = 2):
        """Begin a record. Raises ValueError for a rate that is not a whole multiple of
        `DECIMATED_Hz` between `SLOWEST_Hz` and `FASTEST_Hz`, and for fewer than one channel."""
        factor = round(rate_Hz / DECIMATED_Hz)
        if not SLOWEST_Hz <= rate_Hz <= FASTEST_Hz or abs(factor * DECIMATED_Hz - rate_Hz) > 1e-9:
            raise ValueError(
                f"rate_Hz {rate_Hz:g} Hz must be a whole multiple of {DECIMATED_Hz:g} Hz between "
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
        """Group delay at 0 Hz, in s: how late the centroid of a pulse appears."""
        taps = self._filter.taps
        return float(taps @ np.arange(taps.size)) / self.rate_Hz

    def add(self, samples: ArrayLike) -> Reals:
        """Filter further rows (n, channels) and return the outputs due, (m, channels); m may be
        0."""
        return self._filter.add(samples)

    def response(self, frequency_Hz: ArrayLike) -> Complexes:
        """Return the complex response at input frequencies below half the input rate.

        It has the shape of the frequencies in Hz.
        """
        return frequency_response(self._filter.taps, frequency_Hz, self.rate_Hz)

    def group_delay_s(self, frequency_Hz: ArrayLike) -> Reals:
        """Return how late a slowly modulated tone of these frequencies appears, within the pass
        band.

        It is in s and has the shape of the frequencies.
        """
        frequency = np.atleast_1d(np.asarray(frequency_Hz, dtype=np.float64))
        half = 0.05  # Hz on either side: the phase is smooth on this scale
        turned = self.response(frequency + half) / self.response(frequency - half)
        late: Reals = -np.angle(turned) / (4 * np.pi * half)
        return late
