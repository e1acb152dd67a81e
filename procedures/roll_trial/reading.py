"""The results of a roll trial: the strips' peaks, the angle, and the drag."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from procedures.pressed.record import reading as pressed_reading
from procedures.pressed.record.trial_record import TrialRecord
from rig.analysis.response.spectrum import rms_above
from rig.analysis.trial.decimation import DECIMATED_Hz
from rig.files.journal.layout import TRUTH

if TYPE_CHECKING:
    from procedures.roll_trial.settings import RollTrialSettings
    from rig.analysis.estimate import Estimate
    from rig.run.context import Run
    from rig.run.points import Reading

HIGH_Hz = 100.0
"""Frequency above which a roll has almost no signal (paper 5) and a slip has much."""
ZERO_S = 0.1
"""Length of the rest before the roll whose mean is the strips' zero."""
LEAST_ZERO_S = 0.02
"""Shortest part of that rest that is averaged, if the rest is short."""
SERVO_TRANSIENT_S = 0.07
"""Time after the tap in which the servo's transient is in the strips' signals: 5 mV, which shifts
the mean of 0.1 s by 0.4 mV, a tenth of a peak (measured on the skin at 4 N, 100 Hz)."""


LATE_S = 0.01
"""Delay of the object in following, in addition to a tick, above which a roll has a warning. A
stage that reaches 80 % of the speed of Figure 17 is 26 ms late at the end of its way."""


@dataclass
class RollTrialRecord(TrialRecord):
    """The data of a roll trial so far; its motion is the roll there and back."""

    end_deg: float = 0.0
    """Angle of the object at the end, from upright."""
    rotation: list[tuple[float, float, float]] = field(default_factory=list)
    """Rows of time, angle from upright, and commanded angle."""


def reading_of(run: Run, record: RollTrialRecord, offset: Estimate | None) -> Reading:
    """Return the results of the trial, and why it is invalid if it is."""
    settings: RollTrialSettings = run.settings
    reading = pressed_reading.reading_of(run, record)
    force, t = record.forces_N(), record.frame_times_s()
    rolled = (t >= record.motion_from_s) & (t <= record.motion_to_s)
    reading |= {
        "start_on_skin_mm": settings.start_mm,
        "roll_from_s": record.motion_from_s,
        "roll_to_s": record.motion_to_s,
        "largest_tangential_N": float(np.abs(force[rolled, 1]).max()),
        "axis_offset_mm": None if offset is None else offset.value,
        "axis_offset_error_mm": None if offset is None else offset.standard_error,
    }
    reading |= _angles(settings, record)
    _warn_of_lag(run, record, float(reading["angle_lag_deg"] or 0))
    reading |= _strips(settings, record)
    reading |= _lifted(record, reading)
    doubts = [str(reading["invalid"])] if reading["invalid"] else []
    error_deg = float(reading["angle_error_deg"] or 0)
    if error_deg > settings.angle_error_deg:
        doubts.append(f"angle error {error_deg:.2g} deg is above {settings.angle_error_deg:g} deg")
    reading["invalid"] = "; ".join(doubts)
    run.check_stop()  # Computing takes a while, so a sign of life is due.
    return reading


def _angles(settings: RollTrialSettings, record: RollTrialRecord) -> Reading:
    """Return the largest errors of the angle, at rest and under way."""
    rows = np.array(record.rotation)
    since = rows[:, 0] - record.motion_from_s
    inside = (since >= 0) & (rows[:, 0] <= record.motion_to_s)
    turned = rows[inside, 1]
    lowest_deg, highest_deg = settings.angles_deg
    errors = (turned.min() - lowest_deg, turned.max() - highest_deg, record.end_deg)
    return {
        "angle_deg": float(turned[np.argmax(np.abs(turned))]),
        "angle_error_deg": max(abs(float(error)) for error in errors),
        "angle_lag_deg": float(np.abs(rows[inside, 1] - rows[inside, 2]).max()),
    }


def _warn_of_lag(run: Run, record: RollTrialRecord, lag_deg: float) -> None:
    """Record a warning where the object did not follow: the strips' signals grow with its speed."""
    fastest_deg_s = run.settings.profile_at(record.tick_Hz).fastest_deg_s
    late_s = 1 / record.tick_Hz + LATE_S
    if lag_deg > late_s * fastest_deg_s:
        run.event(
            "warning",
            "angle-lag",
            f"{record.point}: the object was up to {lag_deg:.2g} deg away from where it was to be "
            f"in the roll, more than {1e3 * late_s:.0f} ms at {fastest_deg_s:.3g} deg/s. It did "
            "not turn as it was asked to, and the strips' signals follow its speed; check what "
            "slows the rotary stage, or ask for a slower turn or a larger --turn-acceleration",
        )


def _strips(settings: RollTrialSettings, record: RollTrialRecord) -> Reading:
    """Return the largest excursions of both strips on the way there, and the rms of v_d above
    100 Hz in the roll and at rest before it."""
    volts = np.concatenate(record.volts)
    t = np.arange(len(volts)) / DECIMATED_Hz - record.filter_delay_s
    before = (t >= _zero_from_s(record)) & (t < record.motion_from_s)
    volts = volts - volts[before].mean(axis=0)
    there_s = settings.profile_at(record.tick_Hz).there_s
    there = (t >= record.motion_from_s) & (t < record.motion_from_s + there_s)
    rolled = (t >= record.motion_from_s) & (t < record.motion_to_s)
    peaks = [1e3 * float(column[np.argmax(np.abs(column))]) for column in volts[there].T]
    difference_mV = 1e3 * (volts[:, 0] - volts[:, 1])
    return {
        "peak_1_mV": peaks[0],
        "peak_2_mV": peaks[1],
        "high_roll_rms_mV": rms_above(difference_mV[rolled], DECIMATED_Hz, HIGH_Hz),
        "high_rest_rms_mV": rms_above(difference_mV[before], DECIMATED_Hz, HIGH_Hz),
    }


def _zero_from_s(record: RollTrialRecord) -> float:
    """Return when the rest begins whose mean is the strips' zero, since the start of the record."""
    settled_s = record.tapped_s + SERVO_TRANSIENT_S
    latest_s = record.motion_from_s - LEAST_ZERO_S
    return max(record.motion_from_s - ZERO_S, min(settled_s, latest_s))


def _lifted(record: RollTrialRecord, reading: Reading) -> Reading:
    """Return, on a simulated bench, whether the ridge with the strips left the head in the roll."""
    truth = reading.get(TRUTH)
    if not truth:
        return {"ridge_lifted": None}
    lifts_us = json.loads(str(truth))["ridge_lift_off_us"]
    begun_us = 1e6 * record.begun_s
    span = range(
        round(begun_us + 1e6 * record.motion_from_s), round(begun_us + 1e6 * record.motion_to_s)
    )
    return {"ridge_lifted": float(any(at_us in span for at_us in lifts_us))}
