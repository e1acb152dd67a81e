"""Frequency response of a PVDF film in its clamp, volts per newton, 2 to 20000 Hz.

The paper's chapter 3: the film is preloaded, a vibrator adds a sinusoidal load, and at each
frequency load cell and film are sampled together. A sine is fitted to both; their ratio is the
film's complex response. The load is held constant over frequency ("data1"), or takes several
levels at each ("data2", paper 3.2). After a scan of the whole range come further points in the
drops that it shows.

A point is taken in `procedures.sweep.point`, a record in `procedures.sweep.sampling`; what is
carried from one point to the next is in `procedures.sweep.memory`.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from pydantic import Field, field_validator, model_validator

from procedures.pressed import contact
from procedures.pressed.contact import contact_range_mm
from procedures.sweep import layout as sweep_layout
from procedures.sweep import preload
from rig.bench.bench import Fixture, FixtureSettings
from rig.core.settings import Settings as BaseSettings
from rig.instruments.roles import Acquisition, InputChannel
from rig.run.points import Move, Point, Reading
from rig.run.procedure import DriftFigure, StreamPlan

if TYPE_CHECKING:
    from procedures.sweep.memory import Memory
    from rig.analysis.film.frequency_plan import FrequencyPlanSettings
    from rig.bench.bench import Bench
    from rig.run.context import Run

NAME = "sweep"
FIXTURES: tuple[Fixture, ...] = ("film-clamp",)
LAYOUT = sweep_layout.LAYOUT
CHANNELS = ("load_cell", "film")
DRIFT = {"gain_near_200_Hz_dB": DriftFigure("gain near 200 Hz", "film", 0.5)}
STREAMS = (StreamPlan("waveform", "daq", CHANNELS, "Load cell and film, raw counts"),)

HIGHEST_RATE_S_S = 500e3
"""Two channels of the slower of the DAQs this was written for."""
LARGEST_SHARE_OF_PRELOAD = 0.8
"""A larger load could lift the indentor off the film (paper 3.1 keeps it pressed)."""
FEW_CYCLES = 2
"""A record holds so many cycles where that costs no more than twice the shortest record."""
LISTEN_S = 0.5
"""Length of the record before anything vibrates."""
LISTENED = 2
"""How often it is expected to be taken: again on the ranges that the first one shows to fit."""

# --- what a point is expected to take, measured on the simulated film ---
QUIET_S_Hz2 = 9.0
"""Time at 1 Hz, falling with the square of the frequency, in which noise allows `QUIET_dB` at 1 N:
what the film gives rises with both."""
QUIET_dB = 0.05
LONG_RECORD_S = 0.03
"""A record that has to be as long averages over all ringing: one is enough, else it takes two."""
RINGS_BELOW_Hz, RINGS_S = 600.0, 0.03
"""Where ringing is waited for, and how long."""
KNOWN_WITHIN = 1.3
"""Ratio of two frequencies in a row beyond which the drive is not foretold well."""
LEVELLING_RECORDS, LEVELLING_S = 2.5, 0.03
"""What finding it takes then."""


class Condition(NamedTuple):
    """What a point is taken at."""

    frequency_Hz: float
    load_N: float
    """Peak."""
    repeat: int = 1


class Settings(BaseSettings):
    """What a sweep can be told."""

    frequencies_Hz: tuple[float, ...] = ()
    """Frequencies in ascending order; none for the grid, which is refined where drops are."""
    load_N: float = Field(default=1.0, gt=0)
    """Sinusoidal load, peak."""
    loads_N: tuple[float, ...] = ()
    """Several loads at each frequency, peak, in place of one."""
    preload_N: float = Field(default=25.0, gt=0)
    """Static force that the film is held under."""
    load_tolerance_percent: float = Field(default=1.0, gt=0, le=50)
    """How far the load of a kept point may be from the one asked for."""
    target_error_dB: float = Field(default=0.05, gt=0, le=10)
    """Standard error of the gain up to which a point is measured."""
    longest_point_s: float = Field(default=20.0, gt=0, le=600)
    """Time a point may take, at most."""
    lowest_Hz: float = Field(default=2.0, gt=0)
    """First frequency of the grid."""
    highest_Hz: float = Field(default=20e3, gt=0)
    """Last frequency of the grid."""
    coarse_per_decade: int = Field(default=10, ge=1, le=1000)
    """Frequencies a decade below fine_from_Hz."""
    fine_from_Hz: float = Field(default=200.0, gt=0)
    """Where the fine part of the grid begins."""
    fine_per_decade: int = Field(default=60, ge=1, le=1000)
    """Frequencies a decade from there on."""
    points_per_half_width: int = Field(default=6, ge=0, le=100)
    """Further points within each half-width of a drop that the grid shows; 0 for none."""
    repeats: int = Field(default=1, ge=1, le=1000)
    """How often each condition is measured."""
    order: Literal["auto", "ascending", "descending", "random"] = "auto"
    """Order of the points; auto takes a list as it is, and the grid from its high end, where
    records are short and cheap to learn from."""
    order_seed: int = Field(default=0, ge=0)
    """Seed of the random order."""
    settling_s: float = Field(default=0.0, ge=0, le=60)
    """Wait after a change of frequency, before records are compared."""
    shortest_record_s: float = Field(default=0.0065, gt=0, le=60)
    """Length of a record, at least."""
    samples_per_cycle: float = Field(default=20.0, ge=2.5)
    """The sampling rate follows the frequency by this factor."""
    slowest_rate_S_s: float = Field(default=64e3, gt=0)
    """Sampling rate, at least: it keeps the front end's noise from folding."""
    rate_S_s: float | None = Field(default=None, gt=0)
    """One sampling rate for all points, in place of one that follows the frequency."""
    first_amplitude_V: float = Field(default=0.05, gt=0)
    """Generator amplitude, peak, with which a sweep that knows nothing yet begins."""
    mains_Hz: float = Field(default=50.0, gt=0)
    """Mains frequency, whose lines are fitted beside the tone."""

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
    def _consistent(self) -> Settings:
        if self.highest_Hz <= self.lowest_Hz:
            raise ValueError(
                f"highest_Hz {self.highest_Hz:g} is not above lowest_Hz {self.lowest_Hz:g}"
            )
        for frequency in self.frequencies_Hz or (self.highest_Hz,):
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

    def shortest_at(self, frequency_Hz: float) -> float:
        """Shortest record at a frequency, s: one cycle at least, a few where they are short."""
        few = FEW_CYCLES / frequency_Hz
        return max(self.shortest_record_s, 1 / frequency_Hz, min(few, 2 * self.shortest_record_s))

    @property
    def levels_N(self) -> tuple[float, ...]:  # noqa: N802 - the unit keeps its capital
        """The loads at each frequency."""
        return self.loads_N or (self.load_N,)


