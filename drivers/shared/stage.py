"""The parts that all drivers of motorised stages share: the interlock, and the watch over one
motion.

No I/O and no protocol. A driver of a new stage owns one `StageInterlock` and keeps three rules:

1. Every command that could move the stage is sent with `StageInterlock.permit` as its last check,
   under the same lock as the command itself (the links take a `permit` argument for this).
2. Every stop of the driver runs inside `StageInterlock.stopping`.
3. `make_safe` hands its stop command to `StageInterlock.make_safe`.

Then these hold, whichever threads call what and when:

* Between a check that passes and its command no other command goes out. A stop that begins after
  the check is therefore sent after the motion, and one that began before makes the check fail.
* After `make_safe` has begun, no motion is sent until a `stop` that began after it had ended has
  seen the stage at rest.
* Only a `stop` that was called from outside (`rearm=True`) re-arms. The stops by which a driver
  ends its own motions do not: a watcher that makes the stage safe just as a motion arrives would
  otherwise be answered by a line of the procedure that knows nothing of it.

    state      entered when                             a motion is   left when
    ---------  ---------------------------------------  ------------  ------------------------------
    ARMED      connected; re-armed                      sent          a stop or make_safe begins
    STOPPING   a stop has begun                         refused       the stop has ended, whether or
                                                                      not it saw the stage at rest
    MADE_SAFE  make_safe has begun, from any state,     refused       a re-arming stop that began
               also where its command fails                           afterwards saw it at rest

MADE_SAFE outlasts any number of stops that fail or do not re-arm, and covers STOPPING.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from enum import Enum
from typing import Protocol, Self, TypeVar

from rig.core.errors import InstrumentError, InstrumentTimeoutError

MAKE_SAFE_PATIENCE_S = 2.0
"""Wall time for which a stop waits for a `make_safe` in another thread: several time-outs of a
link, and less than a shutdown action may take (3 s)."""


STOPPED_BY_OTHERS = (
    "the motion was stopped, not by this run (make-safe from another terminal, or the drive itself)"
)
"""Cause of the error for a motion that something else has ended."""


class StageState(Enum):
    """The states of a stage that decide whether it may be set in motion."""

    ARMED = "armed"
    STOPPING = "stopping"
    MADE_SAFE = "made safe"


class MotionRefusedError(InstrumentError):
    """The interlock did not permit a motion: nothing was sent."""


@dataclass(frozen=True)
class Ticket:
    """A ticket from `StageInterlock.ticket` for one motion: the number of stops that had begun
    before it."""

    stops: int

    def after_own_stop(self) -> Ticket:
        """Return the ticket of the same motion after one stop that was a step of its own
        preparation.

        A second stop, by another thread, still makes it invalid.
        """
        return Ticket(self.stops + 1)


@dataclass(frozen=True)
class StopUnderWay:
    """One stop, as `StageInterlock.stopping` gives it."""

    answers: int
    """Number of calls of `make_safe` that it answers when it has seen the stage at rest."""


class StageInterlock:
    """Decides whether a stage may be set in motion; any thread may call any method.

    `device` is the name used in errors, `noun` what they call the thing that moves. Nothing here
    waits except `stopping`, for a `make_safe` in another thread, at most `MAKE_SAFE_PATIENCE_S`.
    """

    def __init__(self, device: str, noun: str = "axis"):
        self._device, self._noun = device, noun
        self._changed = threading.Condition()
        self._made_safe = 0
        """Calls of `make_safe` that have begun; `_answered` of them by a re-arming stop."""
        self._answered = 0
        self._making_safe = 0
        """Calls of `make_safe` that have not ended yet."""
        self._stops = 0
        """Stops that have begun; `_stopping` of them have not ended yet."""
        self._stopping = 0

    @property
    def state(self) -> StageState:
        """The present state; another thread may change it at any time."""
        with self._changed:
            if self._made_safe != self._answered:
                return StageState.MADE_SAFE
            return StageState.STOPPING if self._stopping else StageState.ARMED

    @property
    def is_stopping(self) -> bool:
        """True if a stop is under way, made safe or not."""
        return self._stopping > 0

    # --- motions ------------------------------------------------------------------------------

    def ticket(self) -> Ticket:
        """Return the ticket that a motion needs for `permit`. Take it first, before anything is
        checked or sent."""
        with self._changed:
            return Ticket(self._stops)

    def permit(self, ticket: Ticket, command: str) -> None:
        """Check that a motion may be sent, or may still be waited for.

        Raises MotionRefusedError, naming `command`, where the stage has been made safe, or where a
        stop that is not the motion's own has begun since the ticket was taken.
        """
        self.require_armed(command)
        if self.has_stopped(ticket):
            raise self._refusal(command, "stopped", "begin the motion again")

    def has_stopped(self, ticket: Ticket) -> bool:
        """Return whether a stop that is not the motion's own has begun since the ticket was
        taken."""
        with self._changed:
            return self._stops != ticket.stops or self._stopping > 0

    def require_armed(self, command: str) -> None:
        """Raise MotionRefusedError, naming `command`, where the stage has been made safe."""
        if self._made_safe != self._answered:
            raise self._refusal(command, "made safe", "stop it before the next motion")

    # --- stops --------------------------------------------------------------------------------

    @contextmanager
    def stopping(self, rearm: bool = False) -> Iterator[StopUnderWay]:
        """Stop the stage: the body commands it and returns when it has seen the stage at rest.

        Tickets taken before become invalid at once. With `rearm` the end of the body re-arms a
        stage that had been made safe before; what the body raises leaves the state as it was.

        A re-arming stop first waits for a `make_safe` under way in another thread, whose command
        might otherwise arrive late and end the next motion, such as the one that lifts the skin.
        Where that takes longer than `MAKE_SAFE_PATIENCE_S`, the stop is carried out but does not
        re-arm.
        """
        with self._changed:
            self._stops += 1
            self._stopping += 1
            answers = self._answered
            if rearm and self._changed.wait_for(
                lambda: not self._making_safe, MAKE_SAFE_PATIENCE_S
            ):
                answers = self._made_safe
        stop = StopUnderWay(answers)
        try:
            yield stop
            with self._changed:
                self._answered = max(self._answered, stop.answers)
        finally:
            with self._changed:
                self._stopping -= 1

    def answers_all(self, stop: StopUnderWay) -> bool:
        """Return whether the stage will be armed when `stop` has seen it at rest.

        It will not be where it has been made safe since the stop began: a stop input that the drive
        holds must then be left standing.
        """
        with self._changed:
            return self._made_safe == max(self._answered, stop.answers)

    def make_safe(self, command_stop: Callable[[], None]) -> None:
        """Refuse all motions from now on, then run `command_stop`, which verifies what it commands.

        A connection that turns out to be broken is tried once more, which opens it again: a stop
        may arrive twice. Not so after a time-out, which has taken its time already. What
        `command_stop` raises is raised; the motions stay refused.
        """
        with self._changed:
            self._made_safe += 1
            self._making_safe += 1
        try:
            try:
                command_stop()
            except InstrumentTimeoutError:
                raise
            except InstrumentError:
                command_stop()
        finally:
            with self._changed:
                self._making_safe -= 1
                self._changed.notify_all()

    def _refusal(self, command: str, what: str, hint: str) -> MotionRefusedError:
        cause = f"the {self._noun} was {what} meanwhile"
        return MotionRefusedError(self._device, command, cause, hint)


@dataclass
class MotionWatch:
    """Limits within which one motion has to be seen; lengths are in the axis's own unit (mm or
    deg).

    A driver makes one for every motion and drops it when the motion ends, in whichever thread.
    """

    target: float
    direction: int
    """Towards larger positions 1, towards smaller ones -1, 0 where the axis stood at the target."""
    overtravel: float
    """Largest distance beyond the target at which the axis may be seen."""
    longest_s: float
    """Longest time in s that the motion may take."""
    begun_at_s: float
    """Bench time at which it was sent; a driver sets it again when the stage has acknowledged."""
    speed: float
    """The commanded speed, in units a second; 0 where it is not known."""

    @classmethod
    def towards(
        cls,
        target: float,
        position: float,
        speed: float,
        overtravel: float,
        longest_s: float,
        begun_at_s: float,
    ) -> Self:
        """Return the watch over a motion from `position` to `target` at `speed`."""
        direction = (target > position) - (target < position)
        return cls(target, direction, overtravel, longest_s, begun_at_s, speed)

    @property
    def arrive_by_s(self) -> float:
        """Bench time by which the axis has to have arrived."""
        return self.begun_at_s + self.longest_s

    def has_passed(self, position: float) -> bool:
        """Return whether the axis has run past its target: a broken encoder, or a drive that runs
        away."""
        return (position - self.target) * self.direction > self.overtravel


class WatchesMotion:
    """What watches over the motion of an axis, `motion`, which any thread may end."""

    motion: MotionWatch | None
    _interlock: StageInterlock

    def take_back(self, refused: MotionWatch, before: MotionWatch | None, ticket: Ticket) -> None:
        """Watch over the motion of before again: the drive has refused `refused`, and an axis under
        way keeps its old target. None is an axis at rest.

        What has ended the motion meanwhile, a reading or a stop, stays in force.
        """
        if self.motion is not refused:
            return
        self.motion = before
        if self._interlock.has_stopped(ticket):  # it may have dropped the motion before this did
            self.motion = None


T = TypeVar("T")

BEYOND = 0.1
"""How far an axis may be seen beyond where it can be, in mm or deg: the resolution of encoders and
the time between a position and its answer."""
STANDS_S = 0.8
"""How long an axis with a motion under way may stand before its target, unless it is slow: much
longer than a drive takes to begin."""
UNSEEN_WAYS = 3.0
"""How long a slow axis may be seen at one place: the time in which it goes this many times the
shortest way that shows. A sound one takes two at most."""
STANDS_WITHIN = 0.01
"""Distance from its target at which an axis may stand, in mm or deg: drives take it to have
arrived there. With coarser steps than this one may stand at the next step."""
LEAST_WAY = 0.0005
"""Way that is not yet a motion, in mm or deg: noise of an encoder."""


@dataclass
class Standing:
    """A place at which an axis is seen although a motion is under way."""

    position: float
    since_s: float
    """Bench time since when it has been seen there."""
    judged_s: float
    """Bench time at which it was last judged."""
    used: float = 0.0
    """Share of the time for which it may stand that has passed. The commanded speed may change from
    tick to tick, and that time with it."""


class TravelBound:
    """The range in which an axis can be, from its highest speed, limits and commanded motion.

    A drive whose answers are sound in form may still be wrong: the axis does not act on what it
    acknowledges, its position stands still or leaps, or it goes farther than ordered. `judge` is
    given every position that a driver reads and returns what cannot be. Lengths are in the axis's
    `unit`. Positions are compared only while a motion is under way: at rest another client, or a
    hand, may move the axis.

    One bit that was turned over on the way makes a position wrong as well, and only once. So a
    driver asks again where a position is in doubt (`settled`), and only the second answer is
    judged.
    """

    def __init__(self, unit: str, highest_speed: float, low: float, high: float, resolution: float):
        """`resolution` is the step of the positions that the stage reports."""
        self._unit, self._highest_speed = unit, highest_speed
        self._low, self._high = low, high
        self._resolution = resolution
        self._latest: tuple[float, float] | None = None
        """The latest position, and when it was asked for."""
        self.misreadings = 0
        """Number of positions that could not be and that the next answer did not confirm."""
        self._stands: Standing | None = None

    def forget(self) -> None:
        """Compare nothing with earlier positions: the reference changes."""
        self._latest = self._stands = None

    def settled(
        self,
        ask: Callable[[], T],
        position: Callable[[T], float],
        now: Callable[[], float],
        motion: MotionWatch | None,
    ) -> T:
        """Ask for a position, and once more where the axis cannot be there; return the latest
        answer.

        `position` is what an answer says, `now` the bench time and `motion` the motion under way.
        """
        answer = ask()
        if self._is_possible(position(answer), now(), motion):
            return answer
        again = ask()
        if self._is_possible(position(again), now(), motion):
            self.misreadings += 1
        return again

    def _is_possible(self, position: float, now_s: float, motion: MotionWatch | None) -> bool:
        passed = motion is not None and motion.has_passed(position)
        return not passed and self._leap(position, now_s, self._latest) is None

    def judge(
        self, position: float, asked_s: float, now_s: float, motion: MotionWatch | None
    ) -> str | None:
        """Return what is wrong with a position, as the cause of an error; None where nothing is.

        `asked_s` and `now_s` are the bench times before the question and after the answer; `motion`
        is the motion under way, None at rest.
        """
        before, self._latest = self._latest, (position, asked_s)
        if motion is None:
            self._stands = None
            return None
        if motion.has_passed(position):
            return (
                f"ran past its target: it is at {self._show(position)} on the way to "
                f"{self._show(motion.target)}"
            )
        return self._leap(position, now_s, before) or self._standstill(
            position, asked_s, now_s, motion
        )

    def _leap(
        self, position: float, now_s: float, before: tuple[float, float] | None
    ) -> str | None:
        """Return the cause where the position cannot have been reached since the one before, or
        has left the limits."""
        if before is None:
            return None
        was, was_s = before
        farthest = self._highest_speed * (now_s - was_s) + BEYOND
        if abs(position - was) > farthest:
            return (
                f"reads {self._show(position)}, {1e3 * (now_s - was_s):.0f} ms after "
                f"{self._show(was)}: at its highest speed of {self._highest_speed:g} "
                f"{self._unit}/s it cannot have gone farther than {self._show(farthest)}"
            )
        if self._inside(was) and not self._inside(position):
            return (
                f"has left its limits of {self._low:g} to {self._high:g} {self._unit}: it is at "
                f"{self._show(position)}"
            )
        return None

    def _standstill(
        self, position: float, asked_s: float, now_s: float, motion: MotionWatch
    ) -> str | None:
        """Return the cause where the axis has stood before its target for too long."""
        if abs(position - motion.target) <= max(STANDS_WITHIN, 1.5 * self._resolution):
            self._stands = None
            return None
        stands = self._stands
        if stands is None or abs(position - stands.position) > LEAST_WAY:
            self._stands = Standing(position, since_s=now_s, judged_s=now_s)
            return None
        # Another thread may have judged a later position meanwhile.
        stands.used += max(0.0, asked_s - stands.judged_s) / self._may_stand_s(motion)
        stands.judged_s = max(stands.judged_s, asked_s)
        if stands.used < 1:
            return None
        self._stands = None
        return (
            f"does not do what its drive acknowledges: it has stood at {self._show(position)} for "
            f"{asked_s - stands.since_s:.1f} s on the way to {self._show(motion.target)}: its "
            "torque limit holds it, or something in the way, or its encoder stands still"
        )

    def _may_stand_s(self, motion: MotionWatch) -> float:
        """Return how long the axis may be seen at one place: a slow one until its next step shows,
        and no longer than its motion may take."""
        if not motion.speed > 0:
            return STANDS_S
        unseen_s = UNSEEN_WAYS * max(self._resolution, LEAST_WAY) / motion.speed
        return max(STANDS_S, min(unseen_s, motion.longest_s))

    def _inside(self, position: float) -> bool:
        return self._low - BEYOND <= position <= self._high + BEYOND

    def _show(self, length: float) -> str:
        return f"{length:.7g} {self._unit}"


class ConnectingStage(Protocol):
    """A stage whose `prepare` identifies it, sets its limits and stops what moves."""

    def prepare(self) -> None:
        """Identify the stage and leave it at rest with its own limits set."""
        ...

    def stop_and_wait(self) -> None:
        """Stop the stage and wait for rest, whatever state it is in."""
        ...

    def close(self) -> None:
        """Close the connection."""
        ...


S = TypeVar("S", bound=ConnectingStage)


def prepared(stage: S) -> S:
    """Prepare a stage that has just been made and return it; one that fails is closed."""
    try:
        stage.prepare()
    except BaseException:
        stage.close()
        raise
    return stage


def stop_and_close(stage: ConnectingStage) -> None:
    """Stop a stage over its connection, wait for rest and close it: a module's `make_safe`."""
    with closing(stage):
        stage.stop_and_wait()


class OpeningReader(Protocol):
    """A reader of a stage whose `open` identifies it."""

    def open(self) -> None:
        """Identify the stage, by reading only."""
        ...

    def close(self) -> None:
        """Close the connection."""
        ...


R = TypeVar("R", bound=OpeningReader)


def opened(reader: R) -> R:
    """Open a reader that has just been made and return it; one that fails is closed."""
    try:
        reader.open()
    except BaseException:
        reader.close()
        raise
    return reader
