"""Frequency response of a PVDF film in its clamp, volts per newton, 2 to 20000 Hz.

The paper's chapter 3: the film is preloaded, a vibrator adds a sinusoidal load, and at each
frequency load cell and film are sampled together. A sine is fitted to both; their ratio is the
film's complex response. The load is held constant over frequency ("data1"), or takes several
levels at each ("data2", paper 3.2). After a scan of the whole range come further points in the
drops that it shows.

Taking a point: foretell the drive from what the vibrator did at frequencies nearby, sample short
records until two in a row agree, correct the drive until the load is right, then go on until the
gain is known well enough.
"""

from __future__ import annotations

import functools
import itertools
import math
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from pydantic import Field, field_validator, model_validator

from procedures import sweep_layout
from procedures.sweep_layout import reading_of
from rig.bench import Fixture, FixtureSettings
from rig.errors import InstrumentError
from rig.instruments import Acquisition, InputChannel, Record
from rig.runner.points import Move, Point, Reading
from rig.runner.procedure import StreamPlan
from rig.runner.trip import TripError
from rig.settings import Settings as BaseSettings

if TYPE_CHECKING:
    from procedures.preload import Preload
    from rig.analysis.levelling import LearnedGain, LearnedMains, RecordNeeds
    from rig.analysis.response import Response
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
LARGEST_SHARE_OF_PRELOAD = 0.8
"""A larger load could lift the indentor off the film (paper 3.1 keeps it pressed)."""
LARGE_STEP = 1.5
"""Ratio of the drive now to the drive before beyond which no record averages over the ringing."""
SILENCE_S = 2.0
"""Time at a point after which a film that shows nothing is told."""
LEAP = 1.1
"""Ratio of two frequencies in a row beyond which everything rings anew."""
LEAP_S = 0.02
"""Wait after that, where a record is too short to average over it."""
FEW_CYCLES = 2
"""A record holds so many cycles where that costs no more than twice the shortest record."""
LONG_RECORD_S = 0.03
"""A record that has to be as long averages over all ringing: one is enough after a wait."""
VERY_LONG_RECORD_S = 0.15
"""One as long needs no wait either."""
RINGING_S = 0.015
"""That wait after a change of frequency."""
CORRECTED_S = 0.008
"""And after a mere correction of the drive."""
FOLLOWED_S = 0.02
"""What a move after the creep takes."""
LISTEN_S = 0.5
"""Length of the record before anything vibrates."""
LISTENED = 2
"""How often it is expected to be taken: again on the ranges that the first one shows to fit."""
SURE = 0.003
"""Relative error of the last prediction of the load from which the next one is trusted."""
FOLLOW_S = 0.05
"""Least stretch of the static force that is followed."""
FIRST_LOOK = 3.0
"""The first record at a frequency has to show the gain within so many times the target only."""
HARMLESS = 0.2
"""A mains line that bends the gain by less than this share of the target is not fitted."""
FEWEST_FOR_A_MODEL = 12
MAINS_LINES = 5
BOLDEST_CORRECTION = 20.0
"""Of the drive in one step, upwards, whatever the load cell says: it may be half unplugged."""
LARGEST_CORRECTION = 1.4
"""Of the drive in one step where it was foretold from nearby: more is a bad record."""
AGREEMENT = 8e-4
"""Relative difference of two records in a row, beyond their noise, that counts as settled."""
CLEAR_RINGING = 2.0
"""A first difference so many times what agrees is ringing and not noise."""
LOOK_BEFORE_S = 0.1
"""A record that long is not begun with a drive that may be wrong: a short one tells first."""
KEPT_WITHIN = 0.75
"""Of the tolerance of the load: from there on the drive is corrected."""
FAR_OFF = 0.25
"""Relative error of a load after which the corrected drive is not trusted either."""
CAUTION = 0.1
"""Share of the wanted load at a frequency of which nothing is known."""
MOST_RECORDS = 400
"""Records of one point, at most; the time limit ends it long before."""


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


