"""How fast z may go down, and the watched way down to a place that is clear of contact.

Where z has not been since the run was armed, something may be in the way: a taller object than the
bench file states, or one that was left there. Such a way is as slow as the force limit requires at
the stiffest contact, and the force is checked all along. A way that z has gone before is quick.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from procedures.pressed.approach.torque_watch import WayTorque
from rig.bench.braking import USUAL_DECELERATION_mm_s2, braking_bound
from rig.bench.settings import FixtureSettings
from rig.control.speed_bound import SpeedBound
from rig.core.errors import InstrumentError

if TYPE_CHECKING:
    from rig.bench.connected import Bench
    from rig.instruments.roles import LinearStage
    from rig.run.context import Run

TRAVEL_mm_s = 10.0
"""Speed of a way that is known to be clear, of a stage that may go so fast (`travel_mm_s`)."""
RISE_N = 0.4
"""Rise of the force that means contact: far above the sensor's noise and its drift on a way."""
REACTION_S = 0.035
"""Time from contact to the order to brake, without the stage's link: frames come every 20 ms at the
latest, the force is checked every 10 ms and averaged over 5 ms."""
CHECKED_EVERY_S = 0.01
WINDOW_S = 0.005
"""Stretch that a check takes the mean force of."""
BASELINE_S = 0.1
"""Stretch at rest that the force is compared with."""
ARRIVED_S = 0.08
"""Expected time of a move in addition to its length divided by its speed: to come up to speed and
to be asked whether it is over (measured)."""
BOTTOM_mm = 0.002
"""Distance in mm from a position, such as the latest contact, at which z has arrived there."""
USUAL_LINK_S = 0.001
"""Time of an order on a link of its own (CMMT), which estimates assume."""


def travel_mm_s(stage: LinearStage) -> float:
    """Return the speed in mm/s of a way that is known to be clear: `TRAVEL_mm_s`, or the largest
    speed of a slower stage. The way off the object is one of these, so no limit may refuse it."""
    return stage.limits()["speed"].nearest(TRAVEL_mm_s)


def speed_bound(bench: Bench, limit_N: float) -> SpeedBound:
    """Return the bound on every speed of z towards a contact on this bench: the force may rise from
    `RISE_N`, which ends the way, to `limit_N`."""
    return braking_bound(bench, limit_N - RISE_N, REACTION_S)


def held_speed_bound(bench: Bench, limit_N: float, held_N: float) -> SpeedBound:
    """Return the bound on every speed of z while the force is brought up to `held_N` or held. The
    thread that reads the force stops z at `limit_N`, so the force may rise by the difference."""
    return braking_bound(bench, limit_N - held_N)


def expected_speed_mm_s(fixture: FixtureSettings, limit_N: float) -> float:
    """Return the speed in mm/s expected of a watched way, before the stage is known."""
    bound = SpeedBound(
        limit_N - RISE_N,
        fixture.stiffest_N_mm,
        REACTION_S + USUAL_LINK_S,
        USUAL_DECELERATION_mm_s2,
    )
    return min(bound.speed_mm_s, TRAVEL_mm_s)


def require_possible(bench: Bench, limit_N: float, held_N: float) -> None:
    """Raise LimitError where the slowest speed of z is faster than the bounds allow."""
    slowest_mm_s = bench.stage_z.limits()["speed"].low
    for bound in (speed_bound(bench, limit_N), held_speed_bound(bench, limit_N, held_N)):
        bound.require("stage_z", slowest_mm_s)


def go_down_watched(run: Run, target_mm: float, where: str) -> None:
    """Move z down to `target_mm` at the bounded speed, with the force watched; return at rest.

    A force that differs by more than `RISE_N` along any axis from what it was before stops z at
    once and raises InstrumentError, which names the place; `where` says where z was going. The
    sensor need not have been zeroed.
    """
    stage, force = run.bench.stage_z, run.force
    run.clock.sleep(BASELINE_S)
    before_N = force.mean_N(BASELINE_S)
    speed_mm_s = min(speed_bound(run.bench, force.limit_N).speed_mm_s, travel_mm_s(stage))
    torque = WayTorque(run)
    stage.start_move(target_mm, speed_mm_s)
    while stage.moving():
        run.clock.sleep(CHECKED_EVERY_S)
        rise_N = float(abs(force.mean_N(WINDOW_S) - before_N).max())
        if rise_N <= RISE_N:
            torque.refuse_rise(float(force.mean_N(WINDOW_S)[2]))
            continue
        stage.stop()
        raise InstrumentError(
            "stage_z",
            "way down",
            f"force_sensor reads a change of {rise_N:.2g} N at {stage.position_mm():.2f} mm on the "
            f"way to {where}: something is in the way",
            "check what is there; correct [fixture] if it belongs there",
        )
    stage.stop()
