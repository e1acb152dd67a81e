"""The measurement of one point of a sweep: find the drive for the load, then record until the gain
is known.

The drive is predicted from the vibrator's response at frequencies nearby, and corrected if the load
is wrong. No time constant is assumed: records are valid once two successive ones agree, and if
ringing was seen to decay, the decay itself determines how much longer to wait. A record that has to
be long because of noise averages over all ringing.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from procedures.sweep.layout import reading_of
from procedures.sweep.sampling import FittedRecord, RecordSampler, refuse_silence, warn_of_mains
from procedures.sweep.settings import LONG_RECORD_S
from rig.analysis.response.complex_response import DB_PER_RELATIVE
from rig.analysis.response.levelling import (
    AGREEMENT_SIGMAS,
    RecordNeeds,
    agreement,
    combined,
    quieter_noise,
)
from rig.analysis.response.static_force import static_force
from rig.core.errors import InstrumentError, LimitError

if TYPE_CHECKING:
    from procedures.sweep.memory import SweepMemory
    from procedures.sweep.settings import SweepCondition, SweepSettings
    from rig.analysis.response.sine_fit import SineFit
    from rig.run.context import Run
    from rig.run.points import Reading

# --- the drive ---
CAUTION = 0.1
"""Fraction of the wanted load at a frequency of which nothing is known."""
TRUSTED_PREDICTION_ERROR = 0.003
"""Relative error of the last prediction of the load from which the next one is trusted."""
LOOK_BEFORE_S = 0.1
"""Length of a record that is not begun with an uncertain drive: a short record checks the load
first."""
KEPT_WITHIN = 0.75
"""Fraction of the load's tolerance above which the drive is corrected."""
FAR_OFF = 0.25
"""Relative error of a load after which the corrected drive is not trusted either."""
BOLDEST_CORRECTION = 20.0
"""Largest increase of the drive in one step, whatever the load cell reads: it may be half
unplugged."""
LARGEST_CORRECTION = 1.4
"""Largest correction of a drive that was predicted from nearby: a larger one means a bad record."""

# --- waits after a change ---
LARGE_STEP = 1.5
"""Ratio of the new drive to the one before beyond which no record averages over the ringing."""
LEAP = 1.1
"""Ratio of two successive frequencies beyond which everything rings again."""
LEAP_S = 0.02
"""Wait after such a leap if the record is too short to average over the ringing."""
RINGING_S = 0.015
"""Shortest wait before a record that averages over ringing, after a change of frequency."""
CORRECTED_S = 0.008
"""The same after a correction of the drive."""

# --- settling -----------------
AGREEMENT = 2e-4
"""Relative difference of the responses of two successive records, beyond their noise, up to which
they are settled."""
LOAD_AGREEMENT = 2.4e-3
"""The same of the loads, which need not be as steady: only their ratio to the voltage matters."""
CLEAR_RINGING = 2.0
"""Ratio of the first difference to the visible one above which it is ringing and not noise."""
FORGETS = 0.9
"""Share of the time constant of earlier ringing that a point with faster ringing leaves."""
SUNK = 0.2
"""Ringing in the valid records that does not matter, in standard errors of a record."""
SILENCE_S = 2.0
"""Time at a point after which a film without a signal is reported."""

FITTED_PARAMETERS = 7
"""Parameters of a fit, the same for all records: offset, the tone, two mains lines."""