@dataclass
class Memory:
    """What a sweep has learned so far."""

    preload: Preload
    vibrator: LearnedGain
    """Load by drive, N/V."""
    film: LearnedGain
    """Film voltage by load, V/N."""
    mains: dict[str, LearnedMains]
    """By channel, in the channel's unit."""
    error_of_one_second: dict[str, float] = field(default_factory=dict)
    """Standard error of each channel's amplitude from one second of record, in its unit."""
    drive_V: float = 0.0
    """Amplitude that the generator is set to."""
    frequency_Hz: float = 0.0
    """Frequency that it is set to."""
    since_s: float = 0.0
    """When the present frequency began."""
    surprise: float = 1.0
    """How far the load was from the one foretold, relative, at the latest point."""
    followed_s: float = 0.0
    """When the latest move after the creep was over: what came before says nothing of it."""
    slow_until_s: float = 0.0
    """When a vibration so slow that a short mean of the force does not average it out ended."""


# --- what will be done ------------------------------------------------------------------------


def points(settings: Settings) -> tuple[Point, ...]:
    """The first plan: the grid, or the frequencies asked for, each at every load."""
    from procedures.preload import refuse_impossible

    refuse_impossible(settings.preload_N, max(settings.levels_N), LARGEST_SHARE_OF_PRELOAD)
    frequencies = settings.frequencies_Hz
    if not frequencies:
        from rig.analysis.frequency_plan import scan_frequencies_Hz

        frequencies = scan_frequencies_Hz(_grid(settings))
    return _points_at(settings, frequencies)


def refine(settings: Settings, readings: Sequence[Reading]) -> tuple[Point, ...]:
    """The second plan: further frequencies in the drops that the grid has shown."""
    if settings.frequencies_Hz or not settings.points_per_half_width:
        return ()
    from rig.analysis.frequency_plan import refine_Hz
    from rig.analysis.response_curve import CurveError

    grid = {point.id for point in points(settings)}
    scanned = [reading for reading in readings if _id_of(reading) in grid]
    try:
        return _points_at(settings, refine_Hz(_grid(settings), curve_of(scanned)))
    except CurveError:  # too short or too narrow a grid shows no drop
        return ()


def overhead_s(settings: Settings, fixture: FixtureSettings) -> float:
    """Bench time that preloading, listening and parking are expected to take."""
    from procedures.preload import duration_s

    return duration_s(fixture, settings.preload_N) + LISTENED * LISTEN_S


def _grid(settings: Settings) -> Any:
    from rig.analysis.frequency_plan import FrequencyPlanSettings

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
    return tuple(_point(settings, condition) for condition in conditions)


def _point(settings: Settings, condition: Condition) -> Point:
    from rig.analysis.sine_fit import whole_cycles

    frequency = condition.frequency_Hz
    rate = settings.rate_at(frequency)
    samples = whole_cycles(frequency, rate, settings.shortest_at(frequency))
    channels = (InputChannel("load_cell", 1.25), InputChannel("film", 1.25))
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
        duration_s=settings.settling_s + 2.5 * samples / rate,
    )


def _name(condition: Condition) -> str:
    again = f"-r{condition.repeat}" if condition.repeat > 1 else ""
    return f"{condition.frequency_Hz:.9g}Hz-{condition.load_N:.9g}N{again}"


def _id_of(reading: Reading) -> str:
    frequency, load = float(reading["frequency_Hz"] or 0), float(reading["load_set_N"] or 0)
    return _name(Condition(frequency, load, int(reading["repeat"] or 1)))


# --- doing it ---------------------------------------------------------------------------------


