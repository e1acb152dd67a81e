"""Compares what a detector reported of a trial with what happened in it.

A slip is found in time by an alarm from 10 ms before to 30 ms after the whole ridge that is read
has slipped. An alarm since the motion began that is earlier is early, one that is later is late;
neither finds the slip in time, and both are recorded separately. An alarm before the motion is
false, and so is every alarm in a trial in which the ridge does not slip as a whole. One exception:
a ridge that lifts off does slip, so in those trials only the alarms before the time in which that
slip is found are false, and those before the lift-off are recorded separately. What happens after
the end of a record is not in its truth.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

EARLY_WITHIN_S = 0.010
"""Time before the slip of the whole ridge from which an alarm finds the slip in time, in s."""
FOUND_WITHIN_S = 0.030
"""Time after the slip of the whole ridge within which an alarm still finds the slip, in s."""
LEAST_TICK_S = 0.004
"""Shortest tick for which the phase of an alarm is computed: four samples at 1000 Hz."""
SLIPS = ("slip", "slip in a slide")
"""Labels of trials with a slip of the whole ridge on which detectors are compared: the motion ends
with it, or continues."""
SLIPPED = (*SLIPS, "slip in a roll")
"""Labels of trials in which the ridge slips as a whole."""
LIFT_OFF = "lift-off"
"""Label of trials in which the ridge leaves the object, and may slip as a whole before it does."""
NO_SLIP = ("roll", LIFT_OFF, "hold", "partial slip", "tap")
"""Labels of the others. In a partial slip some of the ridge slips, never all of it."""
LABELS = (*SLIPPED, *NO_SLIP)
"""Labels that a trial may have."""

_NOTHING = np.zeros(0)


@dataclass(frozen=True)
class Truth:
    """Truth of a trial. Times are in s from its first sample, NaN for never."""

    label: str
    """Kind of trial, one of `LABELS`."""
    motion_s: float
    """Start of the slide, roll or tap. Before it the object is pressed on."""
    node_slip_s: float = math.nan
    """Slip of the first node of the ridge that is read."""
    ridge_slip_s: float = math.nan
    """Slip of the whole ridge, which causes the impulse."""
    gross_slip_s: float = math.nan
    """Slip of the whole contact."""
    lift_off_s: float = math.nan
    """Time at which the ridge leaves the object."""
    record_s: float = math.nan
    """Length of the record."""
    quiet_s: tuple[tuple[float, float], ...] = ()
    """Intervals in which the skin is pressed, nothing moves on purpose and nothing slips whole."""
    tick_s: float = math.nan
    """Time from one tick of the bench's servo to the next; NaN without a servo."""
    tick_from_s: float = math.nan
    """Begin of one of these ticks."""

    @property
    def slipped(self) -> bool:
        """True if the trial contains a slip that a detector should find."""
        return self.label in SLIPPED

    def window_s(self) -> tuple[float, float]:
        """Return the interval in which an alarm finds the slip in time."""
        return self.ridge_slip_s - EARLY_WITHIN_S, self.ridge_slip_s + FOUND_WITHIN_S

    def false_until_s(self) -> float:
        """Return the time before which every alarm is early or false: the begin of the time in
        which the slip is found, which a lift-off has too; infinite where the ridge neither slips as
        a whole nor lifts off."""
        if self.slipped:
            return self.window_s()[0]
        if self.label != LIFT_OFF:
            return math.inf
        times_s = (self.window_s()[0], self.lift_off_s)
        return min((time_s for time_s in times_s if math.isfinite(time_s)), default=math.inf)

    def without_slip_s(self) -> float:
        """Return the length of the part of the record in which every alarm is early or false."""
        until_s = self.false_until_s()
        return min(until_s, self.record_s) if math.isfinite(until_s) else self.record_s


