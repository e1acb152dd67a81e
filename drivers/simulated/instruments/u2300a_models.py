"""Models of the U2300A family, and the codes in which they send volts.

Codes and volts, for a range R (source: the family's programmer's reference as a public driver
quotes it). 12-bit models send the code left-justified in an int16; with ``c = word >> 4``:

    bipolar   V = c * 2 R / (2**12 - 1)
    unipolar  V = c * R / (2**12 - 1) + R / 2

16-bit models send the code itself:

    bipolar   V = c / 32768 * R
    unipolar  V = (c / 65536 + 0.5) * R

A multiplexed unit converts one channel after the other: the k-th channel of a scan is k / (rate *
channels) late, or k / (largest aggregate rate) with ``ACQ:BURS ON``. The U254x convert together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

RANGES_12_BIT_V = (10.0, 5.0, 2.5, 2.0, 1.25, 1.0, 0.5, 0.25, 0.2, 0.05)
RANGES_16_BIT_V = (10.0, 5.0, 2.5, 1.25)


@dataclass(frozen=True)
class SimulatedDaqModel:
    """The differences between the units of the family."""

    bits: int
    channels: int
    single_rate_S_s: int
    """Largest rate with one channel in the scan."""
    aggregate_rate_S_s: int
    """Largest sum of the channels' rates with several."""
    ranges_V: tuple[float, ...]
    simultaneous: bool = False
    """Converts all channels together (UNCONFIRMED for the U254x); selected by ``ROUT:ENAB``."""

    def highest_rate(self, channels: int) -> int:
        """Return the largest rate per channel, in S/s, with `channels` channels in the scan."""
        if channels == 1 or self.simultaneous:
            return self.single_rate_S_s
        return self.aggregate_rate_S_s // channels

    def skew_s(self, channels: int, rate_S_s: int, burst: bool) -> tuple[float, ...]:
        """Return the delay of each channel of a scan after the first, in s."""
        if self.simultaneous:
            return (0.0,) * channels
        conversions_per_s = self.aggregate_rate_S_s if burst else rate_S_s * channels
        return tuple(position / conversions_per_s for position in range(channels))


MODELS: dict[str, SimulatedDaqModel] = {
    "U2331A": SimulatedDaqModel(12, 64, 3_000_000, 1_000_000, RANGES_12_BIT_V),
    "U2351A": SimulatedDaqModel(16, 16, 250_000, 250_000, RANGES_16_BIT_V),
    "U2352A": SimulatedDaqModel(16, 16, 250_000, 250_000, RANGES_16_BIT_V),
    "U2353A": SimulatedDaqModel(16, 16, 500_000, 500_000, RANGES_16_BIT_V),
    "U2354A": SimulatedDaqModel(16, 16, 500_000, 500_000, RANGES_16_BIT_V),
    "U2355A": SimulatedDaqModel(16, 64, 250_000, 250_000, RANGES_16_BIT_V),
    "U2356A": SimulatedDaqModel(16, 64, 500_000, 500_000, RANGES_16_BIT_V),
    "U2541A": SimulatedDaqModel(16, 4, 250_000, 1_000_000, RANGES_16_BIT_V, simultaneous=True),
    "U2542A": SimulatedDaqModel(16, 4, 500_000, 2_000_000, RANGES_16_BIT_V, simultaneous=True),
}


def codes_of_volts(
    volts: npt.NDArray[np.float64], range_V: float, polarity: str, bits: int
) -> npt.NDArray[np.int16]:
    """Return the volts, quantised and clipped at the rails, as the words that a unit sends, in the
    same shape.

    The module's docstring has the formulas.
    """
    steps = 2**bits - 1 if bits == 12 else 2**bits
    span = 2 * range_V if polarity == "BIP" else range_V
    middle = 0.0 if polarity == "BIP" else range_V / 2
    half = 2 ** (bits - 1)
    codes = np.clip(np.rint((volts - middle) * (steps / span)), -half, half - 1)
    return np.asarray(codes * 2 ** (16 - bits), dtype=np.int16)


def volts_of_codes(
    words: npt.NDArray[np.int16], range_V: float, polarity: str, bits: int
) -> npt.NDArray[np.float64]:
    """Return the volts that a client computes from the words, in the same shape: the inverse of
    `codes_of_volts`."""
    steps = 2**bits - 1 if bits == 12 else 2**bits
    span = 2 * range_V if polarity == "BIP" else range_V
    middle = 0.0 if polarity == "BIP" else range_V / 2
    codes = np.right_shift(words, 16 - bits).astype(np.float64)
    return np.asarray(codes * (span / steps) + middle)
