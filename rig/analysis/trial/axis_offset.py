"""Offset of a rotary axis from the contact of its object, measured by small nudges.

A head that turns by ϕ about an axis at a height h above its contact drags the skin by h ϕ, in
addition to rolling. A stage that moves by x drags it by x. In both cases the tangential force
changes by k times the distance, so h is the ratio of two slopes and the stiffness k cancels. Nudges
go to either side and return to the middle: drift, and everything that is even in the nudge,
cancels. The tangential force caused by rolling itself, without an offset, does not cancel
(`ROLLING_mm`).
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
"""Standard error in addition to noise, in mm: the effect on the tangential force of a head that
rolls over ridges (assumed, from simulated heads)."""
LEAST_SLOPE = 5.0
"""Standard errors by which the effect of a nudge of the stage must exceed zero."""


class AxisOffsetError(RigError):
    """Raised when the nudges do not determine an offset."""

    code = ExitCode.FINISHED_WITH_FAILURES


@dataclass(frozen=True)
class NudgeForce:
    """The tangential force that was measured after a nudge of the stage or of the object."""

    by: float
    """Distance of the nudge from the middle: mm for the stage, rad for the object."""
    force_N: Reals
    """Frames of the tangential force, (n,)."""


def axis_offset(along_x: Sequence[NudgeForce], turned: Sequence[NudgeForce]) -> Estimate:
    """Return h in mm, positive if a positive turn drags the skin like a positive motion of the
    stage.

    Raises AxisOffsetError if the nudges of the stage have no clear effect on the force.
    """
    stiffness, stiffness_error = _slope(along_x)
    torque, torque_error = _slope(turned)
    if not abs(stiffness) > LEAST_SLOPE * stiffness_error:
        raise AxisOffsetError(
            "the rotary axis cannot be measured: the tangential force changes by "
            f"{stiffness:.3g} N/mm, standard error {stiffness_error:.2g} N/mm, when x is nudged: "
            "the contact does not stick",
            "check the skin and the object; press harder (--normal-force), or roll without this "
            "measurement (--alignment none)",
        )
    offset = torque / stiffness
    noise = math.hypot(torque_error, offset * stiffness_error) / abs(stiffness)
    return Estimate.normal(offset, math.hypot(noise, ROLLING_mm), "mm")


def _slope(nudged: Sequence[NudgeForce]) -> tuple[float, float]:
    """Return the change of force per nudge and its standard error. A linear drift cancels."""
    nudges = np.array([one.by for one in nudged])
    means = np.array([one.force_N.mean() for one in nudged])
    errors = np.array([one.force_N.std(ddof=1) / math.sqrt(one.force_N.size) for one in nudged])
    drift = np.arange(len(nudged), dtype=float)
    design = np.column_stack([nudges, np.ones(len(nudged)), drift])
    solved = np.linalg.pinv(design)
    found = solved @ means
    residual = means - design @ found
    scatter = math.sqrt(float(residual @ residual) / max(len(nudged) - 3, 1))
    spread = np.hypot(errors, scatter)
    return float(found[0]), float(np.sqrt(np.square(solved[0] * spread).sum()))
