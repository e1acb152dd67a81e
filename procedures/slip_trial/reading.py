"""The results of a slip trial: friction, and how well a ramp was followed."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from procedures.pressed.approach.tare import TARE_S
from procedures.pressed.grip import grip_reading
from procedures.pressed.record import reading as pressed_reading
from procedures.pressed.record.trial_record import TrialRecord
from procedures.slip_trial.layout import FRICTION, RAMP, WEIGHT
from rig.analysis.trial.force_error import averaged
from rig.analysis.trial.friction import FrictionError, friction
from rig.files.journal.layout import TRUTH, without_values

if TYPE_CHECKING:
    import numpy.typing as npt

    from procedures.slip_trial.settings import SlipTrialSettings
    from rig.run.context import Run
    from rig.run.points import Reading

USED_S = 0.1
"""Last stretch of a motion, whose mean normal force is the force used."""
PRESSED_SHARE = 0.5
"""Share of the normal force above which F_t/F_n is a coefficient and not noise."""

LONGER_SHARE, LONGER_S = 0.1, 0.1
"""Share and time by which a slide has to take longer than expected for a warning. Without a fault
slides of 0.1 to 20 mm/s took at most 17 ms longer (both models of stage, simulated)."""


@dataclass
class SlipTrialRecord(TrialRecord):
    """The data of a slip trial so far; its motion is the slide or the ramp."""

    ramp_to_s: float | None = None
    """Latest time at which the tangential force followed its ramp, if there was one."""
    slid_from_mm: float = 0.0
    """Travel in mm at which the way of a weight begins: that of the latest moment at which the
    force followed its ramp."""
    slid_mm: float = 0.0
    """Largest way of a weight so far, in mm, from where it began at the time."""
    lost: bool = False
    """Whether a weight has gone further than `lost_mm`, or x to the end of its way."""
    weight_rested: bool = False
    """Whether a weight has rested for `hold_for_s`."""


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
    warn_of_slow_slide(run, record)
    reading |= _ramp(settings, record, t, force)
    reading |= _friction(run, record, t[held], force[held])
    reading |= grip_reading(record) | _weight(settings, record, reading, t[held], force[held])
    run.check_stop()  # Computing takes a while, so a sign of life is due.
    return reading


def warn_of_slow_slide(run: Run, record: SlipTrialRecord) -> None:
    """Record a warning where x took longer for a slide than its speed allows."""
    settings: SlipTrialSettings = run.settings
    took_s, expected_s = record.motion_to_s - record.motion_from_s, settings.slide_s
    if settings.loading == "slide" and took_s > (1 + LONGER_SHARE) * expected_s + LONGER_S:
        run.event(
            "warning",
            "slow-slide",
            f"{record.point}: the slide took {took_s:.2f} s instead of {expected_s:.2f} s: x was "
            f"slower than {settings.speed_mm_s:g} mm/s. Check what slows the stage, and whether "
            f"its drive has the acceleration of {settings.acceleration_mm_s2:g} mm/s^2 that "
            "--acceleration states, or ask for a lower --speed",
        )


def _weight(
    settings: SlipTrialSettings,
    record: SlipTrialRecord,
    reading: Reading,
    t: npt.NDArray[np.float64],
    force: npt.NDArray[np.float64],
) -> Reading:
    """Return what became of a weight, the force used, and the least that would have held it, in N:
    by the largest F_t/F_n that the contact has shown in this trial, from forces averaged over 5 ms,
    and, on a simulated bench, by the World's static coefficient. A weight that never rested is
    lost, too: it still slides."""
    load_N = settings.hold_at_N
    if load_N is None or not len(t):
        return without_values(WEIGHT)
    kept = record.weight_rested and not record.lost
    outcome = "lost" if not kept else "averted" if record.squeezes else "held"
    used_N = float(force[t >= t[-1] - USED_S, 0].mean())
    normal_N, tangential_N = (averaged(force[:, k], record.force_rate_S_s) for k in (0, 1))
    pressed = normal_N > PRESSED_SHARE * settings.normal_force_N
    shown = float(np.max(np.abs(tangential_N[pressed]) / normal_N[pressed], initial=0.0))
    truth = json.loads(str(reading.get(TRUTH) or "{}"))
    static = truth.get("static_coefficient")
    return {
        "outcome": outcome,
        "load_N": load_N,
        "slid_mm": record.slid_mm,
        "force_used_N": used_N,
        "least_force_N": load_N / shown if shown else None,
        "least_force_true_N": load_N / static if static else None,
    }


def _ramp(
    settings: SlipTrialSettings,
    record: SlipTrialRecord,
    t: npt.NDArray[np.float64],
    force: npt.NDArray[np.float64],
) -> Reading:
    """Return how well the tangential force followed its ramp, from its start until it last did."""
    if record.ramp_to_s is None:
        return without_values(RAMP)
    since = t - record.motion_from_s
    rising = (since >= 0) & (t <= record.ramp_to_s)
    if not rising.any():  # over before a frame of the force sensor was sent in it
        return without_values(RAMP)
    rise = settings.along * (force[rising, 1] - force[rising, 1][0])
    error = rise - settings.ramp_N_s * since[rising]
    return {
        "ramp_error_rms_N": float(np.sqrt(np.mean(error**2))),
        "ramp_to_s": record.ramp_to_s,
    }


def zero_errors_N(  # noqa: N802 - the unit keeps its capital
    run: Run, record: SlipTrialRecord
) -> tuple[float, float]:
    """Return the standard errors in N of the zeros of F_n and F_t.

    Each is the shift that was found after the lift, the whole of it, because the moment at which
    the zero moved is not known; and the error of the mean that was taken as the zero.
    """
    frames = max(1, round(TARE_S * record.force_rate_S_s))
    of_tare_N = run.force.noise_N / math.sqrt(frames)
    x, _, z = np.hypot(record.zero_shift_N, of_tare_N)
    return float(z), float(x)


def _friction(
    run: Run, record: SlipTrialRecord, t: npt.NDArray[np.float64], force: npt.NDArray[np.float64]
) -> Reading:
    times, x = record.looks_at_x()
    travel = np.abs(np.interp(t, times, x) - run.settings.start_mm)
    try:
        found = friction(
            force[:, 0],
            np.abs(force[:, 1]),
            travel,
            zero_errors_N(run, record),
            rate_Hz=record.force_rate_S_s,
        )
    except FrictionError as error:
        # A weight that holds does not slide, and is not to slide further.
        holds = run.settings.hold_at_N is not None and record.weight_rested
        why = f"the weight did not slide away ({error})" if holds else error.one_line()
        run.event("info" if holds else "warning", "friction", f"{record.point}: {why}")
        return without_values(FRICTION) | {"no_friction": why}
    return {
        "no_friction": "",
        "static_friction": found.static.value,
        "static_friction_error": found.static.standard_error,
        "kinetic_friction": found.kinetic.value,
        "kinetic_friction_error": found.kinetic.standard_error,
    }
