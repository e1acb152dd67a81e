"""The record of a trial with the skin pressed on an object, and its reading: servo, clocks, whether
it is valid."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from procedures.pressed.approach.earlier_runs import EarlierPress
from procedures.pressed.approach.tare import ForceZero
from procedures.pressed.points import point_name
from procedures.pressed.record.layout import TOUCHED
from procedures.pressed.record.lost_frames import lost_frames
from procedures.pressed.record.squeeze import STALE_S, Squeeze
from procedures.pressed.settings import AFTER_S, PressedSettings
from rig.analysis.trial.clock_offset import clock_offset
from rig.analysis.trial.touch_down import TouchDownError, TouchRecord
from rig.analysis.trial.touch_gain import touch_gain
from rig.bench.settings import STRIPS
from rig.detector.notices import columns_of
from rig.files.journal.detections import SLIP, Detection, to_text
from rig.run.press_references import TouchGain

if TYPE_CHECKING:
    import numpy.typing as npt

    from rig.analysis.trial.load_rate import LoadScale
    from rig.control.tick_loop import LoopStatistics
    from rig.detector.notices import Notice
    from rig.run.context import Run
    from rig.run.points import Reading

CONTACT_N = 0.1
"""Force that means contact: ten times the sensor's noise over a look."""
DECIMATED_Hz = 1000.0
MISSING_S = 0.05
"""Length in s of samples or frames that may still be under way when a record ends."""
SERVO_ERROR_S = 0.005
"""Stretch over which the error of the force is averaged, in an odd number of frames."""
ZERO_SHIFT_N, ZERO_SHIFT = 0.1, 0.03
"""Largest change of the force sensor's zero within a valid trial, and as a share of the normal
force; the larger of both is the bound."""
OLDEST_LOOK = 5
"""Longest time for which an axis may not be seen in its motion, in intervals from one look at it to
the next: 0.05 s at the usual 100 looks a second. What moves at 6 mm/s goes 0.3 mm meanwhile."""
HELD_BACK = 0.5
"""Share of the ticks without a new target for z beyond which there is a warning."""
SQUEEZED_S = 0.1
"""Time after a squeeze in which the force is on its way to the new set point and is not judged."""
AT_REST_S = 0.2
"""Beginning of a record, before contact: the strips' zero is its mean."""
CLOCKS_SEEN_S, CLOCKS_SEARCHED_S = 0.1, 0.2
"""Time in s beyond touch-down and tap over which the two clocks are compared, and their largest
assumed offset."""


