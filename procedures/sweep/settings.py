"""Settings of a sweep, the conditions of its points, and the constants that its modules share."""

from __future__ import annotations

import itertools
import math
from typing import Literal, NamedTuple

from pydantic import Field, field_validator, model_validator
from pydantic.config import JsonDict

from rig.analysis.verdict import Bounds
from rig.core.settings import Settings

CHANNELS = ("load_cell", "film")
HIGHEST_RATE_S_S = 500e3
"""Highest sampling rate: two channels of the slower DAQ that this was written for."""
LARGEST_SHARE_OF_PRELOAD = 0.8
"""Largest load as a fraction of the preload: a larger one could lift the indentor off the film
(paper 3.1 requires contact)."""
FEW_CYCLES = 2
"""Cycles of a record if they take no more than twice the shortest record."""
LISTEN_S = 0.5
"""Length of the record before anything vibrates."""
LISTEN_RECORDS = 2
"""Expected number of such records: a second one has the ranges that fit the first."""
LISTEN_SAMPLES = 16
"""Minimum number of samples of such a record: those of any record that a tone is fitted in."""
CYCLE_FRACTION = (math.sqrt(5) - 1) / 2
"""Fraction of a sample, the golden ratio, by which a cycle exceeds a whole number of samples. With
a whole number the converter would see the same few phases in every cycle: its rounding would then
be the same in each, which no record averages out and no residual shows."""
LONG_RECORD_S = 0.03
"""Length from which one record averages over all ringing and is enough; shorter ones take two."""


GRID_ONLY: JsonDict = {"not_with": "frequencies_Hz"}
"""Marks a field of the automatic grid; as an option it is refused with a list of frequencies."""


class SweepCondition(NamedTuple):
    """The condition of a point."""

    frequency_Hz: float
    load_N: float
    """Sinusoidal load, peak."""
    repeat: int = 1


