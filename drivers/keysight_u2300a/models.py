"""The models of the U2300A and U2500A series, by their data sheet."""

from __future__ import annotations

from dataclasses import dataclass

WIDE_RANGES_V = (10.0, 5.0, 2.5, 1.25)
"""Bipolar full scales of all models but the U2331A."""


@dataclass(frozen=True)
class U2300AModel:
    """One model's data from the data sheet."""

    bits: int
    """Resolution; 12-bit codes stand left-justified in 16-bit words."""
    total_rate_S_s: float
    """Highest rate of one channel, or of all scanned channels together."""
    simultaneous: bool
    """True if all channels are sampled together, false if one converter scans them."""
    ranges_V: tuple[float, ...] = WIDE_RANGES_V
    """Bipolar full scales."""
    terminals: int = 64
    """Number of analogue inputs, which are numbered from 101."""


MODELS: dict[str, U2300AModel] = {
    "U2331A": U2300AModel(12, 1e6, False, (10, 5, 2.5, 2, 1.25, 1, 0.5, 0.25, 0.2, 0.05)),
    "U2351A": U2300AModel(16, 250e3, False, terminals=16),
    "U2352A": U2300AModel(16, 250e3, False, terminals=16),
    "U2353A": U2300AModel(16, 500e3, False, terminals=16),
    "U2354A": U2300AModel(16, 500e3, False, terminals=16),
    "U2355A": U2300AModel(16, 250e3, False),
    "U2356A": U2300AModel(16, 500e3, False),
    "U2541A": U2300AModel(16, 250e3, True, terminals=4),
    "U2542A": U2300AModel(16, 500e3, True, terminals=4),  # simultaneous sampling is unconfirmed
}
