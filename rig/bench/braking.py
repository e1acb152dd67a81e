"""How fast the z stage of a bench may go towards a contact: what brakes within a force."""

from __future__ import annotations

from rig.bench.connected import Bench
from rig.bench.driver_settings import deceleration_mm_s2
from rig.control.speed_bound import SpeedBound
from rig.instruments.roles import ReadsTorque

USUAL_DECELERATION_mm_s2 = 200.0
"""Deceleration of a stage whose settings do not state one."""
WATCHED_S = 0.02
"""Time from a force to the order to brake where the thread that reads the force judges it, without
the stage's link: the longest time between two deliveries of frames."""


def braking_bound(bench: Bench, margin_N: float, reaction_s: float = WATCHED_S) -> SpeedBound:
    """Return the bound on the speed of z towards the stiffest contact of the bench's fixture.

    `margin_N` is the force in N that may be added until z stands; `reaction_s` is the time from
    the force to the order to brake. One order takes the time of the stage's link; where the torque
    is read as well, that may delay it by half as much.
    """
    part = next(part for part in bench.plan.instruments if part.role == "stage_z")
    deceleration = deceleration_mm_s2(part.settings)
    if deceleration is None:
        deceleration = USUAL_DECELERATION_mm_s2
    link_s = 1 / bench.stage_z.limits()["update_rate"].high
    if isinstance(bench.stage_z, ReadsTorque):
        link_s *= 1.5
    stiffest_N_mm = bench.settings.fixture.stiffest_N_mm
    return SpeedBound(margin_N, stiffest_N_mm, reaction_s + link_s, deceleration)