class SweepPointRun:
    """The measurement of one point: the drive, the valid records, and the length of the next
    one."""

    def __init__(self, run: Run, condition: SweepCondition, memory: SweepMemory):
        self.run, self.condition = run, condition
        self.memory = memory
        self.settings: SweepSettings = run.settings
        self.kept: list[FittedRecord] = []
        """Successive records at the present drive."""
        self._sampler = RecordSampler(run, condition, memory)
        self._begun_s = run.clock.now()
        self._driven_s = 0.0
        """Time at which the drive was changed."""
        self._seen_ringing: tuple[float, float] | None = None
        """Time at which two successive records first differed clearly since that change, and their
        difference."""
        self._outlasted = False
        """True after the wait for that ringing to decay."""
        self._leapt = False
        """True if the drive was changed so much that the ringing is large compared with the
        tone."""
        self._predicted = False
        """True if the drive was predicted from frequencies nearby."""
        self._looking = False
        """True if the next record only has to check the load, whose prediction is not trusted."""
        self._latest_N = math.nan
        """Load of the latest record; NaN before the first."""
        self._kept_since_s = self._begun_s
        """Time at which the first of the valid records began."""
        self._differed = math.nan
        """Relative difference of the latest two records that did not agree."""

    # --- the phases -----------------------------------------------------------------------------

    def follow_preload(self) -> None:
        """Follow the film's creep before the vibration is changed, and wait for the stage: a force
        that changes during a record has no single value."""
        self._sampler.wait(self.memory.follow_preload(self.run))

    def drive_as_predicted(self) -> None:
        """Set the drive that should give the load, or a fraction of it if nothing is known; then
        wait as the settings require."""
        f, lo = self.condition.frequency_Hz, self.condition.load_N
        gain = self.memory.vibrator.at(f)
        costly = self._averages() and self._sampler.whole_length_s > LOOK_BEFORE_S
        self._looking = self.memory.surprise > TRUSTED_PREDICTION_ERROR and costly
        if gain is None:
            self._drive(self.settings.first_amplitude_V)
        else:
            self._predicted = self.memory.vibrator.near(f)
            self._drive_for_load((1.0 if self._predicted else CAUTION) * lo / gain)
        self._sampler.wait(self.settings.settling_s)

    def sample(self) -> None:
        """Take one further record at the present drive."""
        if not self.kept:
            self._kept_since_s = self.run.clock.now()
        sampled = self._sampler.take(self._needs(), only_load=self._looking)
        self.kept.append(sampled)
        if math.isnan(self._latest_N):
            self.memory.surprise = abs(sampled.load.amplitude / self.condition.load_N - 1)
        self._latest_N = sampled.load.amplitude

    def is_over(self) -> bool:
        """Return whether load and film are steady and the gain is known well enough; if not,
        correct the drive or wait for the ringing to decay. A point that takes too long is over if
        it is steady.

        Raises InstrumentError if it takes too long and was never steady.
        """
        late = self._is_late()
        if self._is_level() and (self._is_settled() or (late and self._last_is_steady())):
            if self._sampler.physics_s > SILENCE_S:
                refuse_silence(self.kept[-1].voltage)
            return self._is_known() or late
        if late:
            self._refuse_restless()
        return False

    def _is_late(self) -> bool:
        """Return whether the point has taken longer than it may."""
        return self.run.clock.now() - self._begun_s > self.settings.longest_point_s

    def reading(self) -> Reading:
        """Record the valid samples and return the reading."""
        run, condition, kept, sampler = self.run, self.condition, self.kept, self._sampler
        for sampled in kept:
            run.streams.record_raw("waveform", sampled.record)
        last = kept[-1]
        refuse_silence(last.voltage)
        warn_of_mains(run, last.voltage, sampler.strong_mains("film"))
        self.memory.learn_noise("load_cell", last.load)
        self.memory.learn_noise("film", last.voltage)
        response = combined([sampled.response for sampled in kept])
        preload_N, preload_error_N = self._static_force(last.load)
        return reading_of(response, last.load, last.voltage, run.elapsed_s()) | {
            "load_set_N": condition.load_N,
            "repeat": condition.repeat,
            "drive_V": self.memory.drive_V,
            "degrees": sum(sampled.load.n - FITTED_PARAMETERS for sampled in kept),
            "records": len(kept),
            "taken_s": run.clock.now() - self._begun_s,
            "physics_s": sampler.physics_s,
            "largest_load_N": sampler.largest_load_N,
            "preload_N": preload_N,
            "preload_error_N": preload_error_N,
            **self.memory.preload.zero.columns(run.force.axes),
            **self.memory.film_truth(run),
        }

    def _static_force(self, load: SineFit) -> tuple[float, float]:
        """Return the static force during the valid records and its standard error, in N."""
        force = self.run.force
        frames_N = force.latest_N(self.run.clock.now() - self._kept_since_s)[:, 2].astype(float)
        return static_force(frames_N, force.rate_S_s, self.condition.frequency_Hz, load.amplitude)

    # --- the drive ------------------------------------------------------------------------------

    def _drive_for_load(self, amplitude_V: float) -> None:
        """Drive with what the load needs. Raises LimitError, which names the load, where the
        generator cannot give that."""
        try:
            self._drive(amplitude_V)
        except LimitError as error:
            raise LimitError(
                f"a load of {self.condition.load_N:g} N (--load, --loads) needs what the generator "
                f"cannot give: {error.message}",
                "choose another load, or another gain of the vibrator's amplifier; check that the "
                "load cell shows the load; or correct the bench file if the limit is wrong",
            ) from error

    def _drive(self, amplitude_V: float) -> None:
        memory, f, clock = self.memory, self.condition.frequency_Hz, self.run.clock
        self.run.bench.generator.sine(f, amplitude_V)
        self._sampler.drive_changed()
        changed = f != memory.frequency_Hz
        leapt = not 1 / LEAP < f / memory.frequency_Hz < LEAP
        ratio = amplitude_V / memory.drive_V
        # How long a correction rings is unknown while nothing was seen to ring: records show it.
        unknown = not changed and memory.decay_s is None
        self._leapt = self._leapt or unknown or not 1 / LARGE_STEP < ratio < LARGE_STEP
        memory.change_vibration(f, amplitude_V, clock.now())
        self.kept.clear()
        if leapt and not self._averages():
            self._sampler.wait(LEAP_S)
        self._driven_s = clock.now()
        self._seen_ringing = None
        self._outlasted = False
        if self._averages() and changed:
            self._sampler.wait(max(RINGING_S, self._rings_on_s(1.0)))
        elif self._averages():
            self._sampler.wait(max(CORRECTED_S, self._rings_on_s(abs(ratio - 1))))

    def _rings_on_s(self, change: float) -> float:
        """Return the time in s until ringing as large as `change` times the tone no longer matters
        in one record.

        A record averages over ringing only where that is far from the tone. In a notch, or near
        the vibrator's resonance, both have nearly one frequency, and the record dilutes it at best,
        by the ratio of time constant and length. The time constant is that of the latest ringing
        that was seen to decay.
        """
        decay_s = self.memory.decay_s
        if decay_s is None:
            return 0.0
        diluted = change * decay_s / self._sampler.whole_length_s
        allowed = SUNK * self._sampler.expected_error_dB / DB_PER_RELATIVE
        return decay_s * math.log(max(diluted / allowed, 1.0))

    def _is_level(self) -> bool:
        """Return whether the load is within its tolerance; if not, correct the drive."""
        lo = self.condition.load_N
        load = self.kept[-1].load
        if abs(load.amplitude / lo - 1) <= self._tolerance(load):
            return True
        self._looking = self._looking and abs(load.amplitude / lo - 1) > FAR_OFF
        correction = min(lo / load.amplitude, BOLDEST_CORRECTION)
        if self._predicted:
            correction = min(max(correction, 1 / LARGEST_CORRECTION), LARGEST_CORRECTION)
        self._drive_for_load(self.memory.drive_V * correction)
        return False

    def _tolerance(self, load: SineFit) -> float:
        """Return the largest allowed deviation of the load; the noise of a short record is not a
        deviation."""
        noise = 2 * load.standard_error / self.condition.load_N
        return min(max(KEPT_WITHIN * 1e-2 * self.settings.load_tolerance_percent, noise), 5e-2)

    # --- settling -------------------------------------------------------------------------------

    def _averages(self) -> bool:
        """Return whether one record averages over all ringing."""
        return self._sampler.whole_length_s >= LONG_RECORD_S and not self._leapt

    def _needs(self) -> RecordNeeds:
        """Return the length that the next record needs in addition to the valid ones."""
        if not self.kept and not (self._outlasted or self._averages()):
            return self._sampler.first_look()
        return self._sampler.missing_after(sum(sampled.duration_s for sampled in self.kept))

    def _is_settled(self) -> bool:
        """Return whether the last two records agree; drop the earlier ones if they do not."""
        if self._looking:  # It was too short to be valid.
            self._looking = False
            self.kept.clear()
            return False
        if self._averages() or self._outlasted:
            return True
        if len(self.kept) < 2:
            return False
        visible = self._visible_difference()
        if self._agree(visible):
            self._outlast_ringing(visible)
            return bool(self.kept)
        before, last = (sampled.response.value for sampled in self.kept[-2:])
        self._differed = abs(before / last - 1)
        if self._seen_ringing is None and abs(before - last) > CLEAR_RINGING * visible:
            self._seen_ringing = (self.run.clock.now(), abs(before - last))
        self._begin_again_with_last()
        return False

    def _begin_again_with_last(self) -> None:
        """Drop all records but the last."""
        self._kept_since_s = self.run.clock.now() - self.kept[-1].duration_s
        del self.kept[:-1]

    def _visible_difference(self) -> float:
        """Return the difference of the last two responses, in V/N, that noise hides."""
        before, last = self.kept[-2:]
        return agreement(before.response, last.response, AGREEMENT, (before.load.n, last.load.n))

    def _agree(self, visible: float) -> bool:
        """Return whether load and response of the last two records are equal within their noise."""
        before, last = self.kept[-2:]
        difference_N = abs(before.load.amplitude - last.load.amplitude)
        noise_N = AGREEMENT_SIGMAS * quieter_noise(
            [each.load.standard_error**2 for each in (before, last)],
            [each.load.n for each in (before, last)],
        )
        if difference_N > LOAD_AGREEMENT * last.load.amplitude + noise_N:
            return False
        return abs(before.response.value - last.response.value) <= visible

    def _outlast_ringing(self, visible: float) -> None:
        """Wait until ringing no longer matters, after two records whose difference is below
        `visible`.

        The time from the first difference to one below `visible` gives the longest possible time
        constant. If ringing was below the noise all the time, the time constant of the latest one
        that was seen is used: it may be just below what can be seen, and not small.
        """
        now, last = self.run.clock.now(), self.kept[-1]
        if self._seen_ringing is not None:
            since_s, first = self._seen_ringing
            shown_s = (now - since_s) / math.log(max(first / visible, CLEAR_RINGING))
            # Beats of two resonances may agree too early, and then seem to decay too fast.
            self.memory.decay_s = max(shown_s, FORGETS * (self.memory.decay_s or 0.0))
        self._seen_ringing = None
        if self.memory.decay_s is None:
            return
        error = math.sqrt(float(last.response.covariance.trace()) / 2)
        decay_s = self.memory.decay_s
        # Two records a duration apart differ by 1 - fall of the ringing in the first.
        fall = math.exp(-last.duration_s / decay_s)
        ringing = visible * fall**2 / (1 - fall)  # in the next record
        rest_s = decay_s * math.log(max(ringing / (SUNK * error), 1.0))
        if rest_s > 0 and not self._is_late():
            self._sampler.wait(min(rest_s, now - self._driven_s))
            self.kept.clear()
            self._outlasted = True

    def _last_is_steady(self) -> bool:
        """Return whether both halves of the last record agree: a long one shows by itself that
        nothing rings, and the record before it may have differed by chance."""
        if not self.kept:
            return False
        last = self.kept[-1]
        if last.voltage.block_phasors.size < 2:
            return False
        parts = last.voltage.block_phasors / last.load.block_phasors
        half = parts.size // 2
        difference = abs(parts[:half].mean() - parts[-half:].mean())
        noise = 2 * math.sqrt(float(last.response.covariance.trace()))  # of half a record, twice
        return bool(difference <= AGREEMENT * abs(last.response.value) + AGREEMENT_SIGMAS * noise)

    def _is_known(self) -> bool:
        """Return whether the noise of the gain is below the target; the first record, which may
        contain the end of the ringing, is left out if that suffices. What mains lines leak is not
        noise: more records of the same length would not remove it."""
        target = self.settings.target_error_dB
        for kept in (self.kept[1:], self.kept):
            if not kept:
                continue
            together = combined([sampled.response for sampled in kept])
            if together.gain_noise_dB <= target:
                self.kept = list(kept)
                return self._load_is_right()
        return False

    def _load_is_right(self) -> bool:
        """Return whether the records' mean load is within the tolerance: their noise averages
        out."""
        mean = sum(s.load.amplitude for s in self.kept) / len(self.kept)
        return abs(mean / self.condition.load_N - 1) <= 1e-2 * self.settings.load_tolerance_percent

    def _refuse_restless(self) -> None:
        """Raise InstrumentError: the time limit has passed and the load was never right and
        steady."""
        lo, percent = self.condition.load_N, self.settings.load_tolerance_percent
        if abs(self._latest_N / lo - 1) > 1e-2 * percent:
            raise InstrumentError(
                "generator",
                f"load at {self.condition.frequency_Hz:g} Hz",
                f"{self._latest_N:.4g} N after {self.settings.longest_point_s:g} s, {lo:g} N "
                f"± {percent:g} % wanted (--longest-point, --load-tolerance)",
                "check the vibrator's line for something loose, or allow more time and tolerance",
            )
        if not self.kept:
            raise InstrumentError(
                "daq",
                f"response at {self.condition.frequency_Hz:g} Hz under {lo:g} N",
                f"not measured within {self.settings.longest_point_s:g} s (--longest-point): the "
                "first look at the load has taken all of it",
                "allow more time (--longest-point), or choose a higher frequency",
            )
        raise InstrumentError(
            "daq",
            f"response at {self.condition.frequency_Hz:g} Hz under {lo:g} N",
            f"not steady after {self.settings.longest_point_s:g} s (--longest-point): two "
            f"successive records differ by {100 * self._differed:.2g} %, more than their noise",
            "check film, clamp and vibrator for something loose, choose a larger load, or allow "
            "more time",
        )
