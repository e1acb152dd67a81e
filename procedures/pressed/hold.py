"""The normal force held by a servo on z, one step a tick."""

from __future__ import annotations

from typing import TYPE_CHECKING

from procedures.pressed.axes import SentMove
from procedures.pressed.hold_watch import HeldForceWatch
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

CHANGED_SHARE = 0.25
"""Share of the held force by which it has to have changed where the torque has: a motion changes
both by less."""


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
        self._stepped_s = 0.0
        """Time on the run's clock of the latest step."""
        self._watch = HeldForceWatch(servo.settings, z, largest_force_N)

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
        self._servo.hold_at(force_N, largest_speed_mm_s)
        self._watch.set_point_changes(self._servo.settings)

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
        self._watch.refuse_lost(force_N)
        self._watch.refuse_unfollowed(force_N)
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
        self._watch.refuse_lost(force_N, may_relax=True)

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
