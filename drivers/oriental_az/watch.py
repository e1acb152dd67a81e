"""What an AZ drive shows of its axis and of the motion under way, and what of it is an error."""

from __future__ import annotations

import contextlib

from drivers.oriental_az.link import AzLink
from drivers.oriental_az.motions import braking_mm, keep_alive_s, longest_s
from drivers.oriental_az.readings import AzReadings
from drivers.oriental_az.registers import AzInput, AzInternalOutput, AzOutput, AzPosition, AzState
from drivers.oriental_az.settings import COMMUNICATION_ALARM, OrientalAzSettings, alarm_in_words
from drivers.oriental_az.stop_input import LOOK, StopInput
from drivers.shared.stage import (
    STOPPED_BY_OTHERS,
    MotionWatch,
    StageInterlock,
    StageState,
    TravelBound,
    WatchesMotion,
)
from rig.core.clock import Clock
from rig.core.errors import InstrumentError
from rig.instruments.roles import LastSeen

OVERDUE = 2.0
"""A keep-alive that is this many times overdue does not wait for the line to be free."""
JUST_SEEN_S = 0.05
"""Age up to which a reading still shows that an axis is on its way."""
BEGIN_S = 0.1
"""Longest time in s that the drive may take to show that it moves."""
MAX_OVERTRAVEL_mm = 0.1
"""Largest distance beyond its target at which an axis may be seen that has started from rest."""