@dataclass(frozen=True)
class DetectorReport:
    """Events that a detector reported in a trial. Times are in s, ascending."""

    alarms_s: Floats = field(default_factory=lambda: _NOTHING)
    """Incipient slips, (k,)."""
    armings_s: Floats = field(default_factory=lambda: _NOTHING)
    """When a motion under load armed it, (m,)."""
    rolls_s: Floats = field(default_factory=lambda: _NOTHING)
    """Recognised rolls, (j,)."""
    unjudged_s: tuple[tuple[float, float], ...] = ()
    """Intervals of which the detector said that it cannot judge them, ascending."""
    inverted: bool = False
    """True if the detector said that one channel may be inverted: alarms are not to be trusted."""


@dataclass(frozen=True)
class TrialOutcome:
    """Result of a detector on one trial. Times are in s, NaN where the event did not happen."""

    label: str
    """Label of the trial (`Truth.label`)."""
    traits: Mapping[str, float | str]
    """Conditions of the trial, by name and unit."""
    found: bool
    """True if an alarm found the slip in time."""
    found_first: bool
    """True if the first alarm since the start of the motion found it."""
    early: bool
    """True if, in a slip, there was an alarm in the motion before the time in which it is found."""
    late: bool
    """True if, in a slip, the first alarm in the motion came too late to find it."""
    alarmed: bool
    """True if there was any alarm at all."""
    alarmed_pressing: bool
    """True if there was an alarm before the motion, while the object was pressed on."""
    alarmed_moving: bool
    """True if there was an alarm since the start of the motion."""
    alarmed_touching: bool
    """True if there was an alarm before the ridge lifted off, or any alarm if it did not lift
    off."""
    alarmed_after: bool
    """True if, in a slip, there was an alarm after the time in which it is found, whether it was
    found or not."""
    cannot_judge: bool
    """True if the detector said that it cannot judge the recording, or a part of it."""
    says_inverted: bool
    """True if the detector said that one channel may be inverted. It judged all the same."""
    slip_unjudged: bool
    """True if, in a slip, it judged no moment of the time in which an alarm finds the slip. Such a
    slip is also missed: an alarm in that time would have to be taken back."""
    unjudged_s: float
    """Length of the time that it did not judge."""
    record_s: float
    """Length of the record; NaN if it is not known."""
    early_by_s: float
    """Time from the first early alarm to the slip of the whole ridge."""
    after_node_s: float
    """Delay from the slip of the first node to the alarm that found it."""
    after_ridge_s: float
    """Delay from the slip of the whole ridge to that alarm, negative if the alarm came before
    it."""
    before_gross_s: float
    """Time from that alarm to gross slip."""
    armed: bool
    """True if a motion under load armed the detector between the start of the motion and the slip
    of the whole ridge."""
    arming_lead_s: float
    """Time from the last of these armings to the slip of the whole ridge."""
    followed: int
    """Number of these armings."""
    in_vain: int
    """Number of armings in a motion without a slip of the whole ridge."""
    classified_as_roll: bool
    """True if the detector recognised a roll; in a slip, only before the whole ridge slipped."""
    false_alarms: int
    """Number of alarms that are early or false."""
    without_slip_s: float
    """Time in which they could occur (`Truth.without_slip_s`)."""
    quiet_alarms: int
    """Number of alarms while nothing moved (`Truth.quiet_s`)."""
    quiet_s: float
    """Length of that time."""
    tick_phases: tuple[float, ...]
    """Phases, from 0 to 1, within the servo's tick of the alarms in the motion that are early or
    false; empty without a servo, or where a tick has too few samples (`LEAST_TICK_S`)."""


def check_slip(truth: Truth) -> None:
    """Raise ValueError for a trial labelled as a slip without the time at which the ridge slipped,
    or with one before its first node's."""
    if truth.slipped and not math.isfinite(truth.ridge_slip_s):
        raise ValueError(
            f"a trial labelled {truth.label!r} needs ridge_slip_s, the time at which the whole "
            "ridge slipped, in s of the record"
        )
    if truth.slipped and not (
        math.isfinite(truth.node_slip_s) and truth.node_slip_s <= truth.ridge_slip_s
    ):
        raise ValueError(
            f"a trial labelled {truth.label!r} has node_slip_s {truth.node_slip_s:g} s and "
            f"ridge_slip_s {truth.ridge_slip_s:g} s: both must be times, the node's not the later"
        )