def arm(run: Run) -> None:
    """Preload the film; then the vibrator, barely moving. Each off is known before its on."""
    from procedures.preload import press
    from rig.analysis.levelling import LearnedGain, LearnedMains

    generator, settings = run.bench.generator, run.settings
    preload = press(run, settings.preload_N)
    run.event(
        "info",
        "preload",
        f"{preload.reached_N:.2f} N from contact at {preload.contact_mm:.3f} mm, "
        f"{preload.stiffness_N_mm:.3g} N/mm, overshoot {100 * preload.overshoot:.1f} %, held "
        f"{preload.settling_s:.2f} s after contact",
    )
    run.arm("generator output", generator.make_safe, at_once=generator.make_safe)
    generator.make_safe()
    if run.state is None:
        run.state = Memory(
            preload,
            LearnedGain(),
            LearnedGain(),
            {"load_cell": LearnedMains(), "film": LearnedMains()},
        )
        for reading in run.readings.values():
            _remember(run.state, reading)
    memory: Memory = run.state
    listen(run)
    while preload.follow(run, FOLLOW_S):
        run.clock.sleep(FOLLOW_S + FOLLOWED_S)
    memory.preload, memory.drive_V = preload, settings.first_amplitude_V
    memory.frequency_Hz = points(settings)[0].condition.frequency_Hz
    memory.since_s = memory.slow_until_s = run.clock.now()
    generator.sine(memory.frequency_Hz, memory.drive_V)
    generator.output(True)


def listen(run: Run) -> None:
    """Before anything vibrates: the noise of both channels, and the mains in them."""
    from rig.analysis.sine_fit import fit_sine, mains_lines

    settings, memory, daq = run.settings, run.state, run.bench.daq
    rate = settings.slowest_rate_S_s if settings.rate_S_s is None else settings.rate_S_s
    ranges = daq.ranges_V()
    channels: tuple[InputChannel, ...] = tuple(
        InputChannel(name, max(ranges)) for name in ("load_cell", "film")
    )
    while True:
        record = daq.acquire(Acquisition(channels, rate, round(LISTEN_S * rate)))
        largest = {c.name: float(abs(record.volts(c.name)).max()) for c in channels}
        fitting = tuple(
            InputChannel(c.name, range_above(largest[c.name], ranges)) for c in channels
        )
        if fitting == channels:
            break
        channels = fitting
    units = {"load_cell": run.bench.load_cell.sensitivity_V_N, "film": 1.0}
    first, *others = mains_lines(settings.mains_Hz)
    for name, volts_per_unit in units.items():
        found = fit_sine(record.volts(name) / volts_per_unit, rate, first, interference=others)
        memory.mains[name].learn(found, settings.mains_Hz)
        memory.error_of_one_second[name] = found.residual_rms * math.sqrt(2 / rate)


def range_above(volts: float, ranges_V: Sequence[float]) -> float:
    """The smallest range that holds twice as much, or the largest there is."""
    from rig.analysis.levelling import range_for

    return range_for(volts, ranges_V, margin=2.0)


def take(run: Run, point: Point) -> Reading:
    """Hold the load at this frequency and measure until the gain is known well enough."""
    from rig.analysis.levelling import combined

    condition: Condition = point.condition
    begin_s = run.clock.now()
    follow_preload(run)
    taking = _Taking(run, condition)
    taking.drive_as_foretold()
    taking.wait(run.settings.settling_s)
    for _ in range(MOST_RECORDS):
        taking.sample()
        late = run.clock.now() - begin_s > run.settings.longest_point_s
        if taking.is_level() and taking.is_settled():
            if taking.physics_s > SILENCE_S:
                refuse_silence(taking.kept[-1].voltage)
            if taking.is_known() or late:
                break
        elif late:
            taking.refuse_restless()
    kept = taking.kept
    for sampled in kept:
        run.emit("waveform", sampled.record)
    last = kept[-1]
    refuse_silence(last.voltage)
    warn_of_mains(run, last.voltage, taking.strong_mains("film"))
    for name, tone in (("load_cell", last.load), ("film", last.voltage)):
        run.state.error_of_one_second[name] = tone.residual_rms * math.sqrt(2 / tone.rate_Hz)
    response = combined([sampled.response for sampled in kept])
    reading = reading_of(response, last.load, last.voltage, run.elapsed_s())
    reading |= {
        "load_set_N": condition.load_N,
        "repeat": condition.repeat,
        "drive_V": run.state.drive_V,
        "degrees": sum(sampled.load.n - 7 for sampled in kept),
        "records": len(kept),
        "taken_s": run.clock.now() - begin_s,
        "physics_s": taking.physics_s,
        "largest_load_N": taking.largest_load_N,
        "preload_N": float(run.force.mean_N(max(0.05, 1 / condition.frequency_Hz))[2]),
    }
    return reading


