"""The reading of a trial with the skin pressed on an object: servo, clocks, whether it is valid."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from procedures.pressed.approach.earlier_runs import EarlierPress
from procedures.pressed.record.layout import TOUCHED
from procedures.pressed.record.lost_frames import lost_frames
from procedures.pressed.record.squeeze import STALE_S
from procedures.pressed.settings import AFTER_S, CONTACT_N, PressedSettings
from rig.analysis.trial.clock_offset import clock_offset
from rig.analysis.trial.decimation import DECIMATED_Hz
from rig.analysis.trial.force_error import SQUEEZED_S, averaged, judged
from rig.analysis.trial.touch_down import TouchDownError, TouchRecord
from rig.analysis.trial.touch_gain import touch_gain
from rig.bench.settings import STRIPS
from rig.detector.notices import columns_of
from rig.files.journal.detections import to_text
from rig.files.journal.layout import TRUTH
from rig.run.press_references import TouchGain

if TYPE_CHECKING:
    import numpy.typing as npt

    from procedures.pressed.record.trial_record import TrialRecord
    from rig.analysis.trial.load_rate import LoadScale
    from rig.run.context import Run
    from rig.run.points import Reading

MISSING_S = 0.05
"""Length in s of samples or frames that may still be under way when a record ends."""
ZERO_SHIFT_N, ZERO_SHIFT = 0.1, 0.03
"""Largest change of the force sensor's zero within a valid trial, and as a share of the normal
force; the larger of both is the bound."""
OLDEST_LOOK = 5
"""Longest time for which an axis may not be seen in its motion, in intervals from one look at it to
the next: 0.05 s at the usual 100 looks a second. What moves at 6 mm/s goes 0.3 mm meanwhile."""
HELD_BACK = 0.5
"""Share of the ticks without a new target for z beyond which there is a warning."""
CLOCKS_SEEN_S, CLOCKS_SEARCHED_S = 0.1, 0.2
"""Time in s beyond touch-down and tap over which the two clocks are compared, and their largest
assumed offset."""


def reading_of(run: Run, record: TrialRecord) -> Reading:
    """Return the reading of a trial: how the force was held during the motion, the quality of the
    record, both clocks, the truth of a simulated bench; and the reason why the trial is invalid, if
    it is (``invalid``).

    Records warnings of what the reading does not show. Raises InstrumentError where a strip's gain
    does not fit that of earlier runs on this bench at all.
    """
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
        reading[TRUTH] = json.dumps({**truth, "record_begun_us": begun_us})
    late_share = record.late_ticks / max(record.tick_count, 1)
    reading["invalid"] = "; ".join(_doubts(settings, record, reading, late_share))
    return reading


def load_scale_columns(scales: Mapping[str, LoadScale]) -> Reading:
    """Return the scales of the strips as columns of a reading, None where a strip is not
    calibrated."""
    reading: Reading = {}
    for number, strip in enumerate(STRIPS, 1):
        factor = scales[strip].N_s_per_V if strip in scales else None
        error = None if factor is None else factor.standard_error
        reading[f"load_scale_{number}_N_s_V"] = None if factor is None else factor.value
        reading[f"load_scale_{number}_error_N_s_V"] = error
    flat = [scale.flat_to_Hz for scale in scales.values() if np.isfinite(scale.flat_to_Hz)]
    reading["load_rate_flat_to_Hz"] = min(flat, default=None)
    return reading


def _held_force(record: TrialRecord, force: npt.NDArray[np.float64]) -> Reading:
    """Return how well F_n of `force` (n, 3) followed its set point in the motion, outside the rises
    by the grip and the times in which z was to rest."""
    t = record.frame_times_s()
    held = (t >= record.motion_from_s) & (t <= record.motion_to_s)
    error = 100 * (averaged(force[:, 0], record.force_rate_S_s) / record.set_force_N(t) - 1)
    motion_s = record.motion_from_s, record.motion_to_s
    counted = judged(t, motion_s, [squeeze.decided_s for squeeze in record.squeezes])
    for from_s, to_s in record.rested:
        counted &= (t < from_s) | (t > to_s + SQUEEZED_S)
    errors = error[counted]
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


def _touch_frame(force_N: npt.NDArray[np.float64], rate_S_s: float, tapped_s: float) -> int:
    """Return the frame of the touch-down that leads to the held force.

    Neither a disturbance in free air is taken nor an object that was felt and lost again: the
    clocks would be compared over a long stretch, which takes long.
    """
    away = np.flatnonzero(averaged(force_N, rate_S_s)[: round(tapped_s * rate_S_s)] < CONTACT_N / 2)
    first = int(away[-1]) + 1 if away.size else 0
    touched = np.flatnonzero(force_N[first:] > CONTACT_N)
    return first + int(touched[0]) if touched.size else first


def _touch_down(run: Run, record: TrialRecord, force: npt.NDArray[np.float64]) -> Reading:
    """Return the offset of the force sensor's clock from the DAQ's, and each strip's gain, from
    touch-down and tap. Raises InstrumentError as `EarlierPress.judge_gains`."""
    volts = np.concatenate(record.volts)
    rate_S_s = record.force_rate_S_s
    touch_s = _touch_frame(force[:, 0], rate_S_s, record.tapped_s) / rate_S_s
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
