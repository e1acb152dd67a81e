"""The record of a motion under the held force, as plain arrays."""

from __future__ import annotations

import math
from collections.abc import Mapping, Set
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rig.analysis.trial.decimation import DECIMATED_Hz
from rig.files.journal.detections import SLIP

if TYPE_CHECKING:
    import numpy.typing as npt

    from procedures.pressed.record.trial_record import TrialRecord
    from rig.run.points import Reading

    Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class MotionRecord:
    """The record from the beginning of a motion to its end; arrays are of float64, shape (n,).

    Positions, forces and signals are sampled by three instruments. Each group has its own n and its
    own times, in s since the motion began.
    """

    trial: int
    """Number of the trial in its run, from 1."""
    normal_force_N: float
    """Set point of the normal force that the trial pressed with."""
    position_t_s: Values
    """Times of `z_mm` and `x_mm`: 100 a second at most, not equally spaced."""
    z_mm: Values
    """Position of z; larger is deeper, towards the object."""
    x_mm: Values
    """Position of x."""
    z_age_s: Values
    """Time from the latest look at z to the time of each position: near 0 where z was looked at
    again. A trial in which an axis in motion was not seen for long is invalid."""
    x_age_s: Values
    """The same of x, which is not looked at while it is at rest."""
    force_t_s: Values
    """Times of `normal_N` and `tangential_N`: equally spaced, 1000 a second unless the force sensor
    is slower."""
    normal_N: Values
    """Normal force, positive where it presses."""
    tangential_N: Values
    """Force along x; NaN where the sensor does not measure it (`Procedure.force_axes`)."""
    signal_t_s: Values
    """Times of the strips' signals: equally spaced, 1000 a second, corrected for the delay of the
    anti-alias filter."""
    v_1: Values
    """Signal of strip 1 in V."""
    v_2: Values
    """Signal of strip 2 in V."""
    v_d: Values
    """v_1 - v_2 in V."""
    slip_t_s: Values
    """Times, among `signal_t_s`, of the incipient slips that the detector found during the trial;
    empty without a detector."""


def motion_record(record: TrialRecord) -> MotionRecord:
    """Return the part of a trial's record that belongs to its motion."""
    rows, ages_s = np.array(record.position), np.array(record.ages_s)
    position_s, force_s = rows[:, 0], record.frame_times_s()
    volts = np.concatenate(record.volts)
    signal_s = np.arange(len(volts)) / DECIMATED_Hz - record.filter_delay_s

    def within(times_s: Values) -> npt.NDArray[np.bool_]:
        return (times_s >= record.motion_from_s) & (times_s <= record.motion_to_s)

    moved, felt, seen = within(position_s), within(force_s), within(signal_s)
    slip_s = np.array([one.time_s for one in record.detections if one.kind == SLIP], float)
    slip_s -= record.filter_delay_s
    forces_N, volts = record.forces_N()[felt], volts[seen]
    return MotionRecord(
        trial=record.number,
        normal_force_N=record.normal_force_N,
        position_t_s=position_s[moved] - record.motion_from_s,
        z_mm=rows[moved, 1],
        x_mm=rows[moved, 2],
        z_age_s=ages_s[moved, 0],
        x_age_s=ages_s[moved, 1],
        force_t_s=force_s[felt] - record.motion_from_s,
        normal_N=forces_N[:, 0],
        tangential_N=forces_N[:, 1],
        signal_t_s=signal_s[seen] - record.motion_from_s,
        v_1=volts[:, 0],
        v_2=volts[:, 1],
        v_d=volts[:, 0] - volts[:, 1],
        slip_t_s=np.sort(slip_s[within(slip_s)]) - record.motion_from_s,
    )


def plain(own: Mapping[str, Any], declared: Set[str], name: str) -> Reading:
    """Return what `reading` of a procedure returned with numpy's numbers as Python's, and None for
    NaN: run files store NaN for a missing value, and one NaN would make the mean of all trials NaN.

    Raises TypeError where it is not a mapping, and ValueError for a key that is not one of the
    procedure's columns: a column of every trial must not be replaced.
    """
    if not isinstance(own, Mapping):
        raise TypeError(f"reading() of {name} returned {type(own).__name__}, not a dict")
    if strangers := [key for key in own if key not in declared]:
        raise ValueError(
            f"reading() of {name} returned {strangers[0]!r}, which is not the key of one of its "
            f"columns ({', '.join(sorted(declared)) or 'it has none'})"
        )
    items = {
        key: value.item() if isinstance(value, np.generic) else value for key, value in own.items()
    }
    return {
        key: None if isinstance(value, float) and math.isnan(value) else value
        for key, value in items.items()
    }