def follow_preload(run: Run) -> None:
    """Follow the film's creep by the mean force over whole periods of the present vibration."""
    memory: Memory = run.state
    now, f = run.clock.now(), memory.frequency_Hz
    stretch_s = math.ceil(FOLLOW_S * f) / f
    slow = stretch_s > FOLLOW_S + 1e-3
    if slow:
        memory.slow_until_s = now
    begun_s = memory.since_s if slow else memory.slow_until_s
    if now - max(begun_s, memory.followed_s) >= stretch_s and memory.preload.follow(run, stretch_s):
        memory.followed_s = now + FOLLOWED_S


@dataclass(frozen=True)
class Sampled:
    """One record and what the fits make of it."""

    record: Record
    load: SineFit
    """In newtons."""
    voltage: SineFit
    """In volts."""
    response: Response


class _Taking:
    """One point under way: the drive, the records that count, and what is asked of them."""

    def __init__(self, run: Run, condition: Condition):
        self.run, self.condition = run, condition
        self.memory: Memory = run.state
        self.settings: Settings = run.settings
        self.kept: list[Sampled] = []
        """Records in a row at the present drive."""
        self.physics_s = 0.0
        """Time that went into waiting and sampling, and not into commands and computing."""
        self.largest_load_N = self._latest_N = 0.0
        self._driven_s = 0.0
        """When the drive was changed."""
        self._seen_ringing: tuple[float, float] | None = None
        """When two records in a row first disagreed since, and by how much."""
        self._outlasted = False
        """Whether it has been waited for that ringing to die away."""
        self._leapt = False
        """Whether the drive was changed so much that what rings is large beside the tone."""
        self._foretold = False
        self._records = 0
        self._looking = False
        """Whether the next record only has to tell the load: its prediction is not trusted."""
        self._ranges: dict[str, float] = {}
        """Input ranges that turned out too small, by channel: larger ones are taken."""

    def wait(self, seconds: float) -> None:
        """Let what was changed settle."""
        self.physics_s += seconds
        self.run.clock.sleep(seconds)

    # --- the drive ---

    def drive_as_foretold(self) -> None:
        """With the drive that should give the load; with a share of it where nothing is known."""
        f, lo = self.condition.frequency_Hz, self.condition.load_N
        gain = self.memory.vibrator.at(f)
        costly = self._averages() and self._whole_length_s > LOOK_BEFORE_S
        self._looking = self.memory.surprise > SURE and costly
        if gain is None:
            self._drive(self.settings.first_amplitude_V)
        else:
            self._foretold = self.memory.vibrator.near(f)
            self._drive((1.0 if self._foretold else CAUTION) * lo / gain)

    def _drive(self, amplitude_V: float) -> None:
        memory, f = self.memory, self.condition.frequency_Hz
        self.run.bench.generator.sine(f, amplitude_V)
        changed = f != memory.frequency_Hz
        leapt = not 1 / LEAP < f / memory.frequency_Hz < LEAP
        if changed:
            memory.frequency_Hz, memory.since_s = f, self.run.clock.now()
        ratio = amplitude_V / memory.drive_V
        self._leapt = self._leapt or not 1 / LARGE_STEP < ratio < LARGE_STEP
        memory.drive_V = amplitude_V
        self.kept.clear()
        if leapt and not self._averages():
            self.wait(LEAP_S)
        self._driven_s = self.run.clock.now()
        self._seen_ringing = None
        self._outlasted = False
        if self._averages() and self._whole_length_s < VERY_LONG_RECORD_S:
            wait_s = RINGING_S if changed else CORRECTED_S
            self.wait(wait_s)

    def _averages(self) -> bool:
        """Whether one record averages over all ringing."""
        return self._whole_length_s >= LONG_RECORD_S and not self._leapt

    @functools.cached_property
    def _whole_length_s(self) -> float:
        """Length of the one record that would reach the target by itself."""
        from rig.analysis.levelling import record_samples

        f = self.condition.frequency_Hz
        rate = self.settings.rate_at(f)
        return record_samples(f, rate, self._needs(whole=True), self._all_mains()) / rate

    def _all_mains(self) -> list[float]:
        return sorted({*self.strong_mains("load_cell"), *self.strong_mains("film")})

    # --- records ---

    def sample(self) -> None:
        """One record more; one that was too large for its range is taken again on a larger."""
        daq = self.run.bench.daq
        while True:
            acquisition = self._acquisition()
            record = daq.acquire(acquisition)
            self.physics_s += acquisition.samples / acquisition.rate_S_s
            if not self._overloaded(record):
                break
        f = self.condition.frequency_Hz
        load = self._fit(record, "load_cell", self.run.bench.load_cell.sensitivity_V_N)
        voltage = self._fit(record, "film", 1.0)
        self._latest_N = load.amplitude
        self.largest_load_N = max(self.largest_load_N, load.amplitude)
        refuse_no_load(load)
        self.memory.vibrator.learn(f, load.amplitude / self.memory.drive_V)
        refuse_overload(self.run, load)
        from rig.analysis.response import complex_response

        response = complex_response(voltage, load)
        self.kept.append(Sampled(record, load, voltage, response))
        memory = self.memory
        if self._records == 0:
            memory.surprise = abs(load.amplitude / self.condition.load_N - 1)
        self._records += 1
        if voltage.amplitude > NO_SIGNAL_ERRORS * voltage.standard_error and not self._looking:
            memory.film.learn(f, abs(response.value))

    def is_level(self) -> bool:
        """Whether the load is the one asked for; if it is not, the drive is corrected."""
        lo = self.condition.load_N
        load = self.kept[-1].load
        if abs(load.amplitude / lo - 1) <= self._tolerance(load):
            return True
        self._looking = self._looking and abs(load.amplitude / lo - 1) > FAR_OFF
        correction = min(lo / load.amplitude, BOLDEST_CORRECTION)
        if self._foretold:
            correction = min(max(correction, 1 / LARGEST_CORRECTION), LARGEST_CORRECTION)
        self._drive(self.memory.drive_V * correction)
        return False

    def _tolerance(self, load: SineFit) -> float:
        """Most of what a kept point may be off; the noise of a short record is no deviation."""
        noise = 2 * load.standard_error / self.condition.load_N
        return min(max(KEPT_WITHIN * 1e-2 * self.settings.load_tolerance_percent, noise), 5e-2)

    def is_settled(self) -> bool:
        """Whether the last two records agree; those before are forgotten where they do not."""
        from rig.analysis.levelling import agreement

        if self._looking:  # it was too short to count
            self._looking = False
            self.kept.clear()
            return False
        if len(self.kept) < 2:
            return self._averages() or self._outlasted
        if self._averages() or self._outlasted:
            return True
        before, last = (sampled.response for sampled in self.kept[-2:])
        difference = abs(before.value - last.value)
        now = self.run.clock.now()
        if self._agree():
            self._outlast_ringing(now, agreement(before, last, AGREEMENT), abs(last.value))
            return bool(self.kept)
        if self._seen_ringing is None:
            self._seen_ringing = (now, difference)
        del self.kept[:-1]
        return False

    def _outlast_ringing(self, now: float, visible: float, size: float) -> None:
        """Where ringing was seen to sink below what can be seen, wait until it matters no more.

        It took so long from the first difference to less than ``visible``: that tells the longest
        time constant it may have.
        """
        if self._seen_ringing is None:
            return
        since_s, first = self._seen_ringing
        self._seen_ringing = None
        if first > CLEAR_RINGING * visible and visible > AGREEMENT * size:
            constant_s = (now - since_s) / math.log(first / visible)
            rest_s = constant_s * math.log(visible / (AGREEMENT * size))
            under_way_s = self.kept[-1].load.n / self.kept[-1].load.rate_Hz / 2  # in the next one
            self.wait(max(min(rest_s, now - self._driven_s) - under_way_s, 0.0))
            self.kept.clear()
            self._outlasted = True

    def _agree(self) -> bool:
        from rig.analysis.levelling import agreement

        before, last = self.kept[-2:]
        same_load = abs(before.load.phasor and before.load.amplitude - last.load.amplitude)
        noise = 2.5 * math.hypot(before.load.standard_error, last.load.standard_error)
        if same_load > 3 * AGREEMENT * last.load.amplitude + noise:
            return False
        visible = agreement(before.response, last.response, AGREEMENT)
        return abs(before.response.value - last.response.value) <= visible

    def is_known(self) -> bool:
        """Whether the gain's standard error is below the target: without the first record, which
        may hold the end of the ringing, if that does."""
        from rig.analysis.levelling import combined

        target = self.settings.target_error_dB
        for kept in (self.kept[1:], self.kept):
            if not kept:
                continue
            together = combined([sampled.response for sampled in kept])
            if together.gain_standard_error_dB <= target:
                self.kept = list(kept)
                return self._load_is_right()
        return False

    def _load_is_right(self) -> bool:
        """Whether the records' mean load is within the tolerance: their noise averages out."""
        mean = sum(s.load.amplitude for s in self.kept) / len(self.kept)
        return abs(mean / self.condition.load_N - 1) <= 1e-2 * self.settings.load_tolerance_percent

    def refuse_restless(self) -> None:
        """The time limit is over, and the load was never right and steady."""
        raise InstrumentError(
            "generator",
            f"load at {self.condition.frequency_Hz:g} Hz",
            f"{self._latest_N:.4g} N after {self.settings.longest_point_s:g} s, "
            f"{self.condition.load_N:g} N wanted; two records in a row never agreed on it",
            "look for something loose in the vibrator's line, or allow more time and tolerance",
        )

    # --- details of a record ---

    def _acquisition(self) -> Acquisition:
        from rig.analysis.levelling import range_for, record_samples

        f, lo = self.condition.frequency_Hz, self.condition.load_N
        daq, memory = self.run.bench.daq, self.memory
        rate = self.settings.rate_at(f)
        mains = [] if self._looking else self._all_mains()
        samples = record_samples(f, rate, self._needs(), mains)
        load_V = max(lo, self.largest_load_N) * self.run.bench.load_cell.sensitivity_V_N
        film_V = (memory.film.at(f) or 0.0) * lo  # unknown: from the smallest range on
        ranges = daq.ranges_V()
        channels = []
        for name, amplitude in (("load_cell", load_V), ("film", film_V)):
            suits = [r for r in ranges if r > self._ranges.get(name, 0.0)] or [max(ranges)]
            channels.append(InputChannel(name, range_for(amplitude, suits)))
        return Acquisition(tuple(channels), rate, samples)

    def _needs(self, whole: bool = False) -> RecordNeeds:
        """How long the next record has to be: what is missing after those that are kept."""
        from rig.analysis.levelling import RecordNeeds
        from rig.analysis.response import DB_PER_RELATIVE

        f, lo = self.condition.frequency_Hz, self.condition.load_N
        own, memory = self.settings, self.memory
        shortest_s = own.shortest_at(f)
        film = memory.film.at(f)
        error = None
        if film is not None and memory.error_of_one_second:
            load_error = memory.error_of_one_second["load_cell"] / lo
            film_error = memory.error_of_one_second["film"] / (film * lo)
            error = DB_PER_RELATIVE * math.hypot(load_error, film_error)
        target = own.target_error_dB
        if not whole and not self.kept and not (self._outlasted or self._averages()):
            # it only has to tell whether it has settled
            return RecordNeeds(shortest_s, own.longest_point_s, FIRST_LOOK * target, error)
        have_s = sum(s.load.n / s.load.rate_Hz for s in self.kept)
        if error is not None:
            missing_s = (error / target) ** 2 - have_s
            target = error / math.sqrt(max(missing_s, shortest_s))
        return RecordNeeds(shortest_s, own.longest_point_s, target, error)

    def _overloaded(self, record: Record) -> bool:
        """Whether a channel stood at the end of its range, and there is a larger one to take."""
        again = False
        for name, range_V in zip(record.scaling.channels, record.scaling.range_V, strict=True):
            if not record.clipped(name):
                continue
            if range_V >= max(self.run.bench.daq.ranges_V()):
                refuse_saturation(record, self.condition.frequency_Hz)
            self._ranges[name] = range_V
            again = True
        return again

    def _fit(self, record: Record, channel: str, volts_per_unit: float) -> SineFit:
        from rig.analysis.levelling import HARDLY, affordable_inflation
        from rig.analysis.sine_fit import mains_lines

        needs = self._needs()
        duration_s = len(record.counts) / record.scaling.rate_S_s
        f, strong = self.condition.frequency_Hz, self.strong_mains(channel)
        limit = HARDLY  # a line that hardly matters is fitted where that costs hardly anything
        if strong and not self._looking:
            limit = affordable_inflation(needs, duration_s)
        lines: Sequence[float] = mains_lines(self.settings.mains_Hz, MAINS_LINES)
        if not strong and duration_s * self.settings.mains_Hz < 1:
            lines = ()  # less than a period of weak mains is as good as an offset
        found = fit(record, channel, f, volts_per_unit, lines, limit)
        self.memory.mains[channel].learn(found, self.settings.mains_Hz)
        return found

    def strong_mains(self, channel: str) -> list[float]:
        """The mains lines that could matter to a channel."""
        from rig.analysis.response import DB_PER_RELATIVE

        lo = self.condition.load_N
        film = self.memory.film.at(self.condition.frequency_Hz) or 0.0
        size = lo if channel == "load_cell" else film * lo
        harmless = HARMLESS * self.settings.target_error_dB / DB_PER_RELATIVE * size
        return self.memory.mains[channel].strong(self.settings.mains_Hz, MAINS_LINES, harmless)


