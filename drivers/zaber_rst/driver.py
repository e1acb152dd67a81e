"""Zaber X-RST rotary stage as a RotaryStage, in Zaber ASCII over a serial line or TCP.

What keeps a lost, doubled or late line from becoming a motion:

* only absolute angles are sent: a command that arrives twice asks for nothing new, and nothing is
  ever repeated here but a stop;
* speed and acceleration travel with the target in one command, so that no line that is lost
  between them turns the stage at another speed;
* every answer is known by its id and check (`zaber_link`);
* after `make_safe` no command that could turn the stage is sent until `stop` was called: a
  procedure that is a few lines behind its watcher cannot set it going again;
* keep-alives only ask.

The stage has no communication time-out of its own [not confirmed]: when the program has ended, a
turn continues to its target, within the limits of angle, speed and acceleration that are set
in the stage at connect.

Every answer carries the gravest warning flag. One of them, once seen, keeps the stage from turning
until `home` has acknowledged it: a knob's flag goes by itself with the next command to move, but
what was aligned before may not be any more. What else is not confirmed stands in `zaber_settings`.

Source: traffic of the vendor's client zaber-motion 10.2.0.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping

from drivers.shared.stage import (
    MotionRefusedError,
    MotionWatch,
    StageInterlock,
    Ticket,
    TravelBound,
    WatchesMotion,
    opened,
    prepared,
    stop_and_close,
)
from drivers.zaber_rst.dialogue import DEVICE, LOOK, ZaberDialogue, ZaberRejectionError
from drivers.zaber_rst.frames import Reply
from drivers.zaber_rst.reader import ZaberReader
from drivers.zaber_rst.settings import NOT_REFERENCED, NOTES, ZaberRstSettings
from rig.core.clock import Clock, WallClock
from rig.core.errors import InstrumentError
from rig.instruments.roles import Identity, Limits

ROLES = ("rotary",)
"""The roles this driver can play."""

Settings = ZaberRstSettings
"""The settings of a bench file, under the name by which the bench asks any driver for them."""

POLL_S = 0.02
KEEP_ALIVE_S = 0.05
"""Age in s of the last answer at which a keep-alive is sent. It is not shorter, because an exchange
at 115200 baud takes 5 to 10 ms, which a stream of set points needs for itself."""
SETTLING_S = 1.0
"""Time in s that a motion may take longer than its profile."""
SETTLED_S = 0.2
"""Time in s that a stage that reports no motion may be off its target while its loop settles."""
MAX_OVERTRAVEL_deg = 0.1
"""Largest angle beyond its target at which a stage may be seen that has started from rest."""


class ZaberAxis(WatchesMotion):
    """One axis. `connect` has identified it and set its limits.

    One thread at a time commands motions; any thread may call `stop` or `make_safe` at any time: a
    turn that another thread was about to send is not sent afterwards.
    """

    def __init__(self, settings: ZaberRstSettings, clock: Clock):
        self._settings = settings
        self._clock = clock
        self._dialogue = ZaberDialogue(settings, clock)
        self._link = self._dialogue.link
        self._identity: Identity | None = None
        self._interlock = StageInterlock(DEVICE, "stage")
        self._referenced = False
        self._disturbed = ""
        """The flag that keeps it from turning until it is homed."""
        self._closed = False
        self._travel = TravelBound(
            "deg",
            settings.max_speed_deg_s,
            settings.low_limit_deg,
            settings.high_limit_deg,
            settings.microstep_deg,
        )
        self._asked_at_s = -math.inf
        self._seen_deg = 0.0
        self._seen_at_s = -math.inf
        self._idle_from_s = math.inf
        """Since when it has reported no motion; infinite while it moves."""
        self.motion: MotionWatch | None = None
        """The turn under way; None if there is none. Another thread's stop clears it."""
        self._full_stop_s = settings.max_speed_deg_s / settings.max_acceleration_deg_s2
        self._braking_s = self._full_stop_s
        """Longest time in s that a stop may take: the stage may brake with the turn's own
        acceleration."""

    # --- the role -----------------------------------------------------------------------------

    @property
    def identity(self) -> Identity:
        """Identity of the stage that answered when it was connected."""
        assert self._identity is not None, "connect() identifies before anything else"
        return self._identity

    def limits(self) -> Mapping[str, Limits]:
        """Return the angle, speed and acceleration that the bench file allows."""
        own, limited_by = self._settings, f"{DEVICE} {self.identity.model}"
        return {
            "angle": Limits(own.low_limit_deg, own.high_limit_deg, "deg", limited_by),
            "speed": Limits(own.lowest_speed_deg_s, own.max_speed_deg_s, "deg/s", limited_by),
            "acceleration": Limits(
                own.lowest_acceleration_deg_s2, own.max_acceleration_deg_s2, "deg/s^2", limited_by
            ),
        }

    @property
    def misreadings(self) -> int:
        """See `CountsMisreadings`."""
        return self._travel.misreadings

    def homed(self) -> bool:
        """Return whether it has a reference and nothing has put that in doubt since."""
        return not self._doubts()

    def home(self) -> None:
        """Acknowledge the stage's flags, find the reference and wait for it.

        Raises InstrumentError where a flag remains or appears meanwhile.
        """
        ticket = self._interlock.ticket()
        self._halt()
        ticket = ticket.after_own_stop()
        self._move("warnings clear", ticket, "home")
        self._referenced, self._disturbed = False, ""
        self._travel.forget()
        self._move("home", ticket, "home")
        give_up = self._clock.now() + self._settings.homing_timeout_s
        while self._poll():
            self._interlock.permit(ticket, "home")
            if self._clock.now() > give_up:
                raise self._dialogue.error(
                    "home",
                    f"is still searching after {self._settings.homing_timeout_s:g} s",
                    LOOK,
                )
            self._clock.sleep(POLL_S)
        self._interlock.permit(ticket, "home")  # a stop ends homing as finding the reference does
        if left := self._doubts():
            raise self._dialogue.flagged("home", left)
        self._referenced = True
        self._travel.forget()

    def angle_deg(self) -> float:
        """Return the angle by the encoder; without one, the angle that the stage has counted."""
        self._poll()
        return self._seen_deg

    def start_turn(self, angle_deg: float, speed_deg_s: float, acceleration_deg_s2: float) -> None:
        """Begin to turn there, or change the turn under way; LimitError outside `limits`.

        From rest the flags are read first. A turn under way is changed by one command, whose answer
        carries the gravest flag as well: one that disturbs stops the stage. What came and went
        since the last keep-alive is not seen, and the next set point overrides a hand at the knob.
        Raises InstrumentError with nothing sent where another thread stops the stage or makes it
        safe meanwhile.
        """
        self._start(angle_deg, speed_deg_s, acceleration_deg_s2)

    def _start(self, angle_deg: float, speed_deg_s: float, acceleration_deg_s2: float) -> Ticket:
        """Do what `start_turn` does, and return the ticket of the turn."""
        ticket = self._interlock.ticket()
        self._require_reach(angle_deg, speed_deg_s, acceleration_deg_s2)
        self._require_undisturbed()
        before = self.motion
        fresh = before is None
        if fresh:
            self._poll()
            if doubt := self._doubts():
                raise self._dialogue.flagged("turn", doubt)
        own = self._settings
        words = (
            f"move abs {own.microsteps(angle_deg)} {own.speed_data(speed_deg_s)} "
            f"{own.acceleration_data(acceleration_deg_s2)}"
        )
        self._interlock.require_armed("turn")
        # Set before it is sent: a turn whose answer is lost has to be watched all the same. It is
        # then not known which target a stage under way has; one that runs past the new one is
        # stopped.
        motion = self._watch(angle_deg, speed_deg_s, acceleration_deg_s2, fresh)
        self.motion = motion  # another thread may drop it at once
        try:
            reply = self._move(words, ticket, "turn")
        except MotionRefusedError:  # what stops the stage ends the turn of before as well
            self.motion = None
            raise
        except ZaberRejectionError:
            self.take_back(motion, before, ticket)
            raise
        if self._note(reply.flag):
            with contextlib.suppress(InstrumentError):  # the flag is what has to be reported
                self._dialogue.command("stop")
            raise self._dialogue.flagged("turn", reply.flag)
        return ticket

    def moving(self) -> bool:
        """Return whether a turn is under way; raises InstrumentError for a flag and for a turn that
        ended elsewhere."""
        busy = self._poll()
        self._interlock.require_armed("turn")
        self._require_undisturbed()
        motion = self.motion  # another thread may stop the stage
        if motion is None:
            return busy
        missing_deg = abs(self._seen_deg - motion.target)
        if not busy and missing_deg <= self._settings.angle_tolerance_deg:
            self.motion = None
            return False
        now = self._clock.now()
        if now > motion.arrive_by_s or now - self._idle_from_s > SETTLED_S:
            stands = "is still turning, at" if busy else "is at rest at"
            self.motion = None
            raise self._dialogue.error(
                "turn",
                f"{stands} {self._seen_deg:.4f} deg and has not arrived at {motion.target:.4f} deg",
                "check what blocks or slows the stage, then stop it",
            )
        return True

    def turn_to(self, angle_deg: float, speed_deg_s: float, acceleration_deg_s2: float) -> None:
        """Turn there, wait, and verify by the encoder, or without one by the stage's count.

        Raises InstrumentError where another thread stops the stage or makes it safe on its way.
        """
        ticket = self._start(angle_deg, speed_deg_s, acceleration_deg_s2)
        while self.moving():
            self._clock.sleep(POLL_S)
        self._interlock.permit(ticket, "turn")

    def stop(self) -> None:
        """Stop and wait for rest; a stage that was made safe may turn again.

        A flag does not keep the stop from being verified, nor is it acknowledged.
        """
        self._halt(rearm=True)

    def keep_alive(self) -> None:
        """Ask for angle, status and flag, unless that has just been done, or after `close`. Raises
        InstrumentError for a flag once, when it appears, and for a stage that runs past its
        target."""
        if (
            self._closed
            or self._link.charge.under_way
            or self._clock.now() - self._seen_at_s < KEEP_ALIVE_S
        ):
            return
        if self._interlock.is_stopping:
            self._read()
        else:
            self._poll()

    def make_safe(self) -> None:
        """Command a stop and have the stage take it.

        It waits for the answer, not for time, so that a watcher may call it while the bench's clock
        stands: the stage is at rest after speed / acceleration at most. No turn is begun afterwards
        until `stop` has been called, which waits for rest. A connection that turns out to be broken
        is opened again, once.
        """
        self._interlock.make_safe(self._command_stop)

    def _command_stop(self) -> None:
        self._dialogue.command("stop", charge=False)

    def close(self) -> None:
        """Close the port; a turn under way continues to its target."""
        self._closed = True
        self._link.close()

    # --- connecting ---------------------------------------------------------------------------

    def prepare(self) -> None:
        """Identify; check the units; stop what turns; set the limits and read them back."""
        self._identity = self._dialogue.identify()
        self._dialogue.check_units()
        if self._read():
            self._halt()
        self._set_limits()
        flags = self._dialogue.flags()
        self._referenced = not NOT_REFERENCED & set(flags)
        self._disturbed = next((flag for flag in flags if self._disturbs(flag)), "")

    def stop_and_wait(self) -> None:
        """Stop and wait for rest, whatever state the stage is in."""
        self._halt()

    def _set_limits(self) -> None:
        """Write a limit only where it differs, the stage's memory wears; each is read back."""
        own = self._settings
        for name, wanted in (
            ("limit.min", own.microsteps(own.low_limit_deg)),
            ("limit.max", own.microsteps(own.high_limit_deg)),
            ("maxspeed", own.speed_data(own.max_speed_deg_s)),
            ("accel", own.acceleration_data(own.max_acceleration_deg_s2)),
        ):
            if self._dialogue.number(name) == wanted:
                continue
            self._dialogue.command(f"set {name} {wanted}")
            kept = self._dialogue.number(name)
            if kept != wanted:
                raise self._dialogue.error(
                    f"set {name}",
                    f"set to {wanted} but reads back {kept:g}",
                    "the stage does not keep this limit; choose another in the bench file",
                )

    # --- a motion and its watch ---------------------------------------------------------------

    def _watch(
        self, angle_deg: float, speed_deg_s: float, acceleration_deg_s2: float, fresh: bool
    ) -> MotionWatch:
        """Return a watch over a turn from now on, whether its answer comes or not."""
        fastest = self._settings.max_speed_deg_s
        turning_s = speed_deg_s / acceleration_deg_s2
        overtravel_deg = MAX_OVERTRAVEL_deg
        if fresh:
            self._braking_s = max(turning_s, self._full_stop_s)
        else:  # it moves already: it may have to come back, and was seen a while ago
            self._braking_s = max(turning_s, self._braking_s)
            turning_s += 2 * fastest / acceleration_deg_s2
            overtravel_deg += fastest * (KEEP_ALIVE_S + fastest / (2 * acceleration_deg_s2))
        passing_s = (abs(angle_deg - self._seen_deg) + 2 * overtravel_deg) / speed_deg_s
        self._idle_from_s = math.inf
        return MotionWatch.towards(
            angle_deg,
            self._seen_deg,
            speed_deg_s,
            overtravel_deg,
            passing_s + turning_s + SETTLING_S,
            self._clock.now(),
        )

    def _halt(self, rearm: bool = False) -> None:
        """Stop and wait for rest; flags are not reported meanwhile."""
        with self._interlock.stopping(rearm):
            self.motion = None
            self._dialogue.command("stop")
            longest_s = self._braking_s + SETTLING_S
            give_up = self._clock.now() + longest_s
            while self._read():
                if self._clock.now() > give_up:
                    raise self._dialogue.error(
                        "stop", f"is still turning after {longest_s:g} s", LOOK
                    )
                self._clock.sleep(POLL_S)

    def _poll(self) -> bool:
        """Return whether the stage is busy; a flag that has just appeared raises, and so does a
        stage that runs past its target, which is stopped first."""
        known = self._disturbed
        busy = self._read()
        if self._disturbed and not known:
            raise self._dialogue.flagged("status", self._disturbed)
        motion = self.motion  # another thread may stop the stage
        wrong = self._travel.judge(self._seen_deg, self._asked_at_s, self._seen_at_s, motion)
        if wrong is not None:
            with contextlib.suppress(InstrumentError):  # `wrong` is what has to be reported
                self._dialogue.command("stop")
            self.motion = None
            raise self._dialogue.error(
                "turn",
                wrong,
                "look at the encoder and at the stage's settings before it turns again",
            )
        return busy

    def _read(self) -> bool:
        """Read angle, status and flag in one exchange; return whether the stage is busy."""
        reply = self._travel.settled(
            self._look, lambda reply: self._seen_deg, self._clock.now, self.motion
        )
        if reply.busy:
            self._idle_from_s = math.inf
        else:
            self._idle_from_s = min(self._idle_from_s, self._seen_at_s)
        if not self._interlock.is_stopping:
            self._note(reply.flag)
        return reply.busy

    def _look(self) -> Reply:
        """Ask for the angle, and note it; the stage's reply."""
        self._asked_at_s = self._clock.now()
        self._seen_deg, reply = self._dialogue.angle()
        self._seen_at_s = self._clock.now()
        return reply

    # --- flags --------------------------------------------------------------------------------

    def _doubts(self) -> str:
        """Return the reason why the stage may not turn, as a flag; empty if it may."""
        if self._disturbed:
            return self._disturbed
        return next((flag for flag in self._dialogue.flags() if flag not in NOTES), "")

    def _disturbs(self, flag: str) -> bool:
        """Return whether a flag stops the stage; "not homed" does not before the stage has been
        homed."""
        return flag not in NOTES and (self._referenced or flag not in NOT_REFERENCED)

    def _note(self, flag: str) -> bool:
        """Remember a flag from which something has to follow; whether it is one."""
        if not self._disturbs(flag):
            return False
        self._disturbed = self._disturbed or flag
        self.motion = None
        return True

    def _require_undisturbed(self) -> None:
        if self._disturbed:
            raise self._dialogue.flagged("turn", self._disturbed)

    # --- one exchange -------------------------------------------------------------------------

    def _move(self, words: str, ticket: Ticket, command: str) -> Reply:
        """Send what could turn the stage, as the interlock permits."""
        return self._dialogue.command(words, permit=lambda: self._interlock.permit(ticket, command))

    # --- judging ------------------------------------------------------------------------------

    def _require_reach(
        self, angle_deg: float, speed_deg_s: float, acceleration_deg_s2: float
    ) -> None:
        limits = self.limits()
        for what, value in (
            ("angle", angle_deg),
            ("speed", speed_deg_s),
            ("acceleration", acceleration_deg_s2),
        ):
            limits[what].require(DEVICE, what, value)


def connect(settings: ZaberRstSettings, clock: Clock) -> ZaberAxis:
    """Connect to the stage, leaving it at rest and its own limits set."""
    return prepared(ZaberAxis(settings, clock))


def open_reader(settings: ZaberRstSettings, clock: Clock) -> ZaberReader:
    """See `OffersReader`."""
    return opened(ZaberReader(settings, clock))


def make_safe(settings: ZaberRstSettings) -> None:
    """Stop the stage over a connection of its own and wait for rest; may be called repeatedly."""
    stop_and_close(ZaberAxis(settings, WallClock()))
