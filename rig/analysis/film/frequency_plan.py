"""Where a sweep measures: a scan over the whole range, then more points in the drops that it shows.

Two plans of one run, both pure: the scan from settings alone, the refinement from settings and the
response that the scan measured. A grid of 10 a decade would step over the drops (paper 3.2 (iii)).
Frequencies come rounded to six figures, ascending, the same on every machine.
"""

from __future__ import annotations

import math
from typing import Self

import numpy as np
from pydantic import Field, model_validator

from rig.analysis.film.drops import fit_with_drops
from rig.analysis.response.complex_response import Reals
from rig.analysis.response.curve import ResponseCurve
from rig.core.settings import Settings

MAINS_LINES = 5
"""Harmonics of the mains that the scan keeps away from."""

_SAME_FREQUENCY = 1e-6


class FrequencyPlanSettings(Settings):
    """The grid of a sweep; the defaults are the paper's range at the bench's resolution."""

    lowest_Hz: float = Field(default=2.0, gt=0)
    """First frequency of the scan."""
    highest_Hz: float = Field(default=20e3, gt=0)
    """Last frequency of the scan."""
    coarse_per_decade: int = Field(default=10, ge=1, le=1000)
    """Frequencies a decade below ``fine_from_Hz``, where no drop is expected."""
    fine_from_Hz: float = Field(default=200.0, gt=0)
    """Where the fine part of the scan begins."""
    fine_per_decade: int = Field(default=60, ge=1, le=1000)
    """Frequencies a decade from there on: two within the full width of a drop of Q 10."""
    points_per_half_width: int = Field(default=6, ge=1, le=100)
    """Frequencies that the refinement puts into each half-width of a drop."""
    mains_Hz: float = Field(default=50.0, gt=0)
    """Mains frequency."""
    mains_distance: float = Field(default=0.06, ge=0, lt=0.5)
    """How far the scan keeps away from the first mains lines, relative, where half a step allows
    it: a record of a third of a second then separates the two."""

    @model_validator(mode="after")
    def _has_a_range(self) -> Self:
        if self.highest_Hz <= self.lowest_Hz:
            raise ValueError(
                f"highest_Hz {self.highest_Hz:g} is not above lowest_Hz {self.lowest_Hz:g}"
            )
        return self


def scan_frequencies_Hz(settings: FrequencyPlanSettings) -> tuple[float, ...]:  # noqa: N802
    """Coarse up to ``fine_from_Hz``, fine from there to ``highest_Hz``, beside the mains lines."""
    low, high = settings.lowest_Hz, settings.highest_Hz
    change = min(max(settings.fine_from_Hz, low), high)
    coarse = _geometric(low, change, settings.coarse_per_decade)[:-1]
    fine = _geometric(change, high, settings.fine_per_decade) if change < high else [high]
    moved = {_beside_mains(f, settings, settings.coarse_per_decade) for f in coarse}
    moved |= {_beside_mains(f, settings, settings.fine_per_decade) for f in fine}
    return tuple(sorted({_rounded(f) for f in moved}))


def refine_Hz(settings: FrequencyPlanSettings, scanned: ResponseCurve) -> tuple[float, ...]:  # noqa: N802
    """Frequencies to measure after a scan: so many within each half-width of each drop it shows.

    For every drop: its centre and ``points_per_half_width`` on either side, out to where its poles
    let half of their power through (about f / (2 Q)), evenly spaced in the detuning Q (x - 1/x);
    within the scanned range; less those within a quarter of a step of one scanned or already
    chosen. Empty where the scan shows no drop. Raises CurveError as ``fit_with_drops`` does, where
    the scan is too short or too narrow to show a trend.
    """
    per_side = settings.points_per_half_width
    detuning = np.arange(-per_side, per_side + 1) / per_side
    taken: Reals = np.log(scanned.frequencies)
    chosen: list[float] = []
    for notch in fit_with_drops(scanned).model.notches:
        steps = np.arcsinh(detuning / (2 * notch.pole_Q))
        near = 0.25 * float(steps[-1] - steps[-2])
        for step in steps:
            frequency = _rounded(notch.frequency_Hz * math.exp(step))
            inside = scanned.frequencies[0] <= frequency <= scanned.frequencies[-1]
            if inside and np.abs(math.log(frequency) - taken).min() > near:
                chosen.append(frequency)
                taken = np.append(taken, math.log(frequency))
    return tuple(sorted(chosen))


def _geometric(low: float, high: float, per_decade: int) -> list[float]:
    """From ``low`` on in equal ratios, less what comes to ``high`` or beyond, then ``high``."""
    steps = math.ceil(per_decade * math.log10(high / low) - _SAME_FREQUENCY)
    return [*(low * 10 ** (k / per_decade) for k in range(steps)), high]


def _beside_mains(frequency: float, settings: FrequencyPlanSettings, per_decade: int) -> float:
    distance = min(settings.mains_distance, (10 ** (1 / per_decade) - 1) / 2)
    order = min(max(round(frequency / settings.mains_Hz), 1), MAINS_LINES)
    line = settings.mains_Hz * order
    if abs(frequency / line - 1) >= distance:
        return frequency
    below, above = line * (1 - distance), line * (1 + distance)
    nearest_first = (above, below) if frequency >= line else (below, above)
    inside = (f for f in nearest_first if settings.lowest_Hz <= f <= settings.highest_Hz)
    return next(inside, frequency)


def _rounded(frequency: float) -> float:
    return float(f"{frequency:.6g}")