def _remember(memory: Memory, reading: Reading) -> None:
    """What an earlier attempt's reading tells."""
    frequency, load = float(reading["frequency_Hz"] or 0), float(reading["load_amplitude_N"] or 0)
    memory.vibrator.learn(frequency, load / float(reading["drive_V"] or 1))
    memory.film.learn(frequency, 10 ** (float(reading["gain_dB"] or 0) / 20))


def fit(
    record: Record,
    channel: str,
    frequency: float,
    volts_per_unit: float,
    mains: Sequence[float],
    largest_inflation: float,
) -> SineFit:
    """The tone in one channel, in units of `volts_per_unit`, with mains lines fitted beside it."""
    from rig.analysis.sine_fit import fit_sine

    return fit_sine(
        record.volts(channel) / volts_per_unit,
        record.scaling.rate_S_s,
        frequency,
        interference=mains,
        delay_s=record.delay_s(channel),
        largest_inflation=largest_inflation,
    )


def warn_of_mains(run: Run, found: SineFit, strong: Sequence[float]) -> None:
    """A strong mains line that could not be told from the tone."""
    for line in set(found.unresolved_Hz) & set(strong):
        run.event(
            "warning",
            "mains",
            f"{found.frequency_Hz:g} Hz is too close to the mains line at {line:g} Hz for a record "
            f"of {found.n / found.rate_Hz:.3g} s: what the mains adds cannot be told from the "
            "signal",
        )


