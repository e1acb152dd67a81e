"""From what a detector said of a trial, and what truly happened, to what it is credited with.

A slip is found by an alarm between the first slipping node of the ridge that is read and 30 ms
after the ridge has slipped as a whole. An alarm before that is early, one after it late: neither
finds, each is counted apart. In a trial without a slip of the whole ridge every alarm is false,
except that a ridge that lifts off does slip: there, alarms before the lift-off are counted apart.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

FOUND_WITHIN_S = 0.030
"""After the whole ridge has slipped, an alarm still finds the slip for so long."""
SLIPPED = ("slip", "slip in a roll")
"""Labels of trials in which the ridge slips as a whole."""

_NOTHING = np.zeros(0)


@dataclass(frozen=True)
class Truth:
    """What happened in a trial; times in s of its first sample's clock, NaN for never."""

    label: str
    """slip, roll, lift-off, hold, tap or slip in a roll."""
    motion_s: float
    """The object begins to slide, roll or knock; before, it is pressed on."""
    node_slip_s: float = math.nan
    """First slipping node of the ridge that is read."""
    ridge_slip_s: float = math.nan
    """The ridge slips as a whole: the impulse."""
    gross_slip_s: float = math.nan
    """Everything that touches slips."""
    lift_off_s: float = math.nan
    """The ridge leaves the object."""

    @property
    def slipped(self) -> bool:
        """Whether there is a slip to be found."""
        return self.label in SLIPPED

    def window_s(self) -> tuple[float, float]:
        """Between these an alarm finds the slip."""
        return self.node_slip_s, self.ridge_slip_s + FOUND_WITHIN_S


@dataclass(frozen=True)
class DetectorReport:
    """What a detector said of a trial; times in s, ascending."""

    alarms_s: Floats = field(default_factory=lambda: _NOTHING)
    """Incipient slips, (k,)."""
    armings_s: Floats = field(default_factory=lambda: _NOTHING)
    """Predictions, (m,)."""
    rolls_s: Floats = field(default_factory=lambda: _NOTHING)
    """Recognised rolls, (j,)."""


@dataclass(frozen=True)
class TrialOutcome:
    """What a trial says of a detector; times in s, NaN where there is none."""

    label: str
    traits: Mapping[str, float | str]
    """What the trial was like, by name and unit."""
    found: bool
    early: bool
    """An alarm before the first node slipped, pressing on included; of a slip."""
    late: bool
    """The first alarm came too late; of a slip."""
    alarmed: bool
    """Any alarm at all."""
    alarmed_pressing: bool
    """An alarm while the object was pressed on, before the motion."""
    alarmed_touching: bool
    """An alarm before the ridge lifted off, or any where it did not."""
    after_node_s: float
    """From the first node's slip to the alarm that found."""
    after_ridge_s: float
    """From the whole ridge's slip to it, negative where it came before."""
    before_gross_s: float
    """From it to gross slip."""
    armed: bool
    """Predicted: armed between the beginning of the motion and the whole ridge's slip."""
    arming_lead_s: float
    """From the last such arming to the whole ridge's slip."""
    followed: int
    """Armings in that time."""
    in_vain: int
    """Armings in motions that never come to a slip of the whole ridge."""
    classified_as_roll: bool
    """It said that this was a roll; in a slip only what it said before the whole ridge slipped."""


def judge(truth: Truth, said: DetectorReport, traits: Mapping[str, float | str]) -> TrialOutcome:
    """What a detector is credited with for a trial.

    Raises ValueError for a trial labelled as a slip without the times of node and ridge.
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
