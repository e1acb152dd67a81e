"""The normal force held by a servo on z, one step a tick."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from statistics import fmean
from typing import TYPE_CHECKING

from procedures.pressed.approach.torque_watch import SUSPECT
from procedures.pressed.axes import SentMove
from rig.core.errors import InstrumentError

if TYPE_CHECKING:
    from procedures.pressed.approach.torque_watch import TorqueWatch
    from procedures.pressed.axes import PressingStage
    from procedures.pressed.links import TrialLinks
    from procedures.pressed.record.force import TrialForce
    from procedures.pressed.record.trial_record import TrialRecord
    from procedures.pressed.ticks import TrialTicks
    from rig.control.force_servo import ContactShift, ForceServo

SILENT_S = 0.5
"""Longest time in s without an answer of z. After it the force is no longer controlled and all
motion has to stop. A stalled computer is silent for less."""

LOST_SHARE, LOST_STEPS = 0.5, 3
"""Where the force sensor reads less than this share of the held force in so many steps, one after
the other, the force is lost: no motion of a trial changes it so much. The servo would press on at
its full rate if the sensor were at fault."""

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

CHANGED_SHARE = 0.25
"""Share of the held force by which it has to have changed where the torque has: a motion changes
both by less."""


@dataclass(frozen=True)
class _Followed:
    """Where the force has followed last."""

    force_N: float
    """Set point then."""
    position_mm: float
    """Commanded position of z then."""


class ForceHold:
    """Moves z, tick by tick, by what the force asks for."""

    def __init__(
        self,
        servo: ForceServo,
        z: PressingStage,
        links: TrialLinks,
        force: TrialForce,
        record: TrialRecord,
        ticks: TrialTicks,
        at_rest_s: float,
        torque: TorqueWatch,
        largest_force_N: float,
    ):
        self._servo, self._z, self._links = servo, z, links
        self._force, self._record, self._ticks = force, record, ticks
        self._at_rest_s = at_rest_s
        """Time since which z has been at rest where the servo begins. The servo does not use an
        older force."""
        self._stepped_at = ticks.begun
        """Number of the tick of the latest step."""
        self._torque, self._torque_asked = torque, False
        self._reached_N = servo.settings.target_N
        """Force that has been reached: less than the set point while that is being raised."""
        self._stepped_s = 0.0
        """Time on the run's clock of the latest step."""
        self._largest_force_N = largest_force_N
        """Force limit of the trial."""
        self._followed = _Followed(servo.settings.target_N, z.commanded_mm)
        self._latest_N: deque[float] = deque(maxlen=FOLLOWED_STEPS)
        """Force of the latest steps."""
        self._lost = 0
        """Number of successive steps in which the force was lost."""

    @property
    def shift(self) -> ContactShift:
        """Shift of the contact that the motion under way has shown so far."""
        return self._servo.shift

    @property
    def set_force_N(self) -> float:  # noqa: N802 - the unit keeps its capital
        """Set point of the normal force in N."""
        return self._servo.settings.target_N

    def begin_motion(self, expected: ContactShift | None) -> None:
        """Declare that the next step is the first of a motion; `expected` is the `shift` of one
        like it."""
        self._servo.slide_begins(expected)

    def hold_at(self, force_N: float, largest_speed_mm_s: float) -> None:
        """Change the held force, from the next step on, and the largest speed of z; the servo
        brings the force there at its own rate."""
        servo, from_N = self._servo, self._followed.force_N
        before_N = servo.settings.target_N
        servo.hold_at(force_N, largest_speed_mm_s)
        if before_N <= from_N < force_N:  # a rise begins here
            self._followed = _Followed(from_N, self._z.commanded_mm)
        elif force_N < from_N:  # z comes up by what the force falls
            way_mm = (from_N - force_N) / servo.settings.stiffness_N_mm
            self._followed = _Followed(force_N, self._followed.position_mm - way_mm)
        self._reached_N = min(self._reached_N, force_N)

    def squeeze(self, force_N: float, largest_speed_mm_s: float) -> SentMove:
        """Raise the held force and send z on its way at once, not with the next step; return what
        becomes of that move. The servo does the rest."""
        servo, z = self._servo, self._z
        rise_N = force_N - servo.settings.target_N
        self.hold_at(force_N, largest_speed_mm_s)
        step = servo.lead(rise_N, z.clock.now() - self._stepped_s)
        sent = SentMove()
        z.start_move(z.commanded_mm + step.increment_mm, step.speed_mm_s, sent)
        return sent

    def step(self, force_N: float, torque_too: bool) -> None:
        """Give z a new target, and read its torque if it is due and `torque_too`.

        Nothing is asked of a link that is not done with what it was asked before: a target that
        waits there would come later than the servo takes for granted, and the force would ring.
        Raises InstrumentError where z has not answered for longer than `SILENT_S`, and where the
        force is lost, has not followed the set point or contradicts the torque.
        """
        self._refuse_silent()
        force = self._force
        if not self._links.is_idle("stage_z") or force.measured_s < self._at_rest_s:
            self._record.held_back += 1
            return
        self._refuse_lost(force_N)
        self._refuse_unfollowed(force_N)
        self._compare_torque(force_N)
        passed = self._ticks.begun - self._stepped_at
        step = self._servo.step(force_N, passed, self._z.target_late_s, force.older_s)
        self._stepped_at = self._ticks.begun
        self._stepped_s = self._z.clock.now()
        self._z.start_move(self._z.commanded_mm + step.increment_mm, step.speed_mm_s)
        if torque_too and self._torque.is_due():
            self._z.ask_torque(self._torque)
            self._torque_asked = True

    def rest(self, force_N: float) -> None:
        """Leave z where it is in this tick, and read the force all the same.

        Raises InstrumentError where z has not answered for longer than `SILENT_S`, and where the
        force is lost: the next `step` would press on.
        """
        self._refuse_silent()
        self._refuse_lost(force_N)

    def _refuse_silent(self) -> None:
        """Raise InstrumentError where z has not answered for too long."""
        silent_s = self._links.silent_s("stage_z")
        if silent_s > SILENT_S:
            raise InstrumentError(
                "stage_z",
                "hold the force",
                f"no answer for {silent_s:.2g} s: nothing holds "
                f"{self._servo.settings.target_N:g} N",
                "check the connection to the stage, and what else the computer is busy with",
            )

    def _compare_torque(self, force_N: float) -> None:
        """Raise InstrumentError where the latest torque has changed and the force has not."""
        if self._torque_asked:  # and answered: the link is idle
            self._torque_asked = False
            changed_N = CHANGED_SHARE * self._servo.settings.target_N
            self._torque.refuse_rise_in_hold(force_N, changed_N)

    def _refuse_lost(self, force_N: float) -> None:
        """Raise InstrumentError where the force has been lost."""
        self._reached_N = min(max(self._reached_N, force_N), self._servo.settings.target_N)
        self._lost = self._lost + 1 if force_N < LOST_SHARE * self._reached_N else 0
        if self._lost >= LOST_STEPS:
            self._z.stage.stop()
            raise InstrumentError(
                "force_sensor",
                "hold the force",
                f"it reads {force_N:.2g} N where z held {self._reached_N:.3g} N",
                f"check whether the object has given way; otherwise {SUSPECT}",
            )

    def _refuse_unfollowed(self, force_N: float) -> None:
        """Raise InstrumentError where z has pressed on because the set point has risen, and the
        force has not followed."""
        self._latest_N.append(force_N)
        servo, z, followed = self._servo.settings, self._z, self._followed
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
