"""The data of a trial with the skin pressed on an object, as they are recorded."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from procedures.pressed.approach.tare import ForceZero
from procedures.pressed.points import point_name
from procedures.pressed.record.squeeze import Squeeze
from rig.analysis.trial.decimation import DECIMATED_Hz
from rig.bench.settings import STRIPS
from rig.files.journal.detections import SLIP, Detection

if TYPE_CHECKING:
    import numpy.typing as npt

    from rig.analysis.trial.load_rate import LoadScale
    from rig.control.tick_loop import LoopStatistics
    from rig.detector.notices import Notice

AT_REST_S = 0.2
"""Beginning of a record, before contact: the strips' zero is its mean."""


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
    """Impossible positions that were read again."""
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
