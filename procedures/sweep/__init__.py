"""Measure the frequency response of a PVDF film in its clamp, V/N, 2 to 20000 Hz.

The paper's chapter 3: the film is preloaded, a vibrator adds a sinusoidal load, and at each
frequency load cell and film are sampled together. A sine is fitted to both; their ratio is the
film's complex response. The load is constant over frequency ("data1"), or takes several levels at
each ("data2", paper 3.2). After a scan of the whole range, further points are measured in the
notches that it shows.

`procedures.sweep.point` measures a point, `procedures.sweep.sampling` a record;
`procedures.sweep.memory` has what is carried from one point to the next.
"""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from procedures.pressed.approach import tare
from procedures.pressed.approach.contact import contact_range_mm
from procedures.pressed.approach.torque_limit import require_torque_limit
from procedures.pressed.approach.way_down import speed_bound
from procedures.sweep import layout as sweep_layout
from procedures.sweep import preload
from procedures.sweep.settings import (
    CHANNELS,
    LARGEST_SHARE_OF_PRELOAD,
    LISTEN_RECORDS,
    LISTEN_S,
    LONG_RECORD_S,
    SweepCondition,
    SweepSettings,
)
from rig.bench.settings import FixtureSettings
from rig.instruments.roles import Acquisition, InputChannel
from rig.run.points import RANGE_FOUND_LATER_V, Move, Point, Reading
from rig.run.procedure import DriftFigure, Procedure, StreamPlan

if TYPE_CHECKING:
    from procedures.sweep.memory import SweepMemory
    from rig.analysis.film.frequency_plan import FrequencyPlanSettings
    from rig.bench.connected import Bench
    from rig.run.context import Run

# --- expected times of a point, measured on the simulated film ---
QUIET_S_Hz2 = 9.0
"""Time at 1 Hz in which noise allows `QUIET_dB` at 1 N; it falls with the square of frequency and
load, because the film's signal rises with both."""
QUIET_dB = 0.05
RINGS_S = ((200.0, 0.09), (600.0, 0.03), (math.inf, 0.015))
"""Time for which a point waits for ringing to decay, by the frequency below which it does."""
LOADS_BELOW_Hz, LOADS_S = 60.0, 0.25
"""Frequency below which a change of load rings for longer than that, and the time for each point of
a sweep with several loads.

These and `RINGS_S` are from the times of eight sweeps of the simulated bench (seed 0, one to three
loads). Only estimates of time depend on them."""
KNOWN_WITHIN = 1.3
"""Ratio of two successive frequencies beyond which the drive is not predicted well."""
LEVELLING_RECORDS, LEVELLING_S = 2.5, 0.03
"""Records and time that finding the drive then takes."""


