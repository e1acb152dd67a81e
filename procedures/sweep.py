"""Frequency response of a PVDF film in its clamp, volts per newton, 2 to 20000 Hz.

The paper's section 3.2 in its first form: the vibrator is driven with one generator amplitude. At
each frequency the load cell and the film are sampled together, a sine is fitted to both, and their
ratio is the film's complex response in V/N.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pydantic import Field, field_validator, model_validator

from procedures import sweep_layout
from procedures.sweep_layout import reading_of
from rig.bench import Fixture
from rig.errors import InstrumentError
from rig.instruments import Acquisition, InputChannel, Record
from rig.runner.points import Move, Point, Reading
from rig.runner.procedure import StreamPlan
from rig.runner.trip import TripError
from rig.settings import Settings as BaseSettings

if TYPE_CHECKING:
    from rig.analysis.sine_fit import SineFit
    from rig.runner.run import Run

NAME = "sweep"
FIXTURES: tuple[Fixture, ...] = ("film-clamp",)
FIGURE = "sweep"
LAYOUT = sweep_layout.LAYOUT
STREAMS = (StreamPlan("waveform", "daq", ("load_cell", "film"), "Load cell and film, raw counts"),)

HIGHEST_RATE_S_S = 500e3
"""Two channels of the slower of the DAQs this was written for."""
NO_SIGNAL_ERRORS = 5.0
"""A film whose amplitude is below this many standard errors gives no signal."""


MAINS_DISTANCE = 0.02
"""How far the default grid keeps away from the first mains lines, relative: a record of about a
second then separates the two."""


def default_grid() -> tuple[float, ...]:
    """10 frequencies a decade from 2 to 200 Hz, then 60: the drops are narrower than a coarse
    grid's step. In Hz, rounded to what a name can carry, beside the lines of a 50 Hz mains."""
    coarse = [2 * 10 ** (k / 10) for k in range(21)]
    fine = [200 * 10 ** (k / 60) for k in range(1, 121)]
    return tuple(float(f"{_beside_mains(frequency):.6g}") for frequency in (*coarse, *fine))


def _beside_mains(frequency: float, mains: float = 50.0, lines: int = 5) -> float:
    line = mains * min(max(round(frequency / mains), 1), lines)
    if abs(frequency / line - 1) >= MAINS_DISTANCE:
        return frequency
    return line * (1 + math.copysign(MAINS_DISTANCE, frequency - line))


class Settings(BaseSettings):
    """What a sweep can be told."""

    frequencies_Hz: tuple[float, ...] = Field(default_factory=default_grid)
    """Frequencies in ascending order."""
    amplitude_V: float = Field(default=0.7, gt=0)
    """Generator amplitude, peak; about 1 N of load at mid band on the simulated bench."""
    settling_s: float = Field(default=0.2, ge=0, le=60)
    """Wait after a change of frequency: the slowest mechanical response has died away."""
    cycles: int = Field(default=4, ge=1, le=100_000)
    """Whole cycles in a record, at least."""
    shortest_record_s: float = Field(default=0.1, gt=0, le=60)
    """Length of a record, at least."""
    longest_record_s: float = Field(default=20.0, gt=0, le=600)
    """Length of a record, at most, where a mains line close by asks for a longer one."""
    samples_per_cycle: float = Field(default=20.0, ge=2.5)
    """The sampling rate follows the frequency by this factor."""
    slowest_rate_S_s: float = Field(default=50e3, gt=0)
    """Sampling rate, at least: it keeps the front end's noise from folding."""
    rate_S_s: float | None = Field(default=None, gt=0)
    """One sampling rate for all points, in place of one that follows the frequency."""
    load_range_V: float = Field(default=1.25, gt=0)
    """Input range for the load cell."""
    film_range_V: float = Field(default=1.25, gt=0)
    """Input range for the film."""
    mains_Hz: float = Field(default=50.0, gt=0)
    """Mains frequency, whose lines are fitted beside the tone."""

    @field_validator("frequencies_Hz")
    @classmethod
    def _ascending(cls, frequencies: tuple[float, ...]) -> tuple[float, ...]:
        if not frequencies:
            raise ValueError("there is no frequency; give at least one")
        for frequency in frequencies:
            if frequency <= 0:
                raise ValueError(f"{frequency:g} Hz is not above 0 Hz")
        for lower, upper in itertools.pairwise(frequencies):
            if upper <= lower:
                raise ValueError(
                    f"{upper:g} Hz follows {lower:g} Hz; give each frequency once, ascending"
                )
        return frequencies

    @model_validator(mode="after")
    def _rate_carries_the_frequencies(self) -> Settings:
        for frequency in self.frequencies_Hz:
            if self.rate_at(frequency) < 2.5 * frequency:
                raise ValueError(
                    f"a rate of {self.rate_at(frequency):g} S/s cannot carry {frequency:g} Hz; "
                    f"sample at {2.5 * frequency:g} S/s or more"
                )
        return self

    def rate_at(self, frequency_Hz: float) -> float:
        """Sampling rate for a frequency, S/s."""
        if self.rate_S_s is not None:
            return self.rate_S_s
        wanted = max(self.slowest_rate_S_s, self.samples_per_cycle * frequency_Hz)
        return min(wanted, max(HIGHEST_RATE_S_S, 2.5 * frequency_Hz))