class SweepSettings(Settings):
    """Settings of a sweep."""

    frequencies_Hz: tuple[float, ...] = ()
    """Frequencies to measure, ascending, e.g. 20,200,2kHz. Default: automatic grid from --lowest to
    --highest, refined around notches."""
    load_N: float = Field(default=1.0, gt=0, json_schema_extra={"not_with": "loads_N"})
    """Sinusoidal load, peak."""
    loads_N: tuple[float, ...] = ()
    """Several loads at each frequency, peak, instead of one."""
    preload_N: float = Field(default=25.0, gt=0)
    """Static force on the film."""
    load_tolerance_percent: float = Field(default=1.0, gt=0, le=50)
    """Largest deviation of the load of a recorded point from its set point."""
    target_error_dB: float = Field(default=0.05, gt=0, le=10)
    """Standard error of the gain at which the measurement of a point ends."""
    longest_point_s: float = Field(default=20.0, gt=0, le=600)
    """Longest time that a point may take."""
    lowest_Hz: float = Field(default=2.0, gt=0, json_schema_extra=GRID_ONLY)
    """First frequency of the grid."""
    highest_Hz: float = Field(default=20e3, gt=0, json_schema_extra=GRID_ONLY)
    """Last frequency of the grid."""
    coarse_per_decade: int = Field(default=10, ge=1, le=1000, json_schema_extra=GRID_ONLY)
    """Points per decade below --fine-from."""
    fine_from_Hz: float = Field(default=200.0, gt=0, json_schema_extra=GRID_ONLY)
    """Frequency at which the fine part of the grid begins."""
    fine_per_decade: int = Field(default=60, ge=1, le=1000, json_schema_extra=GRID_ONLY)
    """Points per decade from --fine-from on."""
    points_per_half_width: int = Field(default=6, ge=0, le=100, json_schema_extra=GRID_ONLY)
    """Further points within each half-width of a notch that the grid shows; 0 for none."""
    repeats: int = Field(default=1, ge=1, le=1000)
    """Number of measurements of each condition."""
    order: Literal["auto", "ascending", "descending", "random"] = "auto"
    """Order of the points. auto: a list in its own order, the grid from its high end, where records
    are short."""
    order_seed: int = Field(default=0, ge=0, json_schema_extra={"only_with": {"order": "random"}})
    """Seed of the random order."""
    settling_s: float = Field(default=0.0, ge=0, le=60)
    """Wait after a change of frequency, before records are compared."""
    shortest_record_s: float = Field(default=0.0065, gt=0, le=60)
    """Shortest length of a record."""
    samples_per_cycle: float = Field(
        default=20.0, ge=2.5, json_schema_extra={"not_with": "rate_S_s"}
    )
    """Minimum ratio of sampling rate to frequency. A fraction of a sample is added, so that no two
    cycles are sampled at the same phases."""
    slowest_rate_S_s: float = Field(default=64e3, gt=0, json_schema_extra={"not_with": "rate_S_s"})
    """Lowest sampling rate, which prevents aliasing of the front end's noise."""
    rate_S_s: float | None = Field(default=None, gt=0)
    """Fixed sampling rate for all points. Default: --samples-per-cycle times the frequency."""
    first_amplitude_V: float = Field(default=0.05, gt=0)
    """Generator amplitude, peak, at the beginning of a sweep."""
    slope_bound_dB_decade: float = Field(default=0.05, gt=0, le=20)
    """Largest deviation of a slope at which a statement about it holds: from 20 dB/decade over
    frequency, from 0 over load."""
    gain_bound_dB: float = Field(default=0.1, gt=0, le=20, json_schema_extra={"needs": "loads_N"})
    """Largest difference of the gains under two loads at which they are called equal."""
    mains_Hz: float = Field(default=50.0, ge=1 / LISTEN_S, le=1000)
    """Mains frequency, whose lines are fitted together with the tone."""

    @field_validator("frequencies_Hz", "loads_N")
    @classmethod
    def _ascending(cls, values: tuple[float, ...]) -> tuple[float, ...]:
        for value in values:
            if value <= 0:
                raise ValueError(f"{value:g} is not above 0")
        for lower, upper in itertools.pairwise(values):
            if upper <= lower:
                raise ValueError(f"{upper:g} follows {lower:g}; give each value once, ascending")
        return values

    @model_validator(mode="after")
    def _consistent(self) -> SweepSettings:
        if self.highest_Hz <= self.lowest_Hz:
            raise ValueError(
                f"lowest_Hz {self.lowest_Hz:g} Hz is not below highest_Hz {self.highest_Hz:g} Hz"
            )
        highest_Hz = max(self.frequencies_Hz, default=self.highest_Hz)
        if self.rate_S_s is not None and self.rate_S_s < 2.5 * highest_Hz:
            of = "" if self.frequencies_Hz else "highest_Hz "
            raise ValueError(
                f"rate_S_s {self.rate_S_s:g} 1/s is too slow for {of}{highest_Hz:g} Hz: at least "
                f"{2.5 * highest_Hz:g} 1/s is needed"
            )
        needed_S_s = max(2 * (self.mains_Hz + 1 / LISTEN_S), LISTEN_SAMPLES / LISTEN_S)
        if self.listen_rate_S_s < needed_S_s:
            name = "slowest_rate_S_s" if self.rate_S_s is None else "rate_S_s"
            raise ValueError(
                f"{name} {self.listen_rate_S_s:g} 1/s is too slow for mains_Hz {self.mains_Hz:g} "
                f"Hz: at least {needed_S_s:g} 1/s is needed"
            )
        return self

    @property
    def listen_rate_S_s(self) -> float:  # noqa: N802 - the unit keeps its capital
        """Sampling rate of the record before anything vibrates. It has to separate the mains from
        their image at the rate, which takes a beat within `LISTEN_S`."""
        return self.slowest_rate_S_s if self.rate_S_s is None else self.rate_S_s

    def rate_at(self, frequency_Hz: float) -> float:
        """Return the sampling rate for a frequency, in S/s."""
        if self.rate_S_s is not None:
            return self.rate_S_s
        wanted = max(self.slowest_rate_S_s, self.samples_per_cycle * frequency_Hz)
        spread = (math.ceil(wanted / frequency_Hz - CYCLE_FRACTION) + CYCLE_FRACTION) * frequency_Hz
        return min(spread, max(HIGHEST_RATE_S_S, 2.5 * frequency_Hz))

    def shortest_at(self, frequency_Hz: float) -> float:
        """Return the length of the shortest record at a frequency in s: one cycle, or a few short
        ones."""
        few = FEW_CYCLES / frequency_Hz
        return max(self.shortest_record_s, 1 / frequency_Hz, min(few, 2 * self.shortest_record_s))

    @property
    def bounds(self) -> Bounds:
        """Bounds of the verdicts on the slope in dB per decade and on the gain in dB."""
        return Bounds(self.slope_bound_dB_decade, self.gain_bound_dB)

    @property
    def levels_N(self) -> tuple[float, ...]:  # noqa: N802 - the unit keeps its capital
        """Peak loads in N that are applied at each frequency."""
        return self.loads_N or (self.load_N,)
