"""The results of a slip trial: friction, and how well a ramp was followed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from procedures.pressed import reading as pressed_reading
from procedures.pressed.reading import TrialRecord
from rig.analysis.trial.friction import FrictionError, friction

if TYPE_CHECKING:
    import numpy.typing as npt

    from procedures.slip_trial.settings import SlipTrialSettings
    from rig.run.context import Run
    from rig.run.points import Reading

FRICTION_COLUMNS = (
    "static_friction",
    "static_friction_error",
    "kinetic_friction",
    "kinetic_friction_error",
)


@dataclass
class SlipTrialRecord(TrialRecord):
    """The data of a slip trial so far; its motion is the slide or the ramp."""

    ramp_to_s: float | None = None
    """Time until which the tangential force followed its ramp, if there was one."""


def reading_of(run: Run, record: SlipTrialRecord) -> Reading:
    """Return the results of the trial, and why it is invalid if it is."""
    settings: SlipTrialSettings = run.settings
    reading = pressed_reading.reading_of(run, record)
    force, t = record.forces_N(), record.frame_times_s()
    held = (t >= record.motion_from_s) & (t <= record.motion_to_s)
    reading |= {
        "speed_mm_s": settings.speed_mm_s,
        "direction": float(settings.along),
        "slide_from_s": record.motion_from_s,
        "slide_to_s": record.motion_to_s,
    }
    reading |= _ramp(settings, record, t, force)
    reading |= _friction(run, record, t[held], force[held])
    run.check_stop()  # Computing takes a while, so a sign of life is due.
    return reading


def _ramp(
    settings: SlipTrialSettings,
    record: SlipTrialRecord,
    t: npt.NDArray[np.float64],
    force: npt.NDArray[np.float64],
) -> Reading:
    """Return how well the tangential force followed its ramp until the skin slipped."""
    if record.ramp_to_s is None:
        return {"ramp_error_rms_N": None, "ramp_to_s": None}
    since = t - record.motion_from_s
    rising = (since >= 0) & (t <= record.ramp_to_s)
    rise = settings.along * (force[rising, 1] - force[rising, 1][0])
    error = rise - settings.ramp_N_s * since[rising]
    return {
        "ramp_error_rms_N": float(np.sqrt(np.mean(error**2))),
        "ramp_to_s": record.ramp_to_s,
    }


def _friction(
    run: Run, record: SlipTrialRecord, t: npt.NDArray[np.float64], force: npt.NDArray[np.float64]
) -> Reading:
    times, x = record.looks_at_x()
    travel = np.abs(np.interp(t, times, x) - run.settings.start_mm)
    try:
        rate_Hz = record.force_rate_S_s
        found = friction(force[:, 0], np.abs(force[:, 1]), travel, rate_Hz=rate_Hz)
    except FrictionError as error:
        run.event("warning", "friction", f"trial {record.number}: {error.one_line()}")
        return {**dict.fromkeys(FRICTION_COLUMNS), "no_friction": error.one_line()}
    return {
        "no_friction": "",
        "static_friction": found.static.value,
        "static_friction_error": found.static.standard_error,
        "kinetic_friction": found.kinetic.value,
        "kinetic_friction_error": found.kinetic.standard_error,
    }