class Sweep(Procedure):
    """Measure the frequency response of a PVDF film in its clamp, V/N, 2 to 20000 Hz."""

    name = "sweep"
    fixtures = ("film-clamp",)
    Settings = SweepSettings
    layout = sweep_layout.LAYOUT
    streams = (StreamPlan("waveform", "daq", CHANNELS, "Load cell and film, raw counts"),)
    stated_in_title = "preload_N"
    summary_labels = {  # noqa: RUF012
        "model.level": "level b at 1 Hz, at the mean preload; the World's is at its nominal one",
        "force_zero_N": tare.ZERO_LABEL,
        "points": "number of points",
        "median_gain_standard_error_dB": "standard error of the gain, median",
        "largest_gain_standard_error_dB": "standard error of the gain, largest",
        "largest_deviation_of_load_percent": "largest deviation of the load from its set point",
        "gain_near_200_Hz_error_dB": "gain near 200 Hz, standard error; dB",
        "gain_near_200_Hz_at_Hz": "gain near 200 Hz, measured at; Hz",
    }
    method = (
        "Joint weighted least squares of gain and phase: a circuit of 20 dB/decade with one pole, "
        "and second-order notches; 95 % intervals; verdicts are two one-sided tests of 5 % against "
        "model/bounds"
    )
    summary_origins = {  # noqa: RUF012
        "model.bounds": "set",
        "model.circuit.film_corner_Hz": "computed from the paper's Table 1",
        "model.circuit.circuit_corner_Hz": "computed from the paper's Table 1",
        "model.circuit.offsets": "the nominal circuit's level minus the fitted one",
        "model.circuit.separability": "computed for the nominal circuit at the fitted level and "
        "corner",
    }
    drift = {"gain_near_200_Hz_dB": DriftFigure("gain near 200 Hz", "film", 0.5)}  # noqa: RUF012

    settings: SweepSettings

    def __init__(self, settings: SweepSettings):
        super().__init__(settings)
        self._memory: SweepMemory | None = None
        """Knowledge of the sweep so far; None before it is armed for the first time."""

    # --- planning -------------------------------------------------------------------------------

    def import_ahead(self) -> None:
        """Import the analysis, so that nothing is imported while something is switched on."""
        import rig.analysis.film.gain_curve  # noqa: F401

    def points(self) -> tuple[Point, ...]:
        """Return the first plan: the grid, or the given frequencies, each at every load."""
        settings = self.settings
        preload.refuse_impossible(settings, LARGEST_SHARE_OF_PRELOAD)
        frequencies = settings.frequencies_Hz
        if not frequencies:
            from rig.analysis.film.frequency_plan import scan_frequencies_Hz

            frequencies = scan_frequencies_Hz(_grid(settings))
        return _points_at(settings, frequencies)

    def refine(self, readings: Sequence[Reading]) -> tuple[Point, ...]:
        """Return the second plan: further frequencies in the notches that the grid has shown."""
        settings = self.settings
        if settings.frequencies_Hz or not settings.points_per_half_width:
            return ()
        from procedures.sweep.summary import curve_of
        from rig.analysis.film.frequency_plan import refine_Hz
        from rig.analysis.response.curve import CurveError

        grid = {point.id for point in self.points()}
        scanned = [reading for reading in readings if _id_of(reading) in grid]
        try:
            return _points_at(settings, refine_Hz(_grid(settings), curve_of(scanned)))
        except CurveError:  # A grid that is too short or too narrow shows no notch.
            return ()

    def refining_s(self) -> float:
        """Return the expected bench time of the second plan in s, for a film with the notches of
        the paper's."""
        settings = self.settings
        if settings.frequencies_Hz or not settings.points_per_half_width:
            return 0.0
        from rig.analysis.film.frequency_plan import expected_refinement_Hz

        further = _points_at(settings, expected_refinement_Hz(_grid(settings)))
        return math.fsum(point.duration_s for point in further)

    def overhead_s(self, fixture: FixtureSettings, homed: bool) -> float:
        """Return the expected bench time of preloading, listening and parking, in s."""
        return (
            preload.duration_s(fixture, self.settings.preload_N, homed) + LISTEN_RECORDS * LISTEN_S
        )

    def check(self, bench: Bench) -> None:
        """Refuse a fixture that does not state the contact range, and a contact so stiff that the
        slow search would press too hard."""
        contact_range_mm(bench)
        require_torque_limit(bench)
        limit_N = bench.force_sensor.limits()["force"].high
        speed_bound(bench, limit_N).require("stage_z", preload.APPROACH_mm_s)

    # --- acting ---------------------------------------------------------------------------------

    def arm(self, run: Run) -> None:
        """Preload the film and measure the noise; then start the vibrator at a small amplitude."""
        from procedures.sweep.memory import SweepMemory
        from procedures.sweep.sampling import listen

        generator, settings = run.bench.generator, self.settings
        pressed = preload.press(run, settings.preload_N)
        run.event(
            "info",
            "preload",
            f"{pressed.reached_N:.2f} N from contact at {pressed.contact_mm:.3f} mm, "
            f"{pressed.stiffness_N_mm:.3g} N/mm, overshoot {100 * pressed.overshoot:.1f} %, held "
            f"{pressed.settling_s:.2f} s after contact",
        )
        switch_off = generator.make_safe
        run.arm("generator output", switch_off, emergency=switch_off, done="generator off")
        switch_off()
        if self._memory is None:
            self._memory = SweepMemory(pressed)
            for reading in run.readings.values():
                self._memory.recall(reading)
        memory = self._memory
        memory.preload = pressed
        listen(run, memory)
        memory.hold_preload(run)
        first_Hz = self.points()[0].condition.frequency_Hz
        memory.begin_vibration(first_Hz, settings.first_amplitude_V, run.clock.now())
        generator.sine(first_Hz, settings.first_amplitude_V)
        generator.output(True)

    def take(self, run: Run, point: Point) -> Reading:
        """Set the load at this frequency and measure until the gain is known well enough."""
        from procedures.sweep.point import SweepPointRun

        assert self._memory is not None, "arm() comes first"
        measurement = SweepPointRun(run, point.condition, self._memory)
        measurement.follow_preload()
        measurement.drive_as_predicted()
        measurement.sample()
        while not measurement.is_over():
            measurement.sample()
        return measurement.reading()

    # --- afterwards -----------------------------------------------------------------------------

    def summarise(self, readings: Sequence[Reading]) -> Mapping[str, Any]:
        """Return range, typical gain and its error, and the film's model if there are enough
        points."""
        from procedures.sweep.summary import figures, model

        if not readings:
            return {"points": 0}
        settings = self.settings
        several = len(settings.levels_N) > 1
        return {
            **figures(readings),
            **tare.force_zero_of(readings),
            **model(readings, several, settings.bounds),
        }

    def put_in(self, readings: Sequence[Reading], summary: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the film of the simulated bench, with what was recovered of it."""
        from procedures.sweep.summary import put_in

        return put_in(readings, summary)

    def in_brief(self, summary: Mapping[str, Any], put_in: Mapping[str, Any]) -> Sequence[str]:
        """Return the verdicts and the film's values, or single values where no model was fitted."""
        from procedures.sweep.summary import in_brief

        return in_brief(summary, put_in) or super().in_brief(summary, put_in)


# --- the plan ---------------------------------------------------------------------------------


def _grid(settings: SweepSettings) -> FrequencyPlanSettings:
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


def _points_at(settings: SweepSettings, frequencies: Sequence[float]) -> tuple[Point, ...]:
    conditions = [
        SweepCondition(frequency, load, repeat)
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
    else:
        conditions = _up_and_down(conditions)
    before = [None, *conditions]
    return tuple(
        _point(settings, condition, last)
        for condition, last in zip(conditions, before, strict=False)
    )


def _up_and_down(conditions: Sequence[SweepCondition]) -> list[SweepCondition]:
    """Return the conditions with the loads rising at one frequency and falling at the next.

    The drive then never changes much between two points. A leap from the largest load to the
    smallest rings far longer above the tone than one step of load does.
    """
    groups = itertools.groupby(conditions, key=lambda c: (c.repeat, c.frequency_Hz))
    ordered: list[SweepCondition] = []
    for k, (_, group) in enumerate(groups):
        loads = list(group)
        ordered += reversed(loads) if k % 2 else loads
    return ordered


def _point(
    settings: SweepSettings, condition: SweepCondition, last: SweepCondition | None
) -> Point:
    from rig.analysis.response.sine_fit import whole_cycles

    frequency = condition.frequency_Hz
    rate = settings.rate_at(frequency)
    samples = whole_cycles(frequency, rate, settings.shortest_at(frequency))
    channels = tuple(InputChannel(name, RANGE_FOUND_LATER_V) for name in CHANNELS)
    load = "loads_N" if settings.loads_N else "load_N"
    frequencies = ("frequencies_Hz",) if settings.frequencies_Hz else ("lowest_Hz", "highest_Hz")
    return Point(
        id=_name(condition),
        condition=condition,
        moves=(
            Move("generator.frequency", frequency, frequencies),
            Move("generator.amplitude", settings.first_amplitude_V, ("first_amplitude_V",)),
            Move("load_cell.load", condition.load_N, (load,)),
            Move("force_sensor.force", settings.preload_N + condition.load_N, ("preload_N", load)),
        ),
        acquisitions=(Acquisition(channels, rate, samples),),
        acquisitions_given=(_rate_setting(settings, frequency), *frequencies),
        duration_s=settings.settling_s + _expected_s(settings, condition, last, samples / rate),
    )


def _rate_setting(settings: SweepSettings, frequency_Hz: float) -> str:
    """Return the setting that decides the sampling rate at a frequency."""
    if settings.rate_S_s is not None:
        return "rate_S_s"
    is_slow = settings.slowest_rate_S_s > settings.samples_per_cycle * frequency_Hz
    return "slowest_rate_S_s" if is_slow else "samples_per_cycle"


def _expected_s(
    settings: SweepSettings, condition: SweepCondition, last: SweepCondition | None, record_s: float
) -> float:
    """Return the expected time of a point after `last` with records of at least `record_s`."""
    quieter = QUIET_dB / (settings.target_error_dB * condition.load_N * condition.frequency_Hz)
    level_s = record_s if record_s >= LONG_RECORD_S else 2 * record_s
    expected_s = max(level_s, QUIET_S_Hz2 * quieter**2)
    expected_s += next(rings_s for below, rings_s in RINGS_S if condition.frequency_Hz < below)
    if condition.frequency_Hz < LOADS_BELOW_Hz and len(settings.loads_N) > 1:
        expected_s += LOADS_S
    ratio = KNOWN_WITHIN if last is None else condition.frequency_Hz / last.frequency_Hz
    if not 1 / KNOWN_WITHIN < ratio < KNOWN_WITHIN:
        expected_s += LEVELLING_RECORDS * record_s + LEVELLING_S
    return min(expected_s, settings.longest_point_s)


def _name(condition: SweepCondition) -> str:
    again = f"-r{condition.repeat}" if condition.repeat > 1 else ""
    return f"{condition.frequency_Hz:.9g}Hz-{condition.load_N:.9g}N{again}"


def _id_of(reading: Reading) -> str:
    frequency, load = float(reading["frequency_Hz"] or 0), float(reading["load_set_N"] or 0)
    return _name(SweepCondition(frequency, load, int(reading["repeat"] or 1)))
