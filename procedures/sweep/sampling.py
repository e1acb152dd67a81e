"""Records of load cell and film at one condition: their length, their ranges and the tones in them.

The noise of earlier records determines the length of a record, in whole cycles; it is longer if
that separates a significant mains line from the tone. A range that proves too small is replaced by
a larger one. The result of each fit is learned at once, and refused if it is useless.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from procedures.sweep.settings import CHANNELS, LISTEN_S
from rig.analysis.response.complex_response import DB_PER_RELATIVE, Response, complex_response
from rig.analysis.response.levelling import (
    NEGLIGIBLE_INFLATION,
    RecordNeeds,
    affordable_inflation,
    range_for,
    record_samples,
)
from rig.analysis.response.sine_fit import LONE, SineFit, fit_sine, mains_lines
from rig.core.errors import InstrumentError
from rig.core.units import counted
from rig.instruments.roles import Acquisition, InputChannel, Record
from rig.run.trip import TripError

if TYPE_CHECKING:
    from procedures.sweep.memory import SweepMemory
    from procedures.sweep.settings import SweepCondition, SweepSettings
    from rig.run.context import Run

NO_SIGNAL_ERRORS = 5.0
"""Amplitude in standard errors below which there is no tone."""
FIRST_LOOK = 3.0
"""Error of the first record at a frequency relative to the target error."""
HARMLESS = 0.2
"""Effect of a mains line on the gain, relative to the target error, below which it is not
fitted."""
MISREAD_SIGMAS = 12.0
"""Residual of one sample, in rms of the residual, from which it does not belong to the record:
noise does not reach half of it in a million samples. One that is below moves the gain by half a
standard error at most in a record of a thousand samples, and by less in a longer one."""
MISREAD_TRIES = 3
"""Records in a row with such a sample from which it is the signal that is disturbed."""
MAINS_LINES = 5
LISTEN_MARGIN = 2.0
"""Ratio of a range to the largest value in the noise record."""


@dataclass(frozen=True)
class FittedRecord:
    """One record and the results of its fits."""

    record: Record
    load: SineFit
    """Fit of the load in newtons."""
    voltage: SineFit
    """Fit of the film's voltage in volts."""
    response: Response

    @property
    def duration_s(self) -> float:
        """Length of the record, in s."""
        return self.load.n / self.load.rate_Hz


def listen(run: Run, memory: SweepMemory) -> None:
    """Measure the noise of both channels and the mains lines in them, before anything vibrates."""
    settings, daq = run.settings, run.bench.daq
    rate = settings.listen_rate_S_s
    ranges = daq.ranges_V()
    channels = tuple(InputChannel(name, max(ranges)) for name in CHANNELS)
    while True:
        record = daq.acquire(Acquisition(channels, rate, round(LISTEN_S * rate)))
        fitting = tuple(
            InputChannel(name, range_for(abs(record.volts(name)).max(), ranges, LISTEN_MARGIN))
            for name in CHANNELS
        )
        if fitting == channels:
            break
        channels = fitting
    first, *others = mains_lines(settings.mains_Hz)
    for name in CHANNELS:
        volts = record.volts(name) / volts_per_unit(run, name)
        found = fit_sine(volts, rate, first, interference=others)
        memory.mains[name].learn(found, settings.mains_Hz)
        memory.learn_noise(name, found)


def volts_per_unit(run: Run, channel: str) -> float:
    """Return the volts per unit of a channel's tone: newtons for the load, volts for the film."""
    return run.bench.load_cell.sensitivity_V_N if channel == "load_cell" else 1.0