def refuse_saturation(record: Record, frequency: float) -> None:
    """A clipped sine fits beautifully and wrongly."""
    for channel, range_V in zip(record.scaling.channels, record.scaling.range_V, strict=True):
        if clipped := record.clipped(channel):
            raise InstrumentError(
                "daq",
                f"channel {channel} at {frequency:g} Hz",
                f"{clipped} of {len(record.counts)} samples are at the end of the "
                f"{range_V:g} V range",
                "choose a smaller load, or a smaller gain of the amplifier",
            )


def refuse_overload(run: Run, load: SineFit) -> None:
    """The load may not exceed what film and cell stand."""
    limit = run.bench.load_cell.max_load_N
    if load.amplitude > limit:
        raise TripError(
            f"load {load.amplitude:.3g} N at {load.frequency_Hz:g} Hz is over the limit of "
            f"{limit:g} N of the load cell",
            "choose a smaller load",
        )


def refuse_no_load(load: SineFit) -> None:
    """A vibrator that does not drive, or a load cell that does not see it."""
    if not load.amplitude > NO_SIGNAL_ERRORS * load.standard_error:
        raise InstrumentError(
            "load_cell",
            f"load at {load.frequency_Hz:g} Hz",
            f"{load.amplitude:.2g} N with a standard error of {load.standard_error:.2g} N is no "
            "more than noise",
            "check generator, vibrator amplifier and load cell, and their cables",
        )