def points(settings: Settings) -> tuple[Point, ...]:
    """One point a frequency."""
    return tuple(_point(settings, frequency) for frequency in settings.frequencies_Hz)


def arm(run: Run) -> None:
    """The vibrator runs at the first frequency; its off is known before it is on."""
    generator = run.bench.generator
    run.arm("generator output", generator.make_safe)
    generator.sine(run.settings.frequencies_Hz[0], run.settings.amplitude_V)
    generator.output(True)


def take(run: Run, point: Point) -> Reading:
    """Set the frequency, let it settle, sample both channels, fit."""
    from rig.analysis.response import complex_response

    run.bench.generator.sine(point.condition, run.settings.amplitude_V)
    run.clock.sleep(run.settings.settling_s)
    record = run.bench.daq.acquire(point.acquisitions[0])
    run.emit("waveform", record)

    refuse_saturation(record, point.condition)
    load = fit(run, record, "load_cell", point.condition, run.bench.load_cell.sensitivity_V_N)
    voltage = fit(run, record, "film", point.condition, 1.0)
    refuse_overload(run, load)
    refuse_silence(voltage)

    return reading_of(complex_response(voltage, load), load, voltage, run.elapsed_s())


def summarise(settings: Settings, readings: Sequence[Reading]) -> Mapping[str, Any]:
    """Range, typical gain, and how well it is known."""
    if not readings:
        return {"points": 0}
    frequencies = [float(r["frequency_Hz"] or 0) for r in readings]
    errors = sorted(float(r["gain_standard_error_dB"] or 0) for r in readings)
    middle = min(readings, key=lambda r: abs(math.log(float(r["frequency_Hz"] or 1) / 200)))
    return {
        "points": len(readings),
        "lowest_frequency_Hz": min(frequencies),
        "highest_frequency_Hz": max(frequencies),
        "gain_near_200_Hz_dB": middle["gain_dB"],
        "gain_near_200_Hz_at_Hz": middle["frequency_Hz"],
        "median_gain_standard_error_dB": errors[len(errors) // 2],
        "largest_gain_standard_error_dB": errors[-1],
    }


def fit(run: Run, record: Record, channel: str, frequency: float, volts_per_unit: float) -> SineFit:
    """The tone in one channel, in units of `volts_per_unit`; mains lines fitted beside it."""
    from rig.analysis.sine_fit import fit_sine, mains_lines

    found = fit_sine(
        record.volts(channel) / volts_per_unit,
        record.scaling.rate_S_s,
        frequency,
        interference=mains_lines(run.settings.mains_Hz),
        delay_s=record.delay_s(channel),
    )
    for line in found.unresolved_Hz:
        run.event(
            "warning",
            "mains",
            f"{frequency:g} Hz is too close to the mains line at {line:g} Hz for a record of "
            f"{found.n / found.rate_Hz:.3g} s: what the mains adds cannot be told from the signal",
        )
    return found


def refuse_saturation(record: Record, frequency: float) -> None:
    """A clipped sine fits beautifully and wrongly."""
    for channel, range_V in zip(record.scaling.channels, record.scaling.range_V, strict=True):
        if clipped := record.clipped(channel):
            raise InstrumentError(
                "daq",
                f"channel {channel} at {frequency:g} Hz",
                f"{clipped} of {len(record.counts)} samples are at the end of the "
                f"{range_V:g} V range",
                "choose a larger range or a smaller amplitude",
            )


def refuse_overload(run: Run, load: SineFit) -> None:
    """The load may not exceed what film and cell stand."""
    limit = run.bench.load_cell.max_load_N
    if load.amplitude > limit:
        raise TripError(
            f"load {load.amplitude:.3g} N at {load.frequency_Hz:g} Hz is over the limit of "
            f"{limit:g} N of the load cell",
            "choose a smaller amplitude",
        )


def refuse_silence(voltage: SineFit) -> None:
    """A film that is torn, unclamped or not connected gives noise."""
    if voltage.amplitude < NO_SIGNAL_ERRORS * voltage.standard_error:
        raise InstrumentError(
            "film",
            f"signal at {voltage.frequency_Hz:g} Hz",
            f"{voltage.amplitude:.2g} V with a standard error of {voltage.standard_error:.2g} V "
            "is no more than noise",
            "check that the film is clamped, whole and connected to its amplifier",
        )


def _point(settings: Settings, frequency: float) -> Point:
    from rig.analysis.sine_fit import mains_lines, record_length

    rate = settings.rate_at(frequency)
    samples = record_length(
        frequency,
        rate,
        max(settings.shortest_record_s, settings.cycles / frequency),
        interference=mains_lines(settings.mains_Hz),
        maximum_duration=max(settings.longest_record_s, settings.cycles / frequency),
    )
    channels = (
        InputChannel("load_cell", settings.load_range_V),
        InputChannel("film", settings.film_range_V),
    )
    return Point(
        id=f"{frequency:.9g}Hz",
        condition=frequency,
        moves=(
            Move("generator.frequency", frequency),
            Move("generator.amplitude", settings.amplitude_V),
        ),
        acquisitions=(Acquisition(channels, rate, samples),),
        duration_s=settings.settling_s + samples / rate,
    )