# --- what will be done ------------------------------------------------------------------------


def points(settings: Settings) -> tuple[Point, ...]:
    """The first plan: the grid, or the frequencies asked for, each at every load."""
    preload.refuse_impossible(settings.preload_N, max(settings.levels_N), LARGEST_SHARE_OF_PRELOAD)
    frequencies = settings.frequencies_Hz
    if not frequencies:
        from rig.analysis.film.frequency_plan import scan_frequencies_Hz

        frequencies = scan_frequencies_Hz(_grid(settings))
    return _points_at(settings, frequencies)


def refine(settings: Settings, readings: Sequence[Reading]) -> tuple[Point, ...]:
    """The second plan: further frequencies in the drops that the grid has shown."""
    if settings.frequencies_Hz or not settings.points_per_half_width:
        return ()
    from procedures.sweep.summary import curve_of
    from rig.analysis.film.frequency_plan import refine_Hz
    from rig.analysis.response.curve import CurveError

    grid = {point.id for point in points(settings)}
    scanned = [reading for reading in readings if _id_of(reading) in grid]
    try:
        return _points_at(settings, refine_Hz(_grid(settings), curve_of(scanned)))
    except CurveError:  # too short or too narrow a grid shows no drop
        return ()


def overhead_s(settings: Settings, fixture: FixtureSettings, homed: bool) -> float:
    """Bench time that preloading, listening and parking are expected to take."""
    return preload.duration_s(fixture, settings.preload_N, homed) + LISTENED * LISTEN_S


def check(settings: Settings, bench: Bench) -> None:
    """Refuse a fixture that does not say where contact has to be felt."""
    contact_range_mm(bench)


def _grid(settings: Settings) -> FrequencyPlanSettings:
    from rig.analysis.film.frequency_plan import FrequencyPlanSettings

    return FrequencyPlanSettings(
        lowest_Hz=settings.lowest_Hz,
        highest_Hz=settings.highest_Hz,
        coarse_per_decade=settings.coarse_per_decade,
        fine_from_Hz=settings.fine_from_Hz,
        fine_per_decade=settings.fine_per_decade,
        points_per_half_width=max(settings.points_per_half_width, 1),
        mains_Hz=settings.mains_Hz,
    )


def _points_at(settings: Settings, frequencies: Sequence[float]) -> tuple[Point, ...]:
    conditions = [
        Condition(frequency, load, repeat)
        for repeat in range(1, settings.repeats + 1)
        for frequency in frequencies
        for load in settings.levels_N
    ]
    order = settings.order
    if order == "auto":
        order = "ascending" if settings.frequencies_Hz else "descending"
    if order == "descending":
        conditions.sort(key=lambda c: (c.repeat, -c.frequency_Hz, c.load_N))
    if order == "random":
        random.Random(settings.order_seed).shuffle(conditions)
    before = [None, *conditions]
    return tuple(
        _point(settings, condition, last)
        for condition, last in zip(conditions, before, strict=False)
    )


