"""Oriental Motor AZ drive (AZD-KD) with one linear actuator as a LinearStage, over Modbus RTU.

Two drives share one RS-485 line. Direct data operation: one write carries target, speed, rates,
current and the trigger that starts it, at rest or under way.

What keeps a lost, doubled or late line from becoming a motion:

* only absolute positions are sent; the same write twice asks for nothing new;
* a stop is the STOP input, which is left standing by `make_safe`: as long as it stands the drive
  starts nothing, whoever asks. `stop` waits for rest and lifts it;
* after `make_safe` no write that could move the axis is sent until `stop` was called;
* keep-alives only read;
* what is asked for again and again is asked for in two lengths in turn, as is a target: RTU has no
  transaction number, so that a doubled answer has the wrong length for the next question.

**Any valid frame on the line feeds both drives' communication time-outs** (HP-5142E p. 236). The
time-out stops both axes of a program that has died, but not the one axis whose answers are lost
while the other is talked to. So each axis checks that every drive of its line answers
(`keep_alive`), and a drive that may not have received a stop is reported as failed.

Sources: HP-5142E (sister product, same registers), om_modbus_master (vendor), M2FS-Control (an
AZD-KD in use), pages of HM-60262E. Not confirmed on an AZ, and to be tried at the first bench:

* starting is refused with exception 04 while STOP is set (`_command_stop`);
* an unknown register is refused with exception 02 (`identify`);
* speed is in steps/s, rates in steps/s2 (`_motion`);
* time-out, limits and overtravel take effect at once, without the command "configuration";
* MOVE shows within `BEGIN_S` after a start (`moving`); outputs are assigned as at the factory;
* HOME-END falls when homing begins and rises when it is over (`home`);
* the register of the operating current reads back what the latest motion was sent with (`_start`).

From memory alone: 00D6h is the torque monitor, in 0.1 % of the largest torque (`torque_percent`). A
drive that refuses it has no torque to watch.

Steps per mm cannot be asked for: they are taken on trust. Nor is there a serial number. On a
vertical axis an alarm that cuts the current, or FREE, drops the load unless a brake is fitted: FREE
is never used; `make_safe` is a stop under power.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence

from drivers.oriental_az.link import (
    AzLine,
    AzLink,
    AzRefusalError,
    halves,
    reading,
    writing,
)
from drivers.oriental_az.preparation import IDENTITY, identify, set_communication, set_limits
from drivers.oriental_az.reader import AzReader
from drivers.oriental_az.readings import AzReadings
from drivers.oriental_az.registers import (
    ABSOLUTE,
    ALARM_RESET,
    COMMAND_POSITION,
    CURRENT,
    DIRECT_DATA,
    INPUT_COMMAND,
    OPERATION_TYPE,
    POSITION_REGISTERS,
    STATE_REGISTERS,
    TRIGGER_ALL,
    AzInput,
    AzInternalOutput,
    AzOutput,
    AzPosition,
    AzState,
)
from drivers.oriental_az.settings import COMMUNICATION_ALARM, OrientalAzSettings, alarm_in_words
from drivers.shared.stage import (
    MotionRefusedError,
    MotionWatch,
    StageInterlock,
    StageState,
    Ticket,
    TravelBound,
    opened,
    prepared,
    stop_and_close,
)
from rig.core.clock import Clock, WallClock
from rig.core.errors import InstrumentError, RigError
from rig.instruments.roles import Identity, LastSeen, Reach

ROLES = ("stage_z", "stage_x")
"""The roles this driver can play; which one, its settings say."""

INPUTS = tuple(f"DIN{number}" for number in range(10))
"""Direct inputs of the drive (HM-60262E p. 378, as M2FS-Control has it)."""
INPUTS_EVERY_S = 0.1
"""Shortest interval in s at which they may be read: a reading takes a tenth of that from the
line."""

Settings = OrientalAzSettings
"""The settings of a bench file, under the name by which the bench asks any driver for them."""

ARRIVAL_POLL_S = 0.02
POLL_S = 0.005
KEEP_ALIVES_PER_TIMEOUT = 5
"""Number of state polls of each drive within its communication time-out."""
OVERDUE = 2.0
"""A keep-alive that is this many times overdue does not wait for the line to be free."""
JUST_SEEN_S = 0.05
"""Age up to which a reading still shows that an axis is on its way."""
UPDATE_S = 0.02
"""The fastest line takes this long for a poll and a new target, with room for keep-alives."""
BEGIN_S = 0.1
"""Longest time in s that the drive may take to show that it moves."""
ACKNOWLEDGE_TIMEOUT_S = 0.5
ALARM_TIMEOUT_S = 5.0
SETTLING_S = 1.0
"""Time in s that a motion may take longer than its profile."""
MAX_OVERTRAVEL_mm = 0.1
"""Largest distance beyond its target at which an axis may be seen that has started from rest."""


class AzAxis:
    """One drive and its axis. `connect` has identified it and set its limits.

    One thread at a time commands motions; any thread may call `stop` or `make_safe` at any time: a
    target that another thread was about to send is not sent afterwards.
    """

    def __init__(self, settings: OrientalAzSettings, clock: Clock, line: AzLine):
        self._settings = settings
        self._clock = clock
        self._device = settings.role
        self._link = AzLink(self._device, line, settings.unit_id, settings.timeout_s, clock)
        self._line = line
        self._readings = AzReadings(self._link)
        self._identity = IDENTITY
        self._interlock = StageInterlock(self._device)
        self._in_charge = False
        """True if this connection has taken the drive over: from then on its alarms are ours."""
        self._reported_alarm = 0
        """The alarm that has been raised already; `keep_alive` does not raise it again."""
        self._stop_stands = False
        """True if a stop by this program may still be in effect."""
        self._current_checked = False
        """True once the drive has read back the operating current that a motion was sent with."""
        self._state_at_s = -1.0
        self._motion: MotionWatch | None = None
        """The motion under way; None if there is none. Another thread's stop clears it."""
        self._travel = TravelBound(
            "mm",
            settings.max_speed_mm_s,
            settings.low_limit_mm,
            settings.high_limit_mm,
        )
        self._position = AzPosition(0, 0)
        self._position_at_s = -1.0
        self._abspen_seen = -1
        """The link's failures when the drive was seen to know where it is: it forgets that only
        with an alarm or without power, and without power it does not answer."""

    # --- the role -----------------------------------------------------------------------------

    @property
    def identity(self) -> Identity:
        """Identity of the drive that answered when it was connected; an AZ reports neither serial
        number nor firmware."""
        return self._identity

    def reach(self) -> Mapping[str, Reach]:
        """Return the position and speed that the bench file allows; what the line has time for."""
        own, owner = self._settings, f"{self._device} {self.identity.model}"
        line = f"{owner}: its line carries a poll and a new target in {self._update_s():.3g} s"
        return {
            "position": Reach(own.low_limit_mm, own.high_limit_mm, "mm", owner),
            "speed": Reach(1 / own.steps_per_mm, own.max_speed_mm_s, "mm/s", owner),
            "update_rate": Reach(0.0, 1 / self._update_s(), "Hz", line),
        }

    @property
    def misreadings(self) -> int:
        """See `CountsMisreadings`."""
        return self._travel.misreadings

    def last_seen(self) -> LastSeen | None:
        """See `RemembersPosition`."""
        seen_s = self._position_at_s
        if seen_s < 0:
            return None
        answered_s = max(seen_s, self._state_at_s)
        return LastSeen(self._mm(self._position.feedback), seen_s, answered_s)

    def homed(self) -> bool:
        """Return whether the drive knows where it is (ABSPEN)."""
        self._poll()
        return bool(self._internal() & AzInternalOutput.ABSPEN)

    def home(self) -> None:
        """Find the reference by the method in the drive's parameters, and wait for it."""
        ticket = self._interlock.ticket()
        self._take_charge()
        self._halt()
        ticket = ticket.after_own_stop()
        self._abspen_seen = -1
        self._travel.forget()
        was_homed = bool(self._internal() & AzInternalOutput.ABSPEN)
        self._send(INPUT_COMMAND, halves(AzInput.HOME), ticket, "home")
        self._await(
            "home",
            ticket,
            lambda: (
                bool(self._poll().outputs & AzOutput.MOVE)
                or (not was_homed and bool(self._internal() & AzInternalOutput.ABSPEN))
            ),
            ACKNOWLEDGE_TIMEOUT_S,
            "did not begin to home",
        )
        self._await(
            "home",
            ticket,
            lambda: (
                not self._poll().outputs & AzOutput.MOVE and self._internal() & _HOMED == _HOMED
            ),
            self._settings.homing_timeout_s,
            "did not find its reference",
            ARRIVAL_POLL_S,
        )
        self._end_motion(ticket, "home")
        self._travel.forget()

    def position_mm(self) -> float:
        """Return the measured position."""
        return self._mm(self._read_position().feedback)

    def start_move(self, position_mm: float, speed_mm_s: float) -> None:
        """Begin to move there, or change the target of the motion under way.

        A motion under way is changed by one write. What ended it meanwhile (an alarm, another
        client's stop) is read as often as keep-alives do; the drive itself refuses to start while
        the stop stands. Raises LimitError outside `reach`, and InstrumentError with nothing sent
        where another thread stops the axis or makes it safe meanwhile.
        """
        self._start(position_mm, speed_mm_s)

    def _start(self, position_mm: float, speed_mm_s: float) -> Ticket:
        """Do what `start_move` does, and return the ticket of the motion."""
        ticket = self._interlock.ticket()
        reach = self.reach()
        reach["position"].require(self._device, "position", position_mm)
        reach["speed"].require(self._device, "speed", speed_mm_s)
        fresh = self._motion is None
        if fresh:
            ticket = self._prepare_motion(ticket)
        else:
            self._interlock.require_armed("move")
            if self._clock.now() - self._state_at_s >= OVERDUE * self._keep_alive_s():
                self._require_own(self._poll())
        target = round(position_mm * self._settings.steps_per_mm)
        # Set before it is sent: a motion whose answer is lost has to be watched all the same.
        self._motion = motion = self._watch(target, speed_mm_s, fresh)
        try:
            self._send(*self._operation(target, speed_mm_s), ticket, "move")
        except MotionRefusedError:
            self._motion = None
            raise
        except AzRefusalError as refused:
            self._motion = None
            raise self._why_refused(refused) from refused
        motion.begun_at_s = self._clock.now()  # it may have waited for the line
        if not self._current_checked:
            self._check_current()
        return ticket

    def _check_current(self) -> None:
        """Read back the operating current of a motion that has begun; one that the drive has not
        taken limits no torque, so it is stopped and raised."""
        wanted, kept = round(10 * self._settings.current_percent), self._link.read_value(CURRENT)
        if kept != wanted:
            self._abort(
                f"its operating current is {kept / 10:g} % where torque_limit_percent asks for "
                f"{wanted / 10:g} %",
                "something else configures the drive, or torque_limit_percent is outside its range",
            )
        self._current_checked = True

    def _watch(self, target: int, speed_mm_s: float, fresh: bool) -> MotionWatch:
        """Return a watch over a motion to `target` from the last known position."""
        own, now_s = self._settings, self._clock.now()
        from_mm, target_mm = self._mm(self._position.feedback), self._mm(target)
        unseen_mm = own.max_speed_mm_s * (now_s - self._position_at_s)
        overtravel_mm = MAX_OVERTRAVEL_mm
        if not fresh:  # it may have to pass the new target, brake and come back
            overtravel_mm += unseen_mm + self._braking_mm()
        longest_s = self._longest_s(abs(target_mm - from_mm) + unseen_mm, speed_mm_s)
        return MotionWatch.towards(target_mm, from_mm, overtravel_mm, longest_s, now_s)

    def moving(self) -> bool:
        """Return whether a motion is under way; raises InstrumentError for an alarm and for a
        motion that was not ended by us.

        An axis that has just been seen in motion is not polled again.
        """
        self._interlock.require_armed("move")
        if self._just_seen_on_its_way():
            return True
        state = self._poll()
        moves = bool(state.outputs & AzOutput.MOVE)
        motion = self._motion  # another thread may stop the axis
        if motion is None:
            return moves
        self._require_own(state)
        here_mm = self._mm(self._read_position().feedback)
        now_s = self._clock.now()
        if moves and now_s <= motion.arrive_by_s:
            return True
        if not moves and self._is_there(here_mm, motion):
            return False
        if not moves and now_s < motion.begun_at_s + BEGIN_S:
            return True
        raise self._error(
            "move",
            f"stands at {here_mm:g} mm and has not arrived at {motion.target:g} mm",
            "check what blocks the axis; the motion may still be under way",
        )

    def move_to(self, position_mm: float, speed_mm_s: float) -> None:
        """Move there, wait, verify by measured position, and end the motion.

        Raises InstrumentError where another thread stops the axis or makes it safe on its way.
        """
        ticket = self._start(position_mm, speed_mm_s)
        while self.moving():
            self._clock.sleep(ARRIVAL_POLL_S)
        self._end_motion(ticket, "move")

    def stop(self) -> None:
        """Stop by the STOP input, wait for rest and lift it; an axis that was made safe may move
        again.

        An alarm does not keep the stop from being verified; it is raised by the next call.
        """
        self._halt(rearm=True)

    def fault(self) -> str | None:
        """See `ReportsFault`."""
        alarm = self._read_state().alarm
        return self._alarm_in_words(alarm)[0] if alarm else None

    def acknowledge_timeout(self) -> bool:
        """See `LinearStage`. The line stays open, since the other axis may use it; the next motion
        takes charge of the drive anew and resets the alarm on the way."""
        if self._read_state().alarm != COMMUNICATION_ALARM:
            return False
        self._in_charge, self._reported_alarm = False, 0
        return True

    def torque_percent(self) -> float | None:
        """See `ReadsTorque`: percent of the largest torque."""
        return self._readings.torque_percent()

    def keep_alive(self) -> None:
        """Feed the communication time-outs of the whole line by reading the drive's state, unless
        that has just been done.

        Where the line is busy and there is time, the read is left for later: the drives of a line
        take turns. Raises InstrumentError for what ended a motion, for an alarm once, when it
        appears, and for a drive of the line that does not answer while another one does.
        """
        if self._link.charging or self._line.waiting:
            return
        age = (self._clock.now() - self._state_at_s) / self._keep_alive_s()
        if age >= OVERDUE or (age >= 1 and self._line.free):
            state = self._read_state()
            if not state.alarm:
                self._reported_alarm = 0
            stopping = self._interlock.is_stopping
            if self._in_charge and not stopping and state.alarm != self._reported_alarm:
                self._require_sound(state)
            if self._motion is not None:
                self._require_own(state)
        self._check_peer_drives()

    def inputs_high(self, names: Sequence[str]) -> Mapping[str, bool]:
        """Return the levels of direct inputs, such as "DIN0": True for high."""
        if self._link.charging:
            raise self._error(
                "read inputs", "the line is waiting out a time-out", "look at its cable"
            )
        return self._readings.inputs_high(names)

    def make_safe(self) -> None:
        """Switch the STOP input on, and verify that the drive has it on.

        It waits for answers, not for bench time, so that a watcher may call it while the bench's
        clock stands: the axis is at rest after speed / deceleration at most. No motion is begun
        afterwards until `stop` has been called, which waits for rest. A connection that turns out
        to be broken is tried once more.
        """
        self._interlock.make_safe(self._command_stop)

    def close(self) -> None:
        """Release the line; its drives meet their time-out unless another axis still uses it."""
        self._link.close()

    # --- connecting ---------------------------------------------------------------------------

    def prepare(self) -> None:
        """Identify; set time-out and limits and read them back; stop what moves."""
        identify(self._link)
        set_communication(self._link, self._settings)
        self._halt()
        set_limits(self._link, self._settings)

    def stop_and_wait(self) -> None:
        """Stop and wait for rest, whatever state the drive is in; the stop stands until a run lifts
        it."""
        self._command_stop()
        self._await_rest()

    # --- taking charge ------------------------------------------------------------------------

    def _take_charge(self) -> None:
        """Reset old alarms, once for each connection."""
        self._interlock.require_armed("switch on")
        state = self._poll()
        if state.alarm and not self._in_charge:
            self._reset_alarm()
        self._in_charge = True

    def _reset_alarm(self) -> None:
        """Pulse the reset, which starts no motion; raise InstrumentError if the alarm remains."""
        for value in (1, 0):
            self._line.wait_until_free()
            self._link.write(
                ALARM_RESET,
                halves(value),
                permit=lambda: self._interlock.require_armed("switch on"),
            )
        give_up = self._clock.now() + ALARM_TIMEOUT_S
        while alarm := self._read_state().alarm:
            if self._clock.now() > give_up:
                raise self._alarmed(alarm)
            self._clock.sleep(POLL_S)

    def _prepare_motion(self, ticket: Ticket) -> Ticket:
        """Check before the first write of a motion that there is no alarm, no earlier stop that is
        still in effect because an answer was lost, that the axis is homed and its position known,
        and return the ticket of the motion. A state that has just been read is not read again: with
        an alarm the drive does not start."""
        self._interlock.require_armed("move")
        now_s = self._clock.now()
        unseen = now_s - self._state_at_s > OVERDUE * self._keep_alive_s()
        if not self._in_charge or self._reported_alarm or unseen:
            self._take_charge()
        if self._stop_stands:
            self._halt()
            ticket = ticket.after_own_stop()
        if self._abspen_seen != self._link.failures:
            if not self._internal() & AzInternalOutput.ABSPEN:
                raise self._error("move", "the axis has not been homed", "home it first")
            self._abspen_seen = self._link.failures
        if now_s - self._position_at_s > JUST_SEEN_S:
            self._read_position()
        return ticket

    # --- stopping -----------------------------------------------------------------------------

    def _halt(self, rearm: bool = False) -> None:
        """Stop, wait for rest, and lift the STOP input unless the axis has been made safe
        meanwhile; alarms are not reported meanwhile."""
        with self._interlock.stopping(rearm) as stop:
            self._motion = None
            self._stop_stands = True
            self._line.wait_until_free()
            self._send_stop(charge=True)
            self._await_rest()
            self._line.wait_until_free()
            # A make_safe that begins after this check sends its stop after the lifting.
            self._lift_stop(lambda: self._interlock.answers_all(stop))

    def _lift_stop(self, allowed: Callable[[], bool]) -> None:
        """Clear the STOP input where that is allowed when it is this write's turn."""

        def permit() -> None:
            if not allowed():
                raise _StopStandsError("the stop stands")

        with contextlib.suppress(_StopStandsError):
            self._link.write(INPUT_COMMAND, halves(AzInput.NONE), permit=permit)
            self._stop_stands = False

    def _end_motion(self, ticket: Ticket, command: str) -> None:
        """End a motion that has arrived. This stop re-arms nothing, and a stop or make_safe by
        another thread since the motion began raises."""
        self._interlock.permit(ticket, command)
        self._halt()
        self._interlock.permit(ticket.after_own_stop(), command)

    def _send_stop(self, charge: bool) -> None:
        self._link.write(INPUT_COMMAND, halves(AzInput.STOP), charge, urgent=True)

    def _command_stop(self) -> None:
        """Switch STOP on and read it back, within the drive's time-out."""
        give_up = time.monotonic() + self._settings.timeout_s
        self._send_stop(charge=False)
        while not self._link.read(INPUT_COMMAND, 2, waits=False)[1] & AzInput.STOP:
            if time.monotonic() > give_up:
                raise self._error("make safe", "did not take the stop", _LOOK)

    def _await_rest(self) -> None:
        longest = self._settings.max_speed_mm_s / self._settings.deceleration_mm_s2 + SETTLING_S
        give_up = self._clock.now() + longest
        while self._read_state().outputs & AzOutput.MOVE:
            if self._clock.now() > give_up:
                raise self._error("stop", f"is still moving after {longest:g} s", _LOOK)
            self._clock.sleep(POLL_S)

    # --- one exchange -------------------------------------------------------------------------

    def _send(self, address: int, words: tuple[int, ...], ticket: Ticket, command: str) -> None:
        """Write what may set the axis going, as the interlock permits."""
        self._line.wait_until_free()
        self._link.write(address, words, permit=lambda: self._interlock.permit(ticket, command))

    def _operation(self, target: int, speed_mm_s: float) -> tuple[int, tuple[int, ...]]:
        """Address and words of the write that starts a motion: in turn with and without the number
        of the operation data, so that two writes in a row differ in length."""
        own = self._settings
        values = (
            0,  # operation data number
            ABSOLUTE,
            target,
            round(speed_mm_s * own.steps_per_mm),
            round(own.acceleration_mm_s2 * own.steps_per_mm),
            round(own.deceleration_mm_s2 * own.steps_per_mm),
            round(10 * own.current_percent),
            TRIGGER_ALL,
        )
        words = tuple(word for value in values for word in halves(value))
        return (OPERATION_TYPE, words[2:]) if self._readings.next_turn() else (DIRECT_DATA, words)

    def _read_state(self) -> AzState:
        state = self._readings.state()
        self._state_at_s = self._clock.now()
        return state

    def _poll(self) -> AzState:
        """Return the drive's state; an alarm raises."""
        state = self._read_state()
        self._require_sound(state)
        return state

    def _internal(self) -> int:
        return self._readings.internal_outputs()

    def _read_position(self) -> AzPosition:
        """Read where the axis is; one that is held back, or runs past its target, raises."""
        motion = self._motion if self._in_charge else None  # another thread may stop the axis
        asked_s, position = self._travel.settled(
            self._look, lambda look: self._mm(look[1].feedback), self._clock.now, motion
        )
        self._position, self._position_at_s = position, self._clock.now()
        wrong = self._travel.judge(
            self._mm(position.feedback), asked_s, self._position_at_s, motion
        )
        if motion is not None:
            self._require_way(position, motion, wrong)
        return position

    def _look(self) -> tuple[float, AzPosition]:
        """Return when the drive was asked for its position, and its answer."""
        asked_s = self._clock.now()
        return asked_s, self._readings.position()

    def _await(
        self,
        command: str,
        ticket: Ticket,
        condition: Callable[[], bool],
        timeout_s: float,
        otherwise: str,
        poll_s: float = POLL_S,
    ) -> None:
        """Poll until the condition is met; a stop by another thread raises."""
        give_up = self._clock.now() + timeout_s
        while not condition():
            self._interlock.permit(ticket, command)
            if self._clock.now() > give_up:
                raise self._error(command, f"{otherwise} within {timeout_s:g} s", _LOOK)
            self._clock.sleep(poll_s)

    # --- judging ------------------------------------------------------------------------------

    def _require_sound(self, state: AzState) -> None:
        """Raise InstrumentError for an alarm, once this connection is in charge."""
        if self._in_charge and state.alarm:
            self._reported_alarm = state.alarm
            raise self._alarmed(state.alarm)

    def _require_own(self, state: AzState) -> None:
        """Require that the motion under way is still in force: no other client has stopped it."""
        ours = self._interlock.state is not StageState.ARMED
        if state.inputs & AzInput.STOP and not ours:
            self._motion = None
            raise self._error("move", _STOPPED_BY_OTHERS, _LOOK)

    def _require_way(self, position: AzPosition, motion: MotionWatch, wrong: str | None) -> None:
        """Require that nothing holds the axis back and that it is where it can be: `wrong` is what
        the bound on its travel says."""
        here_mm = self._mm(position.feedback)
        lag_mm = self._mm(position.command - position.feedback)
        if abs(lag_mm) > self._settings.following_limit_mm:
            self._abort(
                f"is held back by {abs(lag_mm):.3g} mm at {here_mm:g} mm on the way to "
                f"{motion.target:g} mm, at {self._settings.current_percent:g} % of its "
                "current",
                "something is in the way; if it belongs there, raise torque_limit_percent",
            )
        if wrong is not None:
            self._abort(
                wrong, "look at the sensor and at the drive's settings before it moves again"
            )

    def _abort(self, cause: str, hint: str) -> None:
        """Stop, then raise."""
        self._motion = None
        with contextlib.suppress(InstrumentError):  # the cause is what has to be reported
            self._send_stop(charge=True)
        raise self._error("move", cause, hint)

    def _why_refused(self, refused: AzRefusalError) -> InstrumentError:
        """Return the error for a motion that the drive refused to start."""
        state = self._poll()
        if state.inputs & AzInput.STOP:
            return self._error("move", _HELD_BY_OTHERS, "stop the axis first, which lifts it")
        return refused

    def _check_peer_drives(self) -> None:
        """Raise for a drive of this line that has gone silent while another one is talked to."""
        silent = self._line.silent_peer()
        if silent is not None:
            device, silent_s = silent
            raise InstrumentError(
                device,
                "keep alive",
                f"has not answered for {silent_s:.1f} s while another drive on {self._line.path} "
                "is talked to, which feeds its communication time-out: it may still be moving",
                "switch it off by hand if it moves; check its cable and its power",
            )

    def _just_seen_on_its_way(self) -> bool:
        now_s, motion = self._clock.now(), self._motion
        return (
            motion is not None
            and now_s - self._position_at_s <= JUST_SEEN_S
            and now_s - self._state_at_s <= OVERDUE * self._keep_alive_s()
            and now_s <= motion.arrive_by_s
            and not self._is_there(self._mm(self._position.feedback), motion)
        )

    def _is_there(self, here_mm: float, motion: MotionWatch) -> bool:
        return abs(here_mm - motion.target) <= self._settings.position_tolerance_mm

    def _alarmed(self, code: int) -> InstrumentError:
        self._motion, self._abspen_seen = None, -1
        return self._error("drive alarm", *self._alarm_in_words(code))

    def _alarm_in_words(self, code: int) -> tuple[str, str]:
        """Return number with meaning, and remedy, of an alarm."""
        meaning, remedy = alarm_in_words(code)
        if code == COMMUNICATION_ALARM:
            timeout_s = self._settings.communication_timeout_ms * 1e-3
            meaning += f"; {self._line.requests.whose_silence(timeout_s)}"
        return f"{code:02X}h ({meaning})", remedy

    def _error(self, command: str, cause: str, hint: str) -> InstrumentError:
        return InstrumentError(self._device, command, cause, hint)

    # --- times and lengths --------------------------------------------------------------------

    def _mm(self, steps: int) -> float:
        return steps / self._settings.steps_per_mm

    def _braking_mm(self) -> float:
        return self._settings.max_speed_mm_s**2 / (2 * self._settings.deceleration_mm_s2)

    def _longest_s(self, distance_mm: float, speed_mm_s: float) -> float:
        own = self._settings
        ramps_s = 4 * own.max_speed_mm_s / min(own.acceleration_mm_s2, own.deceleration_mm_s2)
        return distance_mm / speed_mm_s + ramps_s + SETTLING_S

    def _keep_alive_s(self) -> float:
        return self._settings.communication_timeout_ms * 1e-3 / KEEP_ALIVES_PER_TIMEOUT

    def _update_s(self) -> float:
        """Return the duration of a poll and a new target, with the keep-alives of two drives on the
        line."""
        line, unit = self._line, self._settings.unit_id
        look = reading(unit, COMMAND_POSITION, max(POSITION_REGISTERS))
        target = writing(unit, DIRECT_DATA, (0,) * 16)
        state = reading(unit, INPUT_COMMAND, max(STATE_REGISTERS))
        kept_alive = 2 * line.exchange_s(state) / self._keep_alive_s()
        return max(UPDATE_S, (line.exchange_s(look) + line.exchange_s(target)) / (1 - kept_alive))


