"""Chooses the frequencies of a sweep: a scan of the whole range, then more points in the notches
found.

Both plans of a run are pure functions: the scan depends on settings alone, the refinement on
settings and the response that the scan measured. A grid of 10 per decade would step over the
notches (paper 3.2 (iii)). Frequencies are rounded to six figures, ascending, and the same on every
machine.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Self

import numpy as np
from pydantic import Field, model_validator

from rig.analysis.film.drops import fit_with_drops
from rig.analysis.response.complex_response import Reals
from rig.analysis.response.curve import ResponseCurve
from rig.core.settings import Settings

MAINS_LINES = 5
"""Number of mains harmonics that the scan avoids."""

PAPER_NOTCHES = ((500.0, 10.0), (2400.0, 10.0), (9000.0, 10.0))
"""Notches that are expected of a film before its scan: frequencies in Hz as the paper reports them
(3.2), and Q in the middle of its assumed range."""

_SAME_FREQUENCY = 1e-6


class FrequencyPlanSettings(Settings):
    """Grid of a sweep. The defaults are the paper's range at the resolution of the bench."""

    lowest_Hz: float = Field(default=2.0, gt=0)
    """First frequency of the scan."""
    highest_Hz: float = Field(default=20e3, gt=0)
    """Last frequency of the scan."""
    coarse_per_decade: int = Field(default=10, ge=1, le=1000)
    """Points per decade in the coarse part of the scan, where no notch is expected."""
    fine_from_Hz: float = Field(default=200.0, gt=0)
    """Frequency from which the scan is fine."""
    fine_per_decade: int = Field(default=60, ge=1, le=1000)
    """Points per decade in the fine part of the scan: 60 put two within the full width of a notch
    of Q 10."""
    points_per_half_width: int = Field(default=6, ge=1, le=100)
    """Points that the refinement puts into each half-width of a notch."""
    mains_Hz: float = Field(default=50.0, gt=0)
    """Mains frequency."""
    mains_distance: float = Field(default=0.06, ge=0, lt=0.5)
    """Relative distance that the scan keeps from the first mains lines, but never more than half a
    step. With 6 %, a record of a third of a second separates tone and mains."""

    @model_validator(mode="after")
    def _has_a_range(self) -> Self:
        if self.highest_Hz <= self.lowest_Hz:
            raise ValueError(
                f"lowest_Hz {self.lowest_Hz:g} Hz is not below highest_Hz {self.highest_Hz:g} Hz"
            )
        return self


def scan_frequencies_Hz(settings: FrequencyPlanSettings) -> tuple[float, ...]:  # noqa: N802
    """Return the frequencies of the scan: coarse up to ``fine_from_Hz``, fine above, clear of
    mains lines.

    >>> plan = FrequencyPlanSettings(lowest_Hz=10, highest_Hz=100, coarse_per_decade=4)
    >>> scan_frequencies_Hz(plan)  # 100 Hz is a mains line: 2 % below it is measured instead
    (10.0, 17.7828, 31.6228, 56.2341, 98.0439)
    """
    low, high = settings.lowest_Hz, settings.highest_Hz
    change = min(max(settings.fine_from_Hz, low), high)
    coarse = _geometric(low, change, settings.coarse_per_decade)[:-1]
    fine = _geometric(change, high, settings.fine_per_decade) if change < high else [high]
    moved = {_beside_mains(f, settings, settings.coarse_per_decade) for f in coarse}
    moved |= {_beside_mains(f, settings, settings.fine_per_decade) for f in fine}
    return tuple(sorted({_rounded(f) for f in moved}))


def refine_Hz(settings: FrequencyPlanSettings, scanned: ResponseCurve) -> tuple[float, ...]:  # noqa: N802
    """Return the frequencies to measure after a scan: points within each half-width of each notch
    found.

    For every notch these are its centre and ``points_per_half_width`` on either side, out to where
    its poles pass half of their power (about f / (2 Q)), evenly spaced in the detuning Q (x - 1/x).
    Frequencies outside the scanned range are omitted, and so are those within a quarter of a step
    of one scanned or already chosen. The result is empty if the scan shows no notch.

    Raises CurveError, as ``fit_with_drops`` does, if the scan is too short or too narrow.
    """
    notches = [(one.frequency_Hz, one.pole_Q) for one in fit_with_drops(scanned).model.notches]
    return _in_notches(settings, notches, scanned.frequencies)


def expected_refinement_Hz(settings: FrequencyPlanSettings) -> tuple[float, ...]:  # noqa: N802
    """Return what `refine_Hz` finds after the scan of a film with the notches of the paper's, for
    estimates of time."""
    scan = np.array(scan_frequencies_Hz(settings))
    inside = [one for one in PAPER_NOTCHES if scan[0] < one[0] < scan[-1]]
    return _in_notches(settings, inside, scan)


def _in_notches(
    settings: FrequencyPlanSettings, notches: Iterable[tuple[float, float]], scanned_Hz: Reals
) -> tuple[float, ...]:
    """Return the further frequencies in notches of these frequencies in Hz and Qs."""
    per_side = settings.points_per_half_width
    detuning = np.arange(-per_side, per_side + 1) / per_side
    taken: Reals = np.log(scanned_Hz)
    chosen: list[float] = []
    for centre_Hz, pole_Q in notches:
        steps = np.arcsinh(detuning / (2 * pole_Q))
        near = 0.25 * float(steps[-1] - steps[-2])
        for step in steps:
            frequency = _rounded(centre_Hz * math.exp(step))
            inside = scanned_Hz[0] <= frequency <= scanned_Hz[-1]
            if inside and np.abs(math.log(frequency) - taken).min() > near:
                chosen.append(frequency)
                taken = np.append(taken, math.log(frequency))
    return tuple(sorted(chosen))


def _geometric(low: float, high: float, per_decade: int) -> list[float]:
    """Return frequencies from ``low`` in equal ratios, without those at or above ``high``, then
    ``high``."""
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
