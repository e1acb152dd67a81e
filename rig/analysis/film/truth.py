"""What a simulated bench put into its film, with which an analysis states what it recovered.

On a simulated bench no number of a film is a finding about films: it was put in by the World, and a
sweep shows only that it is recovered. Nothing here is used by the analysis itself.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

NEAR = 1.05
"""Ratio of the frequencies of a found and a true notch up to which they are the same notch."""


@dataclass(frozen=True)
class FilmTruth:
    """The true values of the film of a simulated bench, for comparison with what an analysis
    finds."""

    level_dB: float
    """Level b, in dB re 1 V/N at 1 Hz, at the nominal preload."""
    corner_Hz: float
    """Frequency of the pole."""
    drops_Hz: tuple[float, ...]
    """Frequencies of the notches."""
    gain_per_newton_dB: float
    """Change of the gain with the preload."""
    gain_per_load_decade_dB: float
    """Change of the gain by decade of load."""

    @classmethod
    def of(cls, account: str | None) -> FilmTruth | None:
        """Return the film in a reading's ``simulated_truth``, or None if it has none."""
        film: dict[str, Any] | None = json.loads(account).get("film") if account else None
        if film is None:
            return None
        return cls(**{**film, "drops_Hz": tuple(film["drops_Hz"])})

    def drop_near_Hz(self, frequency_Hz: float) -> float | None:  # noqa: N802
        """Return the frequency of the notch that was found at ``frequency_Hz``, or None if the
        film has none there."""
        nearest = min(
            self.drops_Hz, key=lambda drop: abs(drop - frequency_Hz), default=float("inf")
        )
        return nearest if 1 / NEAR < frequency_Hz / nearest < NEAR else None