def judge(truth: Truth, report: DetectorReport, traits: Mapping[str, float | str]) -> TrialOutcome:
    """Return the outcome of a trial, given the truth, the report of a detector and the conditions.

    Raises ValueError as `check_slip`.

    >>> truth = Truth("slip", motion_s=1.0, node_slip_s=1.10, ridge_slip_s=1.12)
    >>> outcome = judge(truth, DetectorReport(alarms_s=np.array([1.125])), {})
    >>> outcome.found, round(outcome.after_ridge_s, 4)
    (True, 0.005)
    """
    check_slip(truth)
    alarms, armings = report.alarms_s, report.armings_s
    moved = alarms[alarms >= truth.motion_s]
    finds = late = early = _NOTHING
    if truth.slipped:
        first, last = truth.window_s()
        finds = alarms[(alarms >= first) & (alarms <= last)]
        early, late = moved[moved < first], alarms[alarms > last]
    found_s = float(finds[0]) if finds.size else math.nan
    until_s = truth.false_until_s()
    moving = armings[armings >= truth.motion_s]
    predicting = moving[moving <= truth.ridge_slip_s] if truth.slipped else _NOTHING
    rolls = report.rolls_s[report.rolls_s < truth.ridge_slip_s] if truth.slipped else report.rolls_s
    touching = alarms < truth.lift_off_s if math.isfinite(truth.lift_off_s) else alarms == alarms
    quiet = [((alarms >= begin) & (alarms < end)).sum() for begin, end in truth.quiet_s]
    return TrialOutcome(
        label=truth.label,
        traits=traits,
        found=bool(finds.size),
        found_first=bool(finds.size) and not early.size,
        early=bool(early.size),
        late=bool(late.size) and not finds.size,
        alarmed=bool(alarms.size),
        alarmed_pressing=bool((alarms < truth.motion_s).any()),
        alarmed_moving=bool(moved.size),
        alarmed_touching=bool(touching.any()),
        alarmed_after=bool(late.size),
        cannot_judge=bool(report.unjudged_s),
        says_inverted=report.inverted,
        slip_unjudged=truth.slipped and _slip_unjudged(truth, report),
        unjudged_s=float(sum(end - begin for begin, end in report.unjudged_s)),
        record_s=truth.record_s,
        early_by_s=truth.ridge_slip_s - float(early[0]) if early.size else math.nan,
        after_node_s=found_s - truth.node_slip_s,
        after_ridge_s=found_s - truth.ridge_slip_s,
        before_gross_s=truth.gross_slip_s - found_s,
        armed=bool(predicting.size),
        arming_lead_s=truth.ridge_slip_s - float(predicting[-1]) if predicting.size else math.nan,
        followed=int(predicting.size),
        in_vain=0 if truth.slipped else int(moving.size),
        classified_as_roll=bool(rolls.size),
        false_alarms=int((alarms < until_s).sum()),
        without_slip_s=truth.without_slip_s(),
        quiet_alarms=int(sum(quiet)),
        quiet_s=float(sum(end - begin for begin, end in truth.quiet_s)),
        tick_phases=_tick_phases(truth, moved[moved < until_s]),
    )


def _slip_unjudged(truth: Truth, report: DetectorReport) -> bool:
    """Return whether a detector judged none of the time in which the slip is found, as far as it is
    in the record."""
    first, last = truth.window_s()
    return _covers(report.unjudged_s, first, min(last, truth.record_s))


def _covers(intervals: Sequence[tuple[float, float]], begin: float, end: float) -> bool:
    """Return whether one of the intervals contains all of the time from `begin` to `end`."""
    return any(first <= begin and end <= last for first, last in intervals)


def _tick_phases(truth: Truth, alarms: Floats) -> tuple[float, ...]:
    if not truth.tick_s >= LEAST_TICK_S:
        return ()
    phases: Floats = (alarms - truth.tick_from_s) / truth.tick_s % 1.0
    return tuple(phases.tolist())
