"""The watch over a held force: whether it is still there, and whether it follows its set point.

Both are asked before each step of the servo, which would otherwise press on.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from statistics import fmean
from typing import TYPE_CHECKING

from procedures.pressed.approach.torque_watch import SUSPECT
from rig.core.errors import InstrumentError

if TYPE_CHECKING:
    from procedures.pressed.axes import PressingStage
    from rig.control.force_servo import ServoSettings

LOST_SHARE, LOST_STEPS = 0.5, 3
"""Where the force sensor reads less than this share of the held force in so many steps, one after
the other, the force is lost: no motion of a trial changes it so much. The servo would press on at
its full rate if the sensor were at fault."""
RELAXED = "if the force can relax by more than half, hold the place for a shorter time; "
"""Begins the hint while a place is held, where the skin itself may lower the force."""

FOLLOW_FROM = 0.05
"""Rise of the set point, as a share of it, from which the force has to follow: the largest
error of the force in a valid trial. Below it z may move for another reason."""
FOLLOWED_SHARE, FOLLOWED_WITHIN, FOLLOWED_STEPS = 0.25, 0.02, 5
"""The force has followed where its mean over so many steps is as near to the set point as the first
of these, as a share of the rise, or the second, as a share of the set point, which is the largest
rms error of a valid trial: a single reading may be noise."""
FOLLOW_WAY, FOLLOW_SHARE = 2.5, 0.3
"""Way of z, in ways that a rise of the set point needs, and share of the held force that a slip may
take from it meanwhile: where z has gone so far and the force has not followed, the sensor is
suspect. Without this bound the servo would press on with a sensor that shows the old force: it
takes the set point for one that is always missing. Further rises meanwhile extend the way by theirs
and do not begin it again: alarms in a row would press ever further. No way is longer than the force
limit leaves room for."""


@dataclass(frozen=True)
class _Followed:
    """The state in which the force has followed last."""

    force_N: float
    """Set point then."""
    position_mm: float
    """Commanded position of z then."""


class HeldForceWatch:
    """Compares the force that a servo holds by z with its set point."""

    def __init__(self, servo: ServoSettings, z: PressingStage, largest_force_N: float):
        """Watch the force from where it is at the set point of `servo`; `largest_force_N` is the
        force limit of the trial."""
        self._servo, self._z, self._largest_force_N = servo, z, largest_force_N
        self._reached_N = servo.target_N
        """Force that has been reached: less than the set point while that is being raised."""
        self._followed = _Followed(servo.target_N, z.commanded_mm)
        self._latest_N: deque[float] = deque(maxlen=FOLLOWED_STEPS)
        """Force of the latest steps."""
        self._lost = 0
        """Number of successive steps in which the force was lost."""

    def set_point_changes(self, servo: ServoSettings) -> None:
        """Take over the servo's new set point, and where z is when it changes."""
        before_N, force_N, from_N = self._servo.target_N, servo.target_N, self._followed.force_N
        self._servo = servo
        if before_N <= from_N < force_N:  # a rise begins here
            self._followed = _Followed(from_N, self._z.commanded_mm)
        elif force_N < from_N:  # z comes up by what the force falls
            way_mm = (from_N - force_N) / servo.stiffness_N_mm
            self._followed = _Followed(force_N, self._followed.position_mm - way_mm)
        self._reached_N = min(self._reached_N, force_N)

    def refuse_lost(self, force_N: float, may_relax: bool = False) -> None:
        """Raise InstrumentError where the force has been lost. `may_relax` is for a place that is
        held: the hint then names that cause as well."""
        self._reached_N = min(max(self._reached_N, force_N), self._servo.target_N)
        self._lost = self._lost + 1 if force_N < LOST_SHARE * self._reached_N else 0
        if self._lost >= LOST_STEPS:
            self._z.stage.stop()
            raise InstrumentError(
                "force_sensor",
                "hold the force",
                f"it reads {force_N:.2g} N where z held {self._reached_N:.3g} N",
                f"{RELAXED if may_relax else ''}check whether the object has given way; otherwise "
                f"{SUSPECT}",
            )

    def refuse_unfollowed(self, force_N: float) -> None:
        """Raise InstrumentError where z has pressed on because the set point has risen, and the
        force has not followed."""
        self._latest_N.append(force_N)
        servo, z, followed = self._servo, self._z, self._followed
        rise_N = servo.target_N - followed.force_N
        near_N = max(FOLLOWED_SHARE * rise_N, FOLLOWED_WITHIN * servo.target_N)
        if abs(fmean(self._latest_N) - servo.target_N) <= near_N:
            self._followed = _Followed(servo.target_N, z.commanded_mm)
            return
        if rise_N < FOLLOW_FROM * followed.force_N:
            return
        room_N = self._largest_force_N - followed.force_N
        way_N = min(FOLLOW_WAY * rise_N, room_N) + FOLLOW_SHARE * followed.force_N
        if z.commanded_mm > followed.position_mm + way_N / servo.stiffness_N_mm:
            z.stage.stop()
            raise InstrumentError(
                "force_sensor",
                "raise the force",
                f"it reads {force_N:.2g} N at {z.commanded_mm:.3f} mm, where z has pressed on to "
                f"bring it from {followed.force_N:.3g} N to {servo.target_N:.3g} N: the force has "
                "not followed",
                SUSPECT,
            )