@dataclass
class TrialRecord:
    """The record of a trial so far; times in s since the record began."""

    number: int
    tick_Hz: float
    """Ticks of the servo."""
    force_rate_S_s: float
    """Frames a second, as the force sensor reported."""
    normal_force_N: float
    """Set point of the normal force that the trial presses with."""
    begun_s: float = 0.0
    """Time on the run's clock at which the record began."""
    filter_delay_s: float = 0.0
    zero: ForceZero = field(default_factory=ForceZero)
    """Zero of the force sensor, before the skin touched anything."""
    zero_shift_N: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Force along x, y, z that the sensor reads after the lift, relative to `zero`."""
    contact_mm: float = 0.0
    stiffness_N_mm: float = 0.0
    tapped_s: float = 0.0
    """End of the tap."""
    set_points: list[tuple[float, float]] = field(default_factory=list)
    """Times in s, since the record began, at which the set point of the normal force was changed,
    and the force in N from there on."""
    rested: list[tuple[float, float]] = field(default_factory=list)
    """Begin and end, in s since the record began, of the stretches in which z stayed where it was
    and the force was not controlled."""
    motion_from_s: float = 0.0
    motion_to_s: float = 0.0
    volts: list[npt.NDArray[np.float64]] = field(default_factory=list)
    """Strips at 1 kHz, (n, 2) each."""
    force: list[npt.NDArray[np.float64]] = field(default_factory=list)
    """F_n, F_t, F_y, (n, 3) each."""
    position: list[tuple[float, float, float, float, float]] = field(default_factory=list)
    """Time, z, x, z commanded, x commanded."""
    ages_s: list[tuple[float, ...]] = field(default_factory=list)
    """Age of every position of a row at the row's time: z, x, and those of further axes."""
    unseen_s: dict[str, float] = field(default_factory=dict)
    """Longest time in s for which an axis was not seen in its motion, by its role."""
    look_every_s: float = math.inf
    """Time in s from one look at the axes to the next."""
    rows: int = 0
    """Rows of the strips' signals."""
    signal_rows: int = 0
    clipped: dict[str, int] = field(default_factory=lambda: dict.fromkeys(STRIPS, 0))
    """Samples of each strip at either end of the DAQ's range."""
    frames: int = 0
    frame_looks: list[tuple[float, int]] = field(default_factory=list)
    """Times on the run's clock, and the frames that had come by then since the record began; some
    of them after its end."""
    misread: int = 0
    """Positions that could not be and were asked for again."""
    held_back: int = 0
    """Ticks of the servo without a new target: the drive had not answered to what came before."""
    loops: list[LoopStatistics] = field(default_factory=list)
    detections: list[Detection] = field(default_factory=list)
    """What the detector has found."""
    notices: list[Notice] = field(default_factory=list)
    """What was commanded and cut off, as the detector was given it."""
    squeezes: list[Squeeze] = field(default_factory=list)
    """Rises of the set point by the grip (`procedures.pressed.grip`)."""
    detection_ended: bool = False
    """Whether the detector was not used any more when the motion ended."""
    unanswered: list[float] = field(default_factory=list)
    """Times in s, since the record began, of alarms that the grip did not answer."""

    @property
    def tick_count(self) -> int:
        """Ticks that were due in all loops."""
        return sum(loop.ticks for loop in self.loops)

    @property
    def late_ticks(self) -> int:
        """Ticks that began late or were left out, in all loops."""
        return sum(loop.late for loop in self.loops)

    @property
    def alarms(self) -> list[Detection]:
        """Slips that were detected in the motion, as far as it has come."""
        to_s = math.inf if self.moves else self.motion_to_s
        return [
            one
            for one in self.detections
            if one.kind == SLIP and self.motion_from_s <= one.time_s <= to_s
        ]

    def latest_alarm_s(self, answered: int) -> float:
        """Return the longest time in s from the sample of one of the first `answered` alarms in the
        motion until the program had it; 0 without one."""
        first = sorted(self.alarms, key=lambda one: one.time_s)[:answered]
        return max((one.decided_s - one.time_s for one in first), default=0.0)

    @property
    def point(self) -> str:
        """Name of the trial's point."""
        return point_name(self.number)

    @property
    def moves(self) -> bool:
        """True while the motion is under way."""
        return self.motion_from_s > self.motion_to_s

    def note_unseen(self, axis: str, unseen_s: float, every_s: float) -> None:
        """Note that an axis in motion, looked at `every_s`, has not been seen for `unseen_s`."""
        self.unseen_s[axis] = max(unseen_s, self.unseen_s.get(axis, 0.0))
        self.look_every_s = every_s

    def forces_N(self) -> npt.NDArray[np.float64]:  # noqa: N802 - the unit keeps its capital
        """Return the F_n, F_t, F_y of every frame, (n, 3)."""
        return np.concatenate(self.force)

    def looks_at_x(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Return the times in s and the positions of x in mm, (n,) each: one for every look, at the
        look's own time."""
        rows, ages_s = np.array(self.position), np.array(self.ages_s)
        times_s, first = np.unique(rows[:, 0] - ages_s[:, 1], return_index=True)
        return times_s, rows[first, 2]

    def frame_times_s(self) -> npt.NDArray[np.float64]:
        """Return times at which the frames came, (n,)."""
        return np.arange(sum(len(block) for block in self.force)) / self.force_rate_S_s

    def set_force_N(  # noqa: N802 - the unit keeps its capital
        self, times_s: npt.NDArray[np.float64]
    ) -> npt.NDArray[np.float64]:
        """Return the set point of the normal force at times (n,) since the record began, (n,)."""
        changed_s = [at_s for at_s, _ in self.set_points]
        forces_N = np.array([self.normal_force_N, *(force_N for _, force_N in self.set_points)])
        wanted_N: npt.NDArray[np.float64] = forces_N[
            np.searchsorted(changed_s, times_s, side="right")
        ]
        return wanted_N

    def load_rates(self, scales: Mapping[str, LoadScale]) -> npt.NDArray[np.float64]:
        """Return the rate of load on each strip in N/s at 1 kHz, (n, 2); NaN where a strip has no
        scale."""
        volts = np.concatenate(self.volts)
        rates = np.full_like(volts, np.nan)
        for column, strip in enumerate(STRIPS):
            if strip in scales:
                zero_V = float(volts[: round(AT_REST_S * DECIMATED_Hz), column].mean())
                rates[:, column] = scales[strip].rate_N_s(volts[:, column], zero_V)
        return rates

    @staticmethod
    def load_scales(scales: Mapping[str, LoadScale]) -> Reading:
        """Return the scales for the table of trials."""
        reading: Reading = {}
        for number, strip in enumerate(STRIPS, 1):
            factor = scales[strip].N_s_per_V if strip in scales else None
            error = None if factor is None else factor.standard_error
            reading[f"load_scale_{number}_N_s_V"] = None if factor is None else factor.value
            reading[f"load_scale_{number}_error_N_s_V"] = error
        flat = [scale.flat_to_Hz for scale in scales.values() if np.isfinite(scale.flat_to_Hz)]
        reading["load_rate_flat_to_Hz"] = min(flat, default=None)
        return reading


def reading_of(run: Run, record: TrialRecord) -> Reading:
    """Return the reading of a trial: how the force was held during the motion, the quality of the
    record, both clocks, the truth of a simulated bench; and the reason why the trial is invalid, if
    it is (``invalid``)."""
    settings: PressedSettings = run.settings
    force = record.forces_N()
    reading: Reading = {
        "trial": record.number,
        **record.zero.columns(run.force.axes),
        "contact_mm": record.contact_mm,
        "stiffness_N_mm": record.stiffness_N_mm,
        **_held_force(record, force),
        **_completeness(record),
        "detector": settings.detector,
        "detections": to_text(record.detections),
        **columns_of(record.notices),
    }
    _warn_of_z(run, record)
    _warn_of_clipping(run, record)
    run.check_stop()  # computing takes a while: still alive
    reading |= _touch_down(run, record, force)
    run.check_stop()
    if truth := run.clock.truth():
        begun_us = round(1e6 * record.begun_s)
        reading["simulated_truth"] = json.dumps({**truth, "record_begun_us": begun_us})
    late_share = record.late_ticks / max(record.tick_count, 1)
    reading["invalid"] = "; ".join(_doubts(settings, record, reading, late_share))
    return reading


def _held_force(record: TrialRecord, force: npt.NDArray[np.float64]) -> Reading:
    """Return how well F_n of `force` (n, 3) followed its set point in the motion, outside the rises
    by the grip and the times in which z was to rest."""
    t = record.frame_times_s()
    held = (t >= record.motion_from_s) & (t <= record.motion_to_s)
    error = 100 * (_smoothed(force[:, 0], record.force_rate_S_s) / record.set_force_N(t) - 1)
    judged = held.copy()
    for squeeze in record.squeezes:
        judged &= (t < squeeze.decided_s) | (t > squeeze.decided_s + SQUEEZED_S)
    if not judged.any():
        judged = held.copy()
    for from_s, to_s in record.rested:
        judged &= (t < from_s) | (t > to_s + SQUEEZED_S)
    errors = error[judged]
    return {
        "set_normal_force_N": record.normal_force_N,
        "overshoot_percent": max(0.0, float(error[t < record.motion_from_s].max())),
        "mean_normal_force_N": float(force[held, 0].mean()),
        "force_error_rms_percent": float(np.sqrt(np.mean(errors**2))) if len(errors) else None,
        "force_error_peak_percent": float(np.abs(errors).max()) if len(errors) else None,
    }


def _completeness(record: TrialRecord) -> Reading:
    """Return how many rows, frames, ticks and looks at the stages the record has, and which of them
    are missing or late."""
    return {
        "samples": record.rows,
        "frames": record.frames,
        "lost_frames": lost_frames(record.frame_looks, record.force_rate_S_s),
        "tick_Hz": record.tick_Hz,
        "ticks": record.tick_count,
        "late_ticks": record.late_ticks,
        "missed_ticks": sum(loop.missed for loop in record.loops),
        "held_back_ticks": record.held_back,
        "largest_lateness_s": max(loop.largest_lateness_s for loop in record.loops),
        "misread_positions": record.misread,
        "oldest_look_s": max(record.unseen_s.values(), default=None),
        "filter_delay_s": record.filter_delay_s,
    }


def _warn_of_z(run: Run, record: TrialRecord) -> None:
    """Warn of a z that was often busy, and of positions that cannot have been."""
    ticks = record.tick_count
    if record.held_back > HELD_BACK * ticks:
        run.event(
            "warning",
            "servo",
            f"{record.point}: z was busy in {record.held_back} of {ticks} ticks: the servo "
            f"held the force with fewer targets than its {record.tick_Hz:g} a second",
        )
    if record.misread:
        run.event(
            "warning",
            "positions",
            f"{record.point}: {record.misread} times a stage answered a position where it "
            "cannot have been; it was asked again, and the wrong answer is not in the file: check "
            "its cable and its link",
        )


def _warn_of_clipping(run: Run, record: TrialRecord) -> None:
    """Warn of strips whose voltage has left the range of the DAQ: the filter smooths the cut-off
    peaks, so that the signals do not show it."""
    settings: PressedSettings = run.settings
    for strip, samples in record.clipped.items():
        if samples:
            run.event(
                "warning",
                "clipped",
                f"{record.point}: {samples} of {record.rows} samples of {strip} are at the "
                f"end of the range of {settings.range_V:g} V: its signal is not to be trusted "
                "there, and this project's detectors do not judge it; choose a larger --range, or "
                "a smaller gain of its amplifier",
            )


def _touch_down(run: Run, record: TrialRecord, force: npt.NDArray[np.float64]) -> Reading:
    """Return the offset of the force sensor's clock from the DAQ's, and each strip's gain, from
    touch-down and tap."""
    volts = np.concatenate(record.volts)
    rate_S_s = record.force_rate_S_s
    touch_s = float(np.argmax(force[:, 0] > CONTACT_N)) / rate_S_s
    begin_s = touch_s - CLOCKS_SEEN_S
    end_s = min(record.tapped_s + CLOCKS_SEEN_S, record.motion_from_s)
    wider_s = CLOCKS_SEARCHED_S + CLOCKS_SEEN_S

    def seen(column: npt.NDArray[np.float64]) -> TouchRecord:
        return TouchRecord(*_stretch(column, DECIMATED_Hz, begin_s, end_s), record.filter_delay_s)

    stretch = _stretch(force[:, 0], rate_S_s, begin_s - wider_s, end_s + wider_s)
    felt = TouchRecord(*stretch, delay_s=0.5 / rate_S_s)
    try:
        offset = clock_offset(felt, seen(volts.sum(axis=1)), CLOCKS_SEARCHED_S).offset
        gains = [touch_gain(felt, seen(column), offset.value) for column in volts.T]
    except TouchDownError as error:
        run.event("warning", "touch-down", f"{record.point}: {error.one_line()}")
        return {column.key: None for column in TOUCHED}
    reading: Reading = {
        "clock_offset_s": offset.value,
        "clock_offset_error_s": offset.standard_error,
    }
    for number, gain in enumerate(gains, 1):
        reading[f"touch_gain_{number}_V_s_N"] = gain.value
        reading[f"touch_gain_{number}_error_V_s_N"] = gain.standard_error
    settings: PressedSettings = run.settings
    EarlierPress(run, record.normal_force_N, settings.kind_of_press).judge_gains(
        {
            strip: TouchGain(value_V_s_N=gain.value, error_V_s_N=gain.standard_error)
            for strip, gain in zip(STRIPS, gains, strict=True)
        }
    )
    return reading


def _doubts(
    settings: PressedSettings, record: TrialRecord, reading: Reading, late: float
) -> list[str]:
    doubts = []
    for name, limit in (
        ("overshoot_percent", settings.overshoot_percent),
        ("force_error_rms_percent", settings.force_error_rms_percent),
        ("force_error_peak_percent", settings.force_error_peak_percent),
    ):
        value = float(reading[name] or 0)
        if value > limit:
            words = name.removesuffix("_percent").replace("_", " ")
            doubts.append(f"{words} {value:.2g} % is above {limit:g} %")
    bound_N = max(ZERO_SHIFT_N, ZERO_SHIFT * record.normal_force_N)
    for axis, shift_N in zip("xyz", record.zero_shift_N, strict=True):
        if abs(shift_N) > bound_N:
            doubts.append(
                f"the force sensor's zero has moved by {shift_N:.2g} N along {axis} since it was "
                f"zeroed, more than {bound_N:.2g} N"
            )
    if 100 * late > settings.late_ticks_percent:
        doubts.append(f"{100 * late:.2g} % of the ticks were late")
    oldest_s = OLDEST_LOOK * record.look_every_s
    for axis, unseen_s in record.unseen_s.items():
        if unseen_s > oldest_s:
            doubts.append(
                f"{axis} was not seen for {unseen_s:.2g} s of its motion, more than {oldest_s:.2g} "
                f"s ({OLDEST_LOOK} looks): its answers, or the computer's ticks, came late"
            )
    if (late_s := record.latest_alarm_s(settings.alarms_answered)) > STALE_S:
        doubts.append(
            f"an alarm came {late_s:.2g} s after its sample, more than {STALE_S:g} s: too late for "
            f"the grip, because the DAQ's link or the computer was busy{_longer_blocks(settings)}"
        )
    if settings.alarms_answered and record.detection_ended:
        doubts.append(f"detector {settings.detector} was dropped, so the grip got no alarms")
    if reading["lost_frames"]:
        doubts.append(
            f"{reading['lost_frames']} frames of the force sensor were lost: what follows in the "
            "record is that much too early"
        )
    span_s = record.motion_to_s + AFTER_S
    for name, rate in (("samples", settings.rate_S_s), ("frames", record.force_rate_S_s)):
        missing = span_s * rate - float(reading[name] or 0)
        if missing > MISSING_S * rate:
            doubts.append(f"{missing:.0f} {name} are missing")
    return doubts


def _longer_blocks(settings: PressedSettings) -> str:
    """Return how to relieve the DAQ's link, where the program does not do that itself."""
    return "" if settings.block_s is None else "; longer blocks (--block) take less of the link"


def _stretch(
    values: npt.NDArray[np.float64], rate_Hz: float, begin_s: float, end_s: float
) -> tuple[npt.NDArray[np.float64], float, float]:
    """Return values from one instant to another; their rate; when they begin."""
    first = max(0, round(begin_s * rate_Hz))
    return values[first : round(end_s * rate_Hz)], rate_Hz, first / rate_Hz


def _smoothed(force_N: npt.NDArray[np.float64], rate_S_s: float) -> npt.NDArray[np.float64]:
    """Return the mean over `SERVO_ERROR_S`: the error of a servo is not the sensor's noise."""
    frames = 2 * round((SERVO_ERROR_S * rate_S_s - 1) / 2) + 1
    kernel = np.full(frames, 1 / frames)
    return np.convolve(np.pad(force_N, frames // 2, mode="edge"), kernel, "valid")