class RecordSampler:
    """Takes the records of one point, one after the other."""

    def __init__(self, run: Run, condition: SweepCondition, memory: SweepMemory):
        self.run, self.condition = run, condition
        self.memory = memory
        self.settings: SweepSettings = run.settings
        self.physics_s = 0.0
        """Time spent on waiting and sampling, without commands and computing."""
        self.largest_load_N = 0.0
        self._ranges: dict[str, float] = {}
        """Input ranges that proved too small, by channel: larger ones are used."""
        self._begins_with_change = False
        """True if nothing was waited for and recorded since the drive changed."""

    def drive_changed(self) -> None:
        """Take note that the next record begins with a change of the drive, unless `wait` is called
        before it."""
        self._begins_with_change = True

    def wait(self, seconds: float) -> None:
        """Wait for a change to settle."""
        self.physics_s += seconds
        self.run.clock.sleep(seconds)
        if seconds > 0:
            self._begins_with_change = False

    def take(self, needs: RecordNeeds, only_load: bool) -> FittedRecord:
        """Take one further record; one that exceeds its range is repeated on a larger range, and
        one with a sample that does not belong to it, a misread one, on the same. With `only_load`
        the mains are not fitted, and nothing is learned of the film."""
        daq, f = self.run.bench.daq, self.condition.frequency_Hz
        misread = 0
        while True:
            acquisition = self._acquisition(needs, only_load)
            record = daq.acquire(acquisition)
            self.physics_s += acquisition.samples / acquisition.rate_S_s
            if self._overloaded(record):
                continue
            load = self._fit(record, "load_cell", needs, only_load)
            voltage = self._fit(record, "film", needs, only_load)
            outlier = self._outlier(load, voltage)
            self._begins_with_change = False
            misread += outlier != ""
            if not outlier or misread == MISREAD_TRIES:
                break
        self._report_misread(misread, outlier)
        self.largest_load_N = max(self.largest_load_N, load.amplitude)
        refuse_no_load(load)
        self.memory.vibrator.learn(f, load.amplitude / self.memory.drive_V)
        refuse_overload(self.run, load)
        response = complex_response(voltage, load)
        if shows(voltage) and not only_load:
            self.memory.film.learn(f, abs(response.value))
        return FittedRecord(record, load, voltage, response)

    # --- how long -------------------------------------------------------------------------------

    def first_look(self) -> RecordNeeds:
        """Return the needs of a record that only has to show whether the point has settled."""
        own = self.settings
        return self._needs(FIRST_LOOK * own.target_error_dB, self._error_of_one_second_dB())

    def missing_after(self, sampled_s: float) -> RecordNeeds:
        """Return the needs of the next record to reach the target together with `sampled_s` of
        valid records."""
        own, target = self.settings, self.settings.target_error_dB
        error = self._error_of_one_second_dB()
        if error is not None:
            missing_s = (error / target) ** 2 - sampled_s
            shortest_s = own.shortest_at(self.condition.frequency_Hz)
            target = error / math.sqrt(max(missing_s, shortest_s))
        return self._needs(target, error)

    @functools.cached_property
    def whole_length_s(self) -> float:
        """Return the length of a single record that would reach the target, as known at first."""
        f = self.condition.frequency_Hz
        rate = self.settings.rate_at(f)
        return record_samples(f, rate, self.missing_after(0.0), self._all_mains()) / rate

    @functools.cached_property
    def expected_error_dB(self) -> float:  # noqa: N802 - the unit keeps its capital
        """Return the standard error of the gain from that record: the target, or less where whole
        cycles or the mains make it longer than the noise asks for."""
        target, error = self.settings.target_error_dB, self._error_of_one_second_dB()
        return target if error is None else min(target, error / math.sqrt(self.whole_length_s))

    def _needs(self, target_dB: float, error_dB: float | None) -> RecordNeeds:
        own = self.settings
        shortest_s = own.shortest_at(self.condition.frequency_Hz)
        return RecordNeeds(shortest_s, own.longest_point_s, target_dB, error_dB)

    def _error_of_one_second_dB(self) -> float | None:  # noqa: N802 - the unit keeps its capital
        """Return the standard error of the gain from one second; None while film or noise are
        unknown."""
        lo, memory = self.condition.load_N, self.memory
        film = memory.film.at(self.condition.frequency_Hz)
        if film is None or not memory.error_of_one_second:
            return None
        load_error = memory.error_of_one_second["load_cell"] / lo
        film_error = memory.error_of_one_second["film"] / (film * lo)
        return DB_PER_RELATIVE * math.hypot(load_error, film_error)

    # --- how ------------------------------------------------------------------------------------

    def _acquisition(self, needs: RecordNeeds, only_load: bool) -> Acquisition:
        f = self.condition.frequency_Hz
        rate = self.settings.rate_at(f)
        samples = record_samples(f, rate, needs, [] if only_load else self._all_mains())
        ranges = self.run.bench.daq.ranges_V()
        channels = []
        for name in CHANNELS:
            size = self._expected(name)
            if name == "load_cell":
                size = max(size, self.largest_load_N)
            suits = [r for r in ranges if r > self._ranges.get(name, 0.0)] or [max(ranges)]
            amplitude_V = size * volts_per_unit(self.run, name)
            channels.append(InputChannel(name, range_for(amplitude_V, suits)))
        return Acquisition(tuple(channels), rate, samples)

    def _expected(self, channel: str) -> float:
        """Return the expected amplitude of a channel in its unit; 0 for an unknown film."""
        lo = self.condition.load_N
        if channel == "load_cell":
            return lo
        return (self.memory.film.at(self.condition.frequency_Hz) or 0.0) * lo

    def _overloaded(self, record: Record) -> bool:
        """Return whether a channel was at the end of its range and there is a larger range."""
        again = False
        for name, range_V in zip(record.scaling.channels, record.scaling.range_V, strict=True):
            if not record.clipped(name):
                continue
            if range_V >= max(self.run.bench.daq.ranges_V()):
                refuse_saturation(record, name, range_V, self.condition.frequency_Hz)
            self._ranges[name] = range_V
            again = True
        return again

    # --- the tones in it ------------------------------------------------------------------------

    def _fit(self, record: Record, channel: str, needs: RecordNeeds, only_load: bool) -> SineFit:
        mains_Hz = self.settings.mains_Hz
        duration_s = len(record.counts) / record.scaling.rate_S_s
        strong = self.strong_mains(channel)
        # A weak line is fitted only where fitting it costs next to nothing.
        limit = NEGLIGIBLE_INFLATION
        if strong and not only_load:
            limit = affordable_inflation(needs, duration_s)
        lines: Sequence[float] = mains_lines(mains_Hz, MAINS_LINES)
        if not strong and duration_s * mains_Hz < 1:
            lines = ()  # Less than a period of weak mains cannot be distinguished from an offset.
        found = fit_sine(
            record.volts(channel) / volts_per_unit(self.run, channel),
            record.scaling.rate_S_s,
            self.condition.frequency_Hz,
            interference=lines,
            bounds=self.memory.mains[channel].bounds(mains_Hz, MAINS_LINES),
            delay_s=record.delay_s(channel),
            largest_inflation=limit,
        )
        if not self._is_misread(found):
            self.memory.mains[channel].learn(found, mains_Hz)
        return found

    def _outlier(self, load: SineFit, voltage: SineFit) -> str:
        """Return which channel has a sample that does not belong to its record; "" for none."""
        channels = (("load_cell", load), ("film", voltage))
        return ", ".join(name for name, found in channels if self._is_misread(found))

    def _is_misread(self, found: SineFit) -> bool:
        """Return whether a sample of a record does not belong to it.

        The first ones after a change of the drive may differ: a short record is compared with the
        one that follows, and a long one averages over them.
        """
        if self._begins_with_change and found.lone_at < LONE:
            return False
        return found.lone_residual > MISREAD_SIGMAS * found.residual_rms

    def _report_misread(self, misread: int, outlier: str) -> None:
        """Record what became of records with such a sample."""
        if not misread:
            return
        again = misread - (outlier != "")
        at = f"at {self.condition.frequency_Hz:g} Hz"
        text = f"{counted(again, 'record')} {at} repeated: a sample did not belong to it"
        if outlier:
            text = (
                f"{misread} records {at} in a row have samples far beyond their noise ({outlier}): "
                "the signal is disturbed; the last one is used, and its error contains them"
            )
        self.run.event("warning", "misread-record", text)

    def strong_mains(self, channel: str) -> list[float]:
        """Return the mains lines that could matter to a channel, in Hz."""
        own = self.settings
        harmless = HARMLESS * own.target_error_dB / DB_PER_RELATIVE * self._expected(channel)
        return self.memory.mains[channel].strong(own.mains_Hz, MAINS_LINES, harmless)

    def _all_mains(self) -> list[float]:
        return sorted({line for channel in CHANNELS for line in self.strong_mains(channel)})