def refuse_silence(voltage: SineFit) -> None:
    """A film that is torn, unclamped or not connected gives noise."""
    if not voltage.amplitude > NO_SIGNAL_ERRORS * voltage.standard_error:
        raise InstrumentError(
            "film",
            f"signal at {voltage.frequency_Hz:g} Hz",
            f"{voltage.amplitude:.2g} V with a standard error of {voltage.standard_error:.2g} V "
            "is no more than noise",
            "check that the film is clamped, whole and connected to its amplifier",
        )


# --- what came of it --------------------------------------------------------------------------


def curve_of(readings: Sequence[Reading]) -> Any:
    """The readings as the analysis takes them."""
    from rig.analysis.response_curve import ResponseCurve

    return ResponseCurve.of(*_arrays(readings))


def _arrays(readings: Sequence[Reading]) -> tuple[Any, Any, Any, Any]:
    """Frequencies (n,) in Hz, responses (n,) in V/N, their covariances (n, 2, 2), degrees (n,)."""
    import numpy as np

    def column(name: str) -> Any:
        return np.array([float(reading[name] or 0) for reading in readings])

    covariances = np.empty((len(readings), 2, 2))
    covariances[:, 0, 0] = column("response_var_real")
    covariances[:, 1, 1] = column("response_var_imag")
    covariances[:, 0, 1] = covariances[:, 1, 0] = column("response_cov_real_imag")
    responses = column("response_real_V_N") + 1j * column("response_imag_V_N")
    return column("frequency_Hz"), responses, covariances, column("degrees")


