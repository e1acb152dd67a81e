"""How far the axis of a rotary stage lies above where its object touches, from small nudges.

A head that turns by ϕ about an axis h above its point of contact drags the skin by h ϕ besides
rolling; a stage that moves by x drags it by x. Of both the tangential force sees k times the way,
so that h is the ratio of two slopes, whatever the stiffness k. Nudges go to either side and come
back to the middle: what drifts or is even in the nudge falls out. What rolling itself does to the
tangential force, with no offset, stays in: `ROLLING_mm`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.analysis.estimate import Estimate
from rig.core.errors import ExitCode, RigError

Reals = NDArray[np.float64]

ROLLING_mm = 0.15
"""Standard error besides noise: what a head on ridges does to the tangential force by rolling
(assumed, from simulated heads)."""
LEAST_SLOPE = 5.0
"""A nudge of the stage has to be seen so many times above its standard error."""


class AxisOffsetError(RigError):
    """Nudges from which no offset follows."""

    code = ExitCode.FINISHED_WITH_FAILURES


@dataclass(frozen=True)
class NudgeForce:
    """The tangential force after a nudge."""

    by: float
    """How far the nudge went from the middle: mm of the stage, rad of the object."""
    force_N: Reals
    """Frames (n,)."""


def axis_offset(along_x: Sequence[NudgeForce], turned: Sequence[NudgeForce]) -> Estimate:
    """h in mm, positive where a positive turn drags as a positive way of the stage does.

    AxisOffsetError where the stage's nudges are not felt.
    """
    stiffness, stiffness_error = _slope(along_x)
    torque, torque_error = _slope(turned)
    if not abs(stiffness) > LEAST_SLOPE * stiffness_error:
        raise AxisOffsetError(
            f"the tangential force changes by {stiffness:.3g} N/mm, standard error "
            f"{stiffness_error:.2g}, where x is nudged: no contact that sticks",
            "look at the skin and the object; press harder",
        )
    offset = torque / stiffness
    noise = math.hypot(torque_error, offset * stiffness_error) / abs(stiffness)
    return Estimate.normal(offset, math.hypot(noise, ROLLING_mm), "mm")


def _slope(looks: Sequence[NudgeForce]) -> tuple[float, float]:
    """Force by nudge and its standard error; a drift that is straight in the looks falls out."""
    nudges = np.array([look.by for look in looks])
    means = np.array([look.force_N.mean() for look in looks])
    errors = np.array([look.force_N.std(ddof=1) / math.sqrt(look.force_N.size) for look in looks])
    drift = np.arange(len(looks), dtype=float)
    design = np.column_stack([nudges, np.ones(len(looks)), drift])
    solved = np.linalg.pinv(design)
    found = solved @ means
    residual = means - design @ found
    scatter = math.sqrt(float(residual @ residual) / max(len(looks) - 3, 1))
    spread = np.hypot(errors, scatter)
    return float(found[0]), float(np.sqrt(np.square(solved[0] * spread).sum()))