# --- faults -------------------------------------------------------------------------------------


def shows(tone: SineFit) -> bool:
    """Return whether a tone is more than noise."""
    return tone.amplitude > NO_SIGNAL_ERRORS * tone.standard_error


def refuse_no_load(load: SineFit) -> None:
    """Raise InstrumentError for a vibrator that does not drive or a load cell that does not
    measure."""
    if not shows(load):
        remedy = "check generator, vibrator amplifier and load cell, and their cables"
        raise _only_noise(load, "load_cell", "load", "N", remedy)


def refuse_silence(voltage: SineFit) -> None:
    """Raise InstrumentError for a film without a signal: torn, unclamped or not connected."""
    if not shows(voltage):
        remedy = "check that the film is clamped, whole and connected to its amplifier"
        raise _only_noise(voltage, "film", "signal", "V", remedy)


def _only_noise(tone: SineFit, device: str, what: str, unit: str, remedy: str) -> InstrumentError:
    return InstrumentError(
        device,
        f"{what} at {tone.frequency_Hz:g} Hz",
        f"{tone.amplitude:.2g} {unit} with a standard error of {tone.standard_error:.2g} {unit} "
        "is no more than noise",
        remedy,
    )


def refuse_overload(run: Run, load: SineFit) -> None:
    """Raise TripError for a load above the limit of the load cell."""
    limit = run.bench.load_cell.max_load_N
    if load.amplitude > limit:
        raise TripError(
            f"load {load.amplitude:.3g} N at {load.frequency_Hz:g} Hz is over the limit of "
            f"{limit:g} N of the load cell",
            "choose a smaller load",
        )


def refuse_saturation(record: Record, channel: str, range_V: float, frequency_Hz: float) -> None:
    """Raise InstrumentError for a clipped record: a fit of it would look good and be wrong."""
    raise InstrumentError(
        "daq",
        f"channel {channel} at {frequency_Hz:g} Hz",
        f"{record.clipped(channel)} of {len(record.counts)} samples are at the end of the "
        f"{range_V:g} V range",
        "choose a smaller load, or a smaller gain of the amplifier",
    )


def warn_of_mains(run: Run, found: SineFit, strong: Sequence[float]) -> None:
    """Warn of a strong mains line that cannot be separated from the tone."""
    for line in set(found.unresolved_Hz) & set(strong):
        run.event(
            "warning",
            "mains",
            f"{found.frequency_Hz:g} Hz is too close to the mains line at {line:g} Hz for a record "
            f"of {found.n / found.rate_Hz:.3g} s: the mains cannot be separated from the signal",
        )