class AzWatch(WatchesMotion):
    """The axis as its drive shows it, and the watch over its motion.

    Any thread may read. A reading that shows that something is wrong ends the motion: it drops
    `motion` and may stop the axis. So does a stop in another thread.
    """

    def __init__(
        self,
        link: AzLink,
        readings: AzReadings,
        stop: StopInput,
        interlock: StageInterlock,
        settings: OrientalAzSettings,
        clock: Clock,
    ):
        self._link, self._readings, self._stop = link, readings, stop
        self._interlock, self._settings, self._clock = interlock, settings, clock
        self.in_charge = False
        """True if this connection has taken the drive over: from then on its alarms are ours."""
        self.reported_alarm = 0
        """The alarm that has been raised already; a keep-alive does not raise it again."""
        self.motion: MotionWatch | None = None
        """The motion under way; None if there is none. Another thread's stop clears it."""
        self.travel = TravelBound(
            "mm",
            settings.max_speed_mm_s,
            settings.low_limit_mm,
            settings.high_limit_mm,
            1 / settings.steps_per_mm,
        )
        """Where the axis can be."""
        self._position = AzPosition(0, 0)
        self._position_at_s = -1.0
        self._place_known_at = -1
        """The link's failures when the drive was seen to know where it is: it forgets that only
        with an alarm or without power, and without power it does not answer."""

    # --- reading ------------------------------------------------------------------------------

    @property
    def state_age(self) -> float:
        """Time since the drive showed its state, in intervals between two keep-alives."""
        age_s = self._clock.now() - self._readings.state_at_s
        return age_s / keep_alive_s(self._settings)

    def sound_state(self) -> AzState:
        """Read the drive's state; raises InstrumentError for an alarm, once this connection is in
        charge."""
        state = self._readings.state()
        self._require_sound(state)
        return state

    def own_state(self) -> AzState:
        """Read the drive's state; raises InstrumentError for an alarm, and where another client has
        stopped the motion under way."""
        state = self.sound_state()
        self._require_own(state)
        return state

    def keep_alive(self) -> None:
        """Read the drive's state; raises InstrumentError for an alarm once, when it appears, and
        for a motion that another client has stopped."""
        state = self._readings.state()
        if not state.alarm:
            self.reported_alarm = 0
        stopping = self._interlock.is_stopping
        if self.in_charge and not stopping and state.alarm != self.reported_alarm:
            self._require_sound(state)
        if self.motion is not None:
            self._require_own(state)

    def knows_its_place(self) -> bool:
        """Return whether the drive knows where it is (ABSPEN)."""
        return bool(self._readings.internal_outputs() & AzInternalOutput.ABSPEN)

    def require_homed(self) -> None:
        """Raise InstrumentError where the drive does not know where it is; what cannot have changed
        since it was read is not read again."""
        if self._place_known_at == self._link.failures:
            return
        if not self.knows_its_place():
            raise self.error("move", "the axis has not been homed", "home it first")
        self._place_known_at = self._link.failures

    def forget_its_place(self) -> None:
        """Compare nothing with earlier positions, and ask the drive again whether it knows where it
        is: the reference changes."""
        self._place_known_at = -1
        self.travel.forget()

    def position_mm(self) -> float:
        """Read where the axis is; one that is held back, or runs past its target, is stopped and
        raises InstrumentError."""
        motion = self.motion if self.in_charge else None
        asked_s, position = self.travel.settled(
            self._look, lambda look: self._mm(look[1].feedback), self._clock.now, motion
        )
        self._position, self._position_at_s = position, self._clock.now()
        here_mm = self._mm(position.feedback)
        wrong = self.travel.judge(here_mm, asked_s, self._position_at_s, motion)
        if motion is not None:
            self._require_way(position, motion, wrong)
        return here_mm

    def require_position(self) -> None:
        """Read where the axis is, unless that has just been done."""
        if self._clock.now() - self._position_at_s > JUST_SEEN_S:
            self.position_mm()

    def last_seen(self) -> LastSeen | None:
        """See `RemembersPosition`."""
        seen_s = self._position_at_s
        if seen_s < 0:
            return None
        answered_s = max(seen_s, self._readings.state_at_s)
        return LastSeen(self._mm(self._position.feedback), seen_s, answered_s)

    def _look(self) -> tuple[float, AzPosition]:
        """Return when the drive was asked for its position, and its answer."""
        asked_s = self._clock.now()
        return asked_s, self._readings.position()

    # --- the motion under way -----------------------------------------------------------------

    def begin(self, target: int, speed_mm_s: float, fresh: bool) -> MotionWatch:
        """Begin to watch over a motion from the last known position to `target`, in steps; return
        the watch. `fresh`: it begins at rest."""
        own, now_s = self._settings, self._clock.now()
        from_mm, target_mm = self._mm(self._position.feedback), self._mm(target)
        unseen_mm = own.max_speed_mm_s * (now_s - self._position_at_s)
        overtravel_mm = MAX_OVERTRAVEL_mm
        if not fresh:  # it may have to pass the new target, brake and come back
            overtravel_mm += unseen_mm + braking_mm(own)
        most_s = longest_s(own, abs(target_mm - from_mm) + unseen_mm, speed_mm_s)
        watch = MotionWatch.towards(target_mm, from_mm, speed_mm_s, overtravel_mm, most_s, now_s)
        self.motion = watch  # another thread may drop it at once
        return watch

    def moves(self) -> bool:
        """Return whether a motion is under way; raises InstrumentError for an alarm and for a
        motion that was not ended by us.

        An axis that has just been seen in motion is not asked again.
        """
        if self._just_seen_on_its_way():
            return True
        state = self.sound_state()
        moves = bool(state.outputs & AzOutput.MOVE)
        motion = self.motion  # another thread may stop the axis
        if motion is None:
            return moves
        self._require_own(state)
        here_mm = self.position_mm()
        now_s = self._clock.now()
        if moves and now_s <= motion.arrive_by_s:
            return True
        if not moves and self._is_there(here_mm, motion):
            return False
        if not moves and now_s < motion.begun_at_s + BEGIN_S:
            return True
        raise self.error(
            "move",
            f"is at {here_mm:g} mm and has not arrived at {motion.target:g} mm",
            "check what blocks the axis; the motion may still be under way",
        )

    def abort(self, cause: str, hint: str) -> None:
        """Stop the axis, then raise InstrumentError."""
        self.motion = None
        with contextlib.suppress(InstrumentError):  # the cause is what has to be reported
            self._stop.switch_on()
        raise self.error("move", cause, hint)

    def _just_seen_on_its_way(self) -> bool:
        now_s, motion = self._clock.now(), self.motion
        return (
            motion is not None
            and now_s - self._position_at_s <= JUST_SEEN_S
            and self.state_age <= OVERDUE
            and now_s <= motion.arrive_by_s
            and not self._is_there(self._mm(self._position.feedback), motion)
        )

    def _is_there(self, here_mm: float, motion: MotionWatch) -> bool:
        return abs(here_mm - motion.target) <= self._settings.position_tolerance_mm

    # --- judging ------------------------------------------------------------------------------

    def _require_sound(self, state: AzState) -> None:
        """Raise InstrumentError for an alarm, once this connection is in charge."""
        if self.in_charge and state.alarm:
            self.reported_alarm = state.alarm
            raise self.end_by_alarm(state.alarm)

    def _require_own(self, state: AzState) -> None:
        """Require that the motion under way is still in force: no other client has stopped it."""
        ours = self._interlock.state is not StageState.ARMED
        if state.inputs & AzInput.STOP and not ours:
            self.motion = None
            raise self.error("move", STOPPED_BY_OTHERS, LOOK)

    def _require_way(self, position: AzPosition, motion: MotionWatch, wrong: str | None) -> None:
        """Require that nothing holds the axis back and that it is where it can be: `wrong` is what
        the bound on its travel says."""
        here_mm = self._mm(position.feedback)
        lag_mm = self._mm(position.command - position.feedback)
        if abs(lag_mm) > self._settings.following_limit_mm:
            self.abort(
                f"is held back by {abs(lag_mm):.3g} mm at {here_mm:g} mm on the way to "
                f"{motion.target:g} mm, at {self._settings.current_percent:g} % of its "
                "current",
                "something is in the way; if it belongs there, check that the force sensor shows "
                "it, then raise torque_limit_percent",
            )
        if wrong is not None:
            self.abort(
                wrong, "look at the sensor and at the drive's settings before it moves again"
            )

    def end_by_alarm(self, code: int) -> InstrumentError:
        """Drop the motion, which an alarm has ended, and what was known of the place; return the
        error to raise."""
        self.motion, self._place_known_at = None, -1
        return self.error("drive alarm", *self.alarm_in_words(code))

    def alarm_in_words(self, code: int) -> tuple[str, str]:
        """Return number with meaning, and remedy, of an alarm."""
        meaning, remedy = alarm_in_words(code)
        if code == COMMUNICATION_ALARM:
            timeout_s = self._settings.communication_timeout_ms * 1e-3
            meaning += f"; {self._link.line.requests.whose_silence(timeout_s)}"
        return f"{code:02X}h ({meaning})", remedy

    def error(self, command: str, cause: str, hint: str) -> InstrumentError:
        """Return an error of this drive."""
        return InstrumentError(self._link.device, command, cause, hint)

    def _mm(self, steps: int) -> float:
        return steps / self._settings.steps_per_mm