def summarise(settings: Settings, readings: Sequence[Reading]) -> Mapping[str, Any]:
    """Range, typical gain, how well it is known, and the film's model where there is enough."""
    if not readings:
        return {"points": 0}
    return {**_figures(readings), **_model(settings, readings)}


def _model(settings: Settings, readings: Sequence[Reading]) -> dict[str, Any]:
    """What the analysis of the gain curve says; nothing for a sweep too short for it."""
    if len({reading["frequency_Hz"] for reading in readings}) < FEWEST_FOR_A_MODEL:
        return {}
    import numpy as np

    from rig.analysis.gain_curve import analyse
    from rig.analysis.response_curve import CurveError

    several = len(settings.levels_N) > 1

    def column(name: str) -> Any:
        return np.array([float(reading[name] or 0) for reading in readings]) if several else None

    frequencies, responses, covariances, degrees = _arrays(readings)
    try:
        found = analyse(
            frequencies,
            responses,
            covariances,
            degrees=degrees,
            loads=column("load_amplitude_N"),
            load_distortion=column("load_distortion"),
            film_distortion=column("voltage_distortion"),
        )
    except CurveError:
        return {}
    return {"analysis": found.sentences(), "model": found.as_dict()}


def _figures(readings: Sequence[Reading]) -> dict[str, Any]:
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
        "largest_deviation_of_load_percent": 100
        * max(
            abs(float(r["load_amplitude_N"] or 0) / float(r["load_set_N"] or 1) - 1)
            for r in readings
        ),
        "largest_load_N": max(float(r["largest_load_N"] or 0) for r in readings),
    }