def _point(settings: Settings, condition: Condition, last: Condition | None) -> Point:
    from rig.analysis.response.sine_fit import whole_cycles

    frequency = condition.frequency_Hz
    rate = settings.rate_at(frequency)
    samples = whole_cycles(frequency, rate, settings.shortest_at(frequency))
    channels = tuple(InputChannel(name, 1.25) for name in CHANNELS)
    return Point(
        id=_name(condition),
        condition=condition,
        moves=(
            Move("generator.frequency", frequency),
            Move("generator.amplitude", settings.first_amplitude_V),
            Move("load_cell.load", condition.load_N),
            Move("force_sensor.force", settings.preload_N + condition.load_N),
        ),
        acquisitions=(Acquisition(channels, rate, samples),),
        duration_s=settings.settling_s + _expected_s(settings, condition, last, samples / rate),
    )


def _expected_s(
    settings: Settings, condition: Condition, last: Condition | None, record_s: float
) -> float:
    """Time that a point after `last` is expected to take with records of `record_s` at least."""
    quieter = QUIET_dB / (settings.target_error_dB * condition.load_N * condition.frequency_Hz)
    level_s = record_s if record_s >= LONG_RECORD_S else 2 * record_s
    expected_s = max(level_s, QUIET_S_Hz2 * quieter**2)
    if condition.frequency_Hz < RINGS_BELOW_Hz:
        expected_s += RINGS_S
    ratio = KNOWN_WITHIN if last is None else condition.frequency_Hz / last.frequency_Hz
    if not 1 / KNOWN_WITHIN < ratio < KNOWN_WITHIN:
        expected_s += LEVELLING_RECORDS * record_s + LEVELLING_S
    return min(expected_s, settings.longest_point_s)


def _name(condition: Condition) -> str:
    again = f"-r{condition.repeat}" if condition.repeat > 1 else ""
    return f"{condition.frequency_Hz:.9g}Hz-{condition.load_N:.9g}N{again}"


def _id_of(reading: Reading) -> str:
    frequency, load = float(reading["frequency_Hz"] or 0), float(reading["load_set_N"] or 0)
    return _name(Condition(frequency, load, int(reading["repeat"] or 1)))


# --- doing it ---------------------------------------------------------------------------------


def import_ahead() -> None:
    """What a sweep needs and takes long to import: never while something is switched on."""
    import scipy.special  # noqa: F401

    import rig.analysis.film.gain_curve  # noqa: F401


def arm(run: Run) -> None:
    """Preload the film and listen; then the vibrator, barely moving. Each off is known before its
    on."""
    from procedures.sweep.memory import Memory
    from procedures.sweep.sampling import listen

    generator, settings = run.bench.generator, run.settings
    pressed = preload.press(run, settings.preload_N)
    run.event(
        "info",
        "preload",
        f"{pressed.reached_N:.2f} N from contact at {pressed.contact_mm:.3f} mm, "
        f"{pressed.stiffness_N_mm:.3g} N/mm, overshoot {100 * pressed.overshoot:.1f} %, held "
        f"{pressed.settling_s:.2f} s after contact",
    )
    run.arm("generator output", generator.make_safe, at_once=generator.make_safe)
    generator.make_safe()
    if run.state is None:
        run.state = Memory(pressed)
        for reading in run.readings.values():
            run.state.recall(reading)
    memory: Memory = run.state
    memory.preload = pressed
    listen(run)
    memory.hold_preload(run)
    first_Hz = points(settings)[0].condition.frequency_Hz
    memory.begin_vibration(first_Hz, settings.first_amplitude_V, run.clock.now())
    generator.sine(first_Hz, settings.first_amplitude_V)
    generator.output(True)


def take(run: Run, point: Point) -> Reading:
    """Hold the load at this frequency and measure until the gain is known well enough."""
    from procedures.sweep.point import Taking

    taking = Taking(run, point.condition)
    taking.follow_preload()
    taking.drive_as_foretold()
    taking.sample()
    while not taking.is_over():
        taking.sample()
    return taking.reading()


# --- what came of it --------------------------------------------------------------------------


def summarise(settings: Settings, readings: Sequence[Reading]) -> Mapping[str, Any]:
    """Range, typical gain, how well it is known, and the film's model where there is enough."""
    from procedures.sweep.summary import figures, model

    if not readings:
        return {"points": 0}
    several = len(settings.levels_N) > 1
    return {
        **figures(readings),
        **contact.force_zero_of(readings),
        **model(readings, several_loads=several),
    }
