"""Compares what a detector reported of a trial with what happened in it.

A slip is found by an alarm between the first slipping node of the ridge that is read and 30 ms
after the whole ridge has slipped. An alarm before that is early, one after it is late; neither
finds the slip, and both are recorded separately. In a trial in which the ridge does not slip as a
whole every alarm is false. One exception: a ridge that lifts off does slip, so in those trials the
alarms before the lift-off are recorded separately.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

FOUND_WITHIN_S = 0.030
"""Time after the slip of the whole ridge within which an alarm still finds the slip, in s."""
SLIPPED = ("slip", "slip in a roll")
"""Labels of trials in which the ridge slips as a whole."""

_NOTHING = np.zeros(0)


@dataclass(frozen=True)
class Truth:
    """Truth of a trial. Times are in s from its first sample, NaN for never."""

    label: str
    """Kind of trial: slip, roll, lift-off, hold, tap or slip in a roll."""
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

    @property
    def slipped(self) -> bool:
        """True if the trial contains a slip that a detector should find."""
        return self.label in SLIPPED

    def window_s(self) -> tuple[float, float]:
        """Returns the interval in which an alarm finds the slip."""
        return self.node_slip_s, self.ridge_slip_s + FOUND_WITHIN_S


@dataclass(frozen=True)
class DetectorReport:
    """Events that a detector reported in a trial. Times are in s, ascending."""

    alarms_s: Floats = field(default_factory=lambda: _NOTHING)
    """Incipient slips, (k,)."""
    armings_s: Floats = field(default_factory=lambda: _NOTHING)
    """Early warnings, (m,)."""
    rolls_s: Floats = field(default_factory=lambda: _NOTHING)
    """Recognised rolls, (j,)."""


@dataclass(frozen=True)
class TrialOutcome:
    """Result of a detector on one trial. Times are in s, NaN where the event did not happen."""

    label: str
    """Label of the trial (`Truth.label`)."""
    traits: Mapping[str, float | str]
    """Conditions of the trial, by name and unit."""
    found: bool
    """True if an alarm found the slip."""
    early: bool
    """True if, in a slip, there was an alarm before the first node slipped, pressing on
    included."""
    late: bool
    """True if, in a slip, the first alarm came too late to find it."""
    alarmed: bool
    """True if there was any alarm at all."""
    alarmed_pressing: bool
    """True if there was an alarm before the motion, while the object was pressed on."""
    alarmed_touching: bool
    """True if there was an alarm before the ridge lifted off, or any alarm if it did not lift
    off."""
    after_node_s: float
    """Delay from the slip of the first node to the alarm that found it."""
    after_ridge_s: float
    """Delay from the slip of the whole ridge to that alarm, negative if the alarm came before
    it."""
    before_gross_s: float
    """Time from that alarm to gross slip."""
    armed: bool
    """True if there was an early warning between the start of the motion and the slip of the whole
    ridge."""
    arming_lead_s: float
    """Time from the last of these early warnings to the slip of the whole ridge."""
    followed: int
    """Number of these early warnings."""
    in_vain: int
    """Number of early warnings in a motion without a slip of the whole ridge."""
    classified_as_roll: bool
    """True if the detector recognised a roll; in a slip, only before the whole ridge slipped."""


def judge(truth: Truth, said: DetectorReport, traits: Mapping[str, float | str]) -> TrialOutcome:
    """Returns the outcome of a trial, given the truth, the report of a detector and the conditions.

    Raises ValueError for a trial labelled as a slip without the times of node and ridge.

    >>> truth = Truth("slip", motion_s=1.0, node_slip_s=1.10, ridge_slip_s=1.12)
    >>> outcome = judge(truth, DetectorReport(alarms_s=np.array([1.125])), {})
    >>> outcome.found, round(outcome.after_ridge_s, 4)
    (True, 0.005)
    """
    if truth.slipped and not (
        math.isfinite(truth.node_slip_s) and truth.node_slip_s <= (truth.ridge_slip_s)
    ):
        raise ValueError(
            f"a trial labelled {truth.label!r} has node_slip_s {truth.node_slip_s:g} s and "
            f"ridge_slip_s {truth.ridge_slip_s:g} s: both must be times, the node's not the later"
        )
    alarms, armings = said.alarms_s, said.armings_s
    finds = late = early = _NOTHING
    if truth.slipped:
        first, last = truth.window_s()
        finds = alarms[(alarms >= first) & (alarms <= last)]
        early, late = alarms[alarms < first], alarms[alarms > last]
    found_s = float(finds[0]) if finds.size else math.nan
    moving = armings[armings >= truth.motion_s]
    predicting = moving[moving <= truth.ridge_slip_s] if truth.slipped else _NOTHING
    rolls = said.rolls_s[said.rolls_s < truth.ridge_slip_s] if truth.slipped else said.rolls_s
    touching = alarms < truth.lift_off_s if math.isfinite(truth.lift_off_s) else alarms == alarms
    return TrialOutcome(
        label=truth.label,
        traits=traits,
        found=bool(finds.size),
        early=bool(early.size),
        late=bool(late.size) and not finds.size,
        alarmed=bool(alarms.size),
        alarmed_pressing=bool((alarms < truth.motion_s).any()),
        alarmed_touching=bool(touching.any()),
        after_node_s=found_s - truth.node_slip_s,
        after_ridge_s=found_s - truth.ridge_slip_s,
        before_gross_s=truth.gross_slip_s - found_s,
        armed=bool(predicting.size),
        arming_lead_s=truth.ridge_slip_s - float(predicting[-1]) if predicting.size else math.nan,
        followed=int(predicting.size),
        in_vain=0 if truth.slipped else int(moving.size),
        classified_as_roll=bool(rolls.size),
    )
