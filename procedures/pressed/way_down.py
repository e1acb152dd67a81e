"""How fast z may go down, and the watched way down to a place that is clear of contact.

Where z has not been since the run was armed, something may be in the way: a taller object than the
bench file states, or one that was left there. Such a way is as slow as the force limit requires at
the stiffest contact, and the force is checked all along. A way that z has gone before is quick.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rig.bench.settings import FixtureSettings
from rig.control.speed_bound import SpeedBound
from rig.core.errors import InstrumentError

if TYPE_CHECKING:
    from rig.bench.connected import Bench
    from rig.run.context import Run

TRAVEL_mm_s = 10.0
"""Speed of a way that is known to be clear."""
RISE_N = 0.4
"""Rise of the force that means contact: far above the sensor's noise and its drift on a way."""
REACTION_S = 0.035
"""From contact to the order to brake, without the stage's link: frames are delivered every 20 ms at
the latest, the force is checked every 10 ms and averaged over 5 ms."""
CHECKED_EVERY_S = 0.01
WINDOW_S = 0.005
"""Stretch that a check takes the mean force of."""
BASELINE_S = 0.1
"""Stretch at rest that the force is compared with."""
ARRIVED_S = 0.08
"""Expected of a way beyond its length: to come up to speed and to be asked whether it is over
(measured)."""
USUAL_DECELERATION_mm_s2 = 200.0
"""Deceleration of a stage whose settings do not state one."""
USUAL_LINK_S = 0.001
"""Time of an order on a link of its own (CMMT), which estimates assume."""


def speed_bound(bench: Bench, limit_N: float) -> SpeedBound:
    """Return the bound on every speed of z towards a contact on this bench.

    The force may rise from `RISE_N`, which ends the way, to `limit_N`. The stiffest contact is the
    fixture's, the deceleration the stage's, and one order takes the time of its link.
    """
    part = next(part for part in bench.plan.instruments if part.role == "stage_z")
    deceleration = float(getattr(part.settings, "deceleration_mm_s2", USUAL_DECELERATION_mm_s2))
    link_s = 1 / bench.stage_z.reach()["update_rate"].high
    return _bound(bench.settings.fixture, limit_N, link_s, deceleration)


def expected_speed_mm_s(fixture: FixtureSettings, limit_N: float) -> float:
    """Return the speed in mm/s expected of a watched way, before the stage is known."""
    bound = _bound(fixture, limit_N, USUAL_LINK_S, USUAL_DECELERATION_mm_s2)
    return min(bound.speed_mm_s, TRAVEL_mm_s)


def require_possible(bench: Bench, limit_N: float) -> None:
    """Raise LimitError where the slowest speed of z is faster than the bound allows."""
    speed_bound(bench, limit_N).require("stage_z", bench.stage_z.reach()["speed"].low)


def _bound(
    fixture: FixtureSettings, limit_N: float, link_s: float, deceleration_mm_s2: float
) -> SpeedBound:
    return SpeedBound(
        limit_N - RISE_N, fixture.stiffest_N_mm, REACTION_S + link_s, deceleration_mm_s2
    )


def go_down_watched(run: Run, target_mm: float, where: str) -> None:
    """Move z down to `target_mm` at the bounded speed, with the force watched; return at rest.

    A force that differs by more than `RISE_N` along any axis from what it was before stops z at
    once and raises InstrumentError, which names the place; `where` says where z was going. The
    sensor need not have been zeroed.
    """
    stage, force = run.bench.stage_z, run.force
    run.clock.sleep(BASELINE_S)
    before_N = force.mean_N(BASELINE_S)
    speed_mm_s = min(speed_bound(run.bench, force.limit_N).speed_mm_s, TRAVEL_mm_s)
    stage.start_move(target_mm, speed_mm_s)
    while stage.moving():
        run.clock.sleep(CHECKED_EVERY_S)
        rise_N = float(abs(force.mean_N(WINDOW_S) - before_N).max())
        if rise_N <= RISE_N:
            continue
        stage.stop()
        raise InstrumentError(
            "stage_z",
            "way down",
            f"force_sensor reads a change of {rise_N:.2g} N at {stage.position_mm():.2f} mm on the "
            f"way to {where}: something is in the way",
            "look what stands there; correct [fixture] if it belongs there",
        )
    stage.stop()