_HOMED = AzInternalOutput.HOME_END | AzInternalOutput.ABSPEN
_LOOK = "check the drive's display and the axis"
_STOPPED_BY_OTHERS = (
    "the motion was stopped, not by this run (make-safe from another terminal, or the drive itself)"
)
_HELD_BY_OTHERS = "a stop is set in the drive, not by this run (make-safe from another terminal)"


class _StopStandsError(RigError):
    """The STOP input may not be lifted: the axis has been made safe meanwhile.

    A RigError, since the line takes every other exception for a failure of its own."""


def connect(settings: OrientalAzSettings, clock: Clock) -> AzAxis:
    """Connect to the drive, leaving its axis at rest and its own limits set."""
    line = AzLine.shared(settings.port, settings.baudrate, settings.parity, clock, settings.role)
    return prepared(AzAxis(settings, clock, line))


def open_reader(settings: OrientalAzSettings, clock: Clock) -> AzReader:
    """See `OffersReader`."""
    return opened(AzReader(settings, clock))


def make_safe(settings: OrientalAzSettings) -> None:
    """Stop the axis over a connection of its own and wait for rest; may be called repeatedly."""
    clock = WallClock()
    line = AzLine(settings.port, settings.baudrate, settings.parity, clock)
    stop_and_close(AzAxis(settings, clock, line))
