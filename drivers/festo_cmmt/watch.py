"""What a CMMT drive shows of its axis and of the task under way, and what of it is an error."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

from drivers.festo_cmmt.frames import IMAGE_REGISTERS, Inputs, PosZsw2, Zsw1
from drivers.festo_cmmt.images import task_is_taken
from drivers.festo_cmmt.link import INPUT_IMAGE, CmmtLink
from drivers.festo_cmmt.settings import COMMUNICATION_FAULT, FestoCmmtSettings, fault_in_words
from drivers.shared.stage import (
    STOPPED_BY_OTHERS,
    MotionWatch,
    StageInterlock,
    TravelBound,
    WatchesMotion,
)
from rig.core.clock import Clock
from rig.core.errors import InstrumentError
from rig.instruments.roles import LastSeen

JUST_SEEN_S = 0.01
"""Age in s up to which an answer of the drive is used again, one tick at 100 Hz: a caller that
sends targets at that rate has polled the axis anyway, and a faster one need not poll more often.
For that long a new target may override a stop by another client; a drive with a fault accepts no
target."""
SETTLING_S = 1.0
"""Time in s that a motion may take longer than its profile."""
MAX_OVERTRAVEL_mm = 0.1
"""Largest distance beyond its target at which an axis may be seen that has started from rest: many
times the overshoot of a drive, and less than the distance to any obstacle."""
LOOK = "check the drive's display and the axis"
"""Remedy where a drive does not do what it was asked for."""


class CmmtWatch(WatchesMotion):
    """The axis as its drive shows it, and the watch over its task.

    Any thread may read. A reading that shows that something is wrong ends the task: it drops
    `motion` and may stop the axis, by `send_stop`, which sends the image that does. So does a stop
    in another thread.
    """

    def __init__(
        self,
        link: CmmtLink,
        interlock: StageInterlock,
        send_stop: Callable[[], None],
        settings: FestoCmmtSettings,
        clock: Clock,
    ):
        self._link, self._interlock, self._send_stop = link, interlock, send_stop
        self._settings, self._clock = settings, clock
        self.in_charge = False
        """True if this connection has taken the drive over: from then on its faults are ours."""
        self.reported_fault = 0
        """The fault that has been raised already; a keep-alive does not raise it again."""
        self.seen = Inputs()
        """What the drive has shown last."""
        self._seen_at_s = -1.0
        self._asked_at_s = -1.0
        self.motion: MotionWatch | None = None
        """The task under way; None if there is none. Another thread's stop clears it."""
        self.acknowledged = False
        """True if the drive has shown that it has taken that task."""
        self.travel = TravelBound(
            "mm",
            settings.max_speed_mm_s,
            settings.low_limit_mm,
            settings.high_limit_mm,
            settings.position_unit_mm,
        )
        """Where the axis can be."""

    # --- reading ------------------------------------------------------------------------------

    @property
    def age_s(self) -> float:
        """Bench time since the drive answered for the last time."""
        return self._clock.now() - self._seen_at_s

    def last_seen(self) -> LastSeen | None:
        """See `RemembersPosition`."""
        seen_s = self._seen_at_s
        return None if seen_s < 0 else LastSeen(self._mm(self.seen.position), seen_s, seen_s)

    def read(self, charge: bool = True) -> Inputs:
        """Read the drive's state, and once more where the axis cannot be where it says."""
        if not self.in_charge:
            return self._look(charge)
        return self.travel.settled(
            lambda: self._look(charge),
            lambda seen: self._mm(seen.position),
            self._clock.now,
            self.motion,
        )

    def sound(self) -> Inputs:
        """Read the drive's state; raises InstrumentError, once this connection is in charge, for a
        fault or for anything that has ended the task under way."""
        seen = self.read()
        self._require_sound(seen)
        return seen

    def keep_alive(self) -> None:
        """Read the drive's state; raises as `sound` does, but for a fault only once, when it
        appears."""
        seen = self.read()
        if not self.in_charge or Zsw1.FAULT not in seen.zsw1:
            self.reported_fault = 0
        elif self._interlock.is_stopping or seen.fault == self.reported_fault:
            return
        self._require_sound(seen)

    def _look(self, charge: bool) -> Inputs:
        self._asked_at_s = self._clock.now()
        registers = self._link.read(INPUT_IMAGE, IMAGE_REGISTERS, charge)
        self.seen = Inputs.from_registers(registers)
        self._seen_at_s = self._clock.now()
        return self.seen

    # --- the task under way -------------------------------------------------------------------

    def begin(self, target: int, speed_mm_s: float, fresh: bool) -> MotionWatch:
        """Begin to watch over a motion from the last known position to `target`, in the drive's
        units; return the watch. `fresh`: it is a new task, which the drive has still to take."""
        own = self._settings
        distance_mm = abs(self._mm(target - self.seen.position))
        ramps_s = 4 * own.max_speed_mm_s / min(own.acceleration_mm_s2, own.deceleration_mm_s2)
        # An axis that moves already may have to pass the new target, brake and come back.
        braking_mm = 0.0 if fresh else own.max_speed_mm_s**2 / (2 * own.deceleration_mm_s2)
        watch = MotionWatch.towards(
            self._mm(target),
            self._mm(self.seen.position),
            speed_mm_s,
            MAX_OVERTRAVEL_mm + braking_mm,
            distance_mm / speed_mm_s + ramps_s + SETTLING_S,
            self._clock.now(),
        )
        self.motion = watch  # another thread may drop it at once
        self.acknowledged = not fresh
        return watch

    def moves(self) -> bool:
        """Return whether a motion is under way; raises InstrumentError for a fault and for a motion
        that was not ended by us."""
        seen = self.sound()
        self._interlock.require_armed("move")
        motion = self.motion  # another thread may stop the axis
        if motion is None:
            return Zsw1.STOPPED not in seen.zsw1
        if self._arrived(seen, motion):
            return False
        if self.acknowledged:
            self._require_task(seen)
        if self._clock.now() > motion.arrive_by_s:
            raise self.error(
                "move",
                f"is at {self._mm(seen.position):g} mm and has not arrived at {motion.target:g} mm",
                "check what blocks the axis; the motion may still be under way",
            )
        return True

    def require_task(self) -> None:
        """Require that the task under way is still in force, by what the drive has just shown or
        shows now: a new target must not override a stop that another client commanded."""
        self._require_task(self.seen if self.age_s < JUST_SEEN_S else self.sound())

    def _require_task(self, seen: Inputs) -> None:
        if not task_is_taken(seen):
            self.motion = None
            raise self.error("move", STOPPED_BY_OTHERS, LOOK)

    def _arrived(self, seen: Inputs, motion: MotionWatch) -> bool:
        """Return whether the target is reached by position too: the bit may still be the last
        target's."""
        missing_mm = abs(self._mm(seen.position) - motion.target)
        within = missing_mm <= self._settings.position_tolerance_mm
        return Zsw1.TARGET_REACHED in seen.zsw1 and within

    # --- judging ------------------------------------------------------------------------------

    def _require_sound(self, seen: Inputs) -> None:
        """Raise InstrumentError, once this connection is in charge, for a fault or for anything
        that has ended the task under way."""
        if not self.in_charge:
            return
        if Zsw1.FAULT in seen.zsw1:
            self.reported_fault = seen.fault
            raise self.end_by_fault(seen)
        motion = self.motion  # another thread may stop the axis
        wrong = self.travel.judge(
            self._mm(seen.position), self._asked_at_s, self._clock.now(), motion
        )
        if motion is None:
            return
        if Zsw1.OPERATION_ENABLED not in seen.zsw1:
            self.motion = None
            raise self.error("move", "the drive has switched its power off", LOOK)
        if Zsw1.HOMED not in seen.zsw1:
            self.motion = None
            raise self.error("move", "the axis has lost its reference", "home it again")
        if task_is_taken(seen) and PosZsw2.FIXED_STOP_REACHED in seen.pos_zsw2:
            self._abort(
                f"stopped by its torque limit at {self._mm(seen.position):g} mm on the way to "
                f"{motion.target:g} mm",
                "something is in the way; if it belongs there, check that the force sensor shows "
                "it, then raise torque_limit_percent",
            )
        if wrong is not None:
            self._abort(
                wrong, "look at the encoder and at the drive's settings before it moves again"
            )

    def _abort(self, cause: str, hint: str) -> None:
        """Stop the axis, then raise InstrumentError."""
        with contextlib.suppress(InstrumentError):  # the cause is what has to be reported
            self._send_stop()
        self.motion = None
        raise self.error("move", cause, hint)

    def end_by_fault(self, seen: Inputs) -> InstrumentError:
        """Drop the task, which a fault has ended; return the error to raise."""
        self.motion = None
        return self.error("drive fault", *self.fault_in_words(seen))

    def fault_in_words(self, seen: Inputs) -> tuple[str, str]:
        """Return number with meaning, and remedy, of the fault that the drive shows."""
        meaning, remedy = fault_in_words(seen.fault)
        if seen.fault == COMMUNICATION_FAULT:
            timeout_s = self._settings.communication_timeout_ms * 1e-3
            meaning += f"; {self._link.requests.whose_silence(timeout_s)}"
        return f"{seen.fault} ({meaning})", remedy

    def error(self, command: str, cause: str, hint: str) -> InstrumentError:
        """Return an error of this drive."""
        return InstrumentError(self._settings.role, command, cause, hint)

    def _mm(self, counts: int) -> float:
        return counts * self._settings.position_unit_mm
