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

* starting is refused with exception 04 while STOP is set (`_why_refused`);
* an unknown register is refused with exception 02 (`identify`);
* speed is in steps/s, rates in steps/s2 (`motions.operation`);
* time-out, limits and overtravel take effect at once, without the command "configuration";
* MOVE shows within `watch.BEGIN_S` after a start (`AzWatch.moves`);
* outputs are assigned as at the factory;
* HOME-END falls when homing begins and rises when it is over (`home`);
* the register of the operating current reads back what the latest motion was sent with (`_start`).

From memory alone: 00D6h is the torque monitor, in 0.1 % of the largest torque (`torque_percent`). A
drive that refuses it has no torque to watch.

Steps per mm cannot be asked for: they are taken on trust. Nor is there a serial number. On a
vertical axis an alarm that cuts the current, or FREE, drops the load unless a brake is fitted: FREE
is never used; `make_safe` is a stop under power.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from drivers.oriental_az.link import AzLine, AzLink, AzRefusalError, halves
from drivers.oriental_az.motions import operation, update_s
from drivers.oriental_az.preparation import IDENTITY, identify, set_communication, set_limits
from drivers.oriental_az.reader import AzReader
from drivers.oriental_az.readings import AzReadings
from drivers.oriental_az.registers import (
    ALARM_RESET,
    CURRENT,
    INPUT_COMMAND,
    AzInput,
    AzInternalOutput,
    AzOutput,
)
from drivers.oriental_az.settings import COMMUNICATION_ALARM, OrientalAzSettings
from drivers.oriental_az.stop_input import LOOK, POLL_S, StopInput
from drivers.oriental_az.watch import OVERDUE, AzWatch
from drivers.shared.stage import (
    MotionRefusedError,
    StageInterlock,
    Ticket,
    opened,
    prepared,
    stop_and_close,
)
from rig.core.clock import Clock, WallClock
from rig.core.errors import InstrumentError
from rig.instruments.roles import Identity, LastSeen, Limits

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
ACKNOWLEDGE_TIMEOUT_S = 0.5
ALARM_TIMEOUT_S = 5.0


class AzAxis:
    """One drive and its axis. `connect` has identified it and set its limits.

    One thread at a time commands motions; any thread may call `stop` or `make_safe` at any time: a
    target that another thread was about to send is not sent afterwards.
    """

    def __init__(self, settings: OrientalAzSettings, clock: Clock, line: AzLine):
        self._settings, self._clock, self._line = settings, clock, line
        self._device = settings.role
        self._link = AzLink(self._device, line, settings.unit_id, settings.timeout_s, clock)
        self._readings = AzReadings(self._link, clock)
        self._interlock = StageInterlock(self._device)
        self._stop = StopInput(self._link, self._readings, settings, clock)
        self._watch = AzWatch(
            self._link, self._readings, self._stop, self._interlock, settings, clock
        )
        self._current_checked = False
        """True once the drive has read back the operating current that a motion was sent with."""

    # --- the role -----------------------------------------------------------------------------

    @property
    def identity(self) -> Identity:
        """Identity of the drive that answered when it was connected; an AZ reports neither serial
        number nor firmware."""
        return IDENTITY

    def limits(self) -> Mapping[str, Limits]:
        """Return the position and speed that the bench file allows; what the line has time for."""
        own, limited_by = self._settings, f"{self._device} {self.identity.model}"
        shortest_s = update_s(own, self._line)
        line = f"{limited_by}: its line carries a poll and a new target in {shortest_s:.3g} s"
        return {
            "position": Limits(own.low_limit_mm, own.high_limit_mm, "mm", limited_by),
            "speed": Limits(1 / own.steps_per_mm, own.max_speed_mm_s, "mm/s", limited_by),
            "update_rate": Limits(0.0, 1 / shortest_s, "Hz", line),
        }

    @property
    def misreadings(self) -> int:
        """See `CountsMisreadings`."""
        return self._watch.travel.misreadings

    def last_seen(self) -> LastSeen | None:
        """See `RemembersPosition`."""
        return self._watch.last_seen()

    def homed(self) -> bool:
        """Return whether the drive knows where it is (ABSPEN)."""
        self._watch.sound_state()
        return self._watch.knows_its_place()

    def home(self) -> None:
        """Find the reference by the method in the drive's parameters, and wait for it."""
        ticket = self._interlock.ticket()
        self._take_charge()
        self._halt()
        ticket = ticket.after_own_stop()
        self._watch.forget_its_place()
        was_homed = self._watch.knows_its_place()
        self._send(INPUT_COMMAND, halves(AzInput.HOME), ticket, "home")
        self._await(
            "home",
            ticket,
            lambda: self._in_motion() or (not was_homed and self._watch.knows_its_place()),
            ACKNOWLEDGE_TIMEOUT_S,
            "did not begin to home",
        )
        self._await(
            "home",
            ticket,
            lambda: not self._in_motion() and self._readings.internal_outputs() & _HOMED == _HOMED,
            self._settings.homing_timeout_s,
            "did not find its reference",
            ARRIVAL_POLL_S,
        )
        self._end_motion(ticket, "home")
        self._watch.travel.forget()

    def position_mm(self) -> float:
        """Return the measured position."""
        return self._watch.position_mm()

    def start_move(self, position_mm: float, speed_mm_s: float) -> None:
        """Begin to move there, or change the target of the motion under way.

        A motion under way is changed by one write. What ended it meanwhile (an alarm, another
        client's stop) is read as often as keep-alives do; the drive itself refuses to start while
        the stop stands. Raises LimitError outside `limits`, and InstrumentError with nothing sent
        where another thread stops the axis or makes it safe meanwhile.
        """
        self._start(position_mm, speed_mm_s)

    def _start(self, position_mm: float, speed_mm_s: float) -> Ticket:
        """Do what `start_move` does, and return the ticket of the motion."""
        ticket = self._interlock.ticket()
        limits = self.limits()
        limits["position"].require(self._device, "position", position_mm)
        limits["speed"].require(self._device, "speed", speed_mm_s)
        before = self._watch.motion
        fresh = before is None
        if fresh:
            ticket = self._prepare_motion(ticket)
        else:
            self._interlock.require_armed("move")
            if self._watch.state_age >= OVERDUE:
                self._watch.own_state()
        target = round(position_mm * self._settings.steps_per_mm)
        # Before it is sent: a motion whose answer is lost has to be watched all the same. It is not
        # known then which target an axis under way has; one that runs past the new one is stopped.
        motion = self._watch.begin(target, speed_mm_s, fresh)
        # Two lengths in turn: a doubled answer does not fit the next write.
        numbered = self._readings.next_turn() == 0
        try:
            self._send(*operation(self._settings, target, speed_mm_s, numbered), ticket, "move")
        except MotionRefusedError:  # what stops the axis ends the motion of before as well
            self._watch.motion = None
            raise
        except AzRefusalError as refused:
            self._watch.take_back(motion, before, ticket)
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
            self._watch.abort(
                f"its operating current is {kept / 10:g} % where torque_limit_percent asks for "
                f"{wanted / 10:g} %",
                "something else configures the drive, or torque_limit_percent is outside its range",
            )
        self._current_checked = True

    def moving(self) -> bool:
        """Return whether a motion is under way; raises InstrumentError for an alarm and for a
        motion that was not ended by us."""
        self._interlock.require_armed("move")
        return self._watch.moves()

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
        alarm = self._readings.state().alarm
        return self._watch.alarm_in_words(alarm)[0] if alarm else None

    def acknowledge_timeout(self) -> bool:
        """See `LinearStage`. The line stays open, since the other axis may use it; the next motion
        takes charge of the drive again and resets the alarm on the way."""
        if self._readings.state().alarm != COMMUNICATION_ALARM:
            return False
        self._watch.in_charge, self._watch.reported_alarm = False, 0
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
        if self._link.charge.under_way or self._line.waiting:
            return
        age = self._watch.state_age
        if age >= OVERDUE or (age >= 1 and self._line.free):
            self._watch.keep_alive()
        self._check_peer_drives()

    def inputs_high(self, names: Sequence[str]) -> Mapping[str, bool]:
        """Return the levels of direct inputs, such as "DIN0": True for high.

        Raises InstrumentError while the line waits out a time-out.
        """
        if self._link.charge.under_way:
            raise self._watch.error(
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
        self._interlock.make_safe(self._stop.switch_on_and_verify)

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
        self._stop.switch_on_and_verify()
        self._stop.await_rest()

    # --- taking charge ------------------------------------------------------------------------

    def _take_charge(self) -> None:
        """Reset old alarms, once for each connection."""
        self._interlock.require_armed("switch on")
        state = self._watch.sound_state()
        if state.alarm and not self._watch.in_charge:
            self._reset_alarm()
        self._watch.in_charge = True

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
        while alarm := self._readings.state().alarm:
            if self._clock.now() > give_up:
                raise self._watch.end_by_alarm(alarm)
            self._clock.sleep(POLL_S)

    def _prepare_motion(self, ticket: Ticket) -> Ticket:
        """Check before the first write of a motion that there is no alarm, no earlier stop that is
        still in effect because an answer was lost, that the axis is homed and its position known,
        and return the ticket of the motion. A state that has just been read is not read again: with
        an alarm the drive does not start."""
        self._interlock.require_armed("move")
        unseen = self._watch.state_age > OVERDUE
        if not self._watch.in_charge or self._watch.reported_alarm or unseen:
            self._take_charge()
        if self._stop.may_stand:
            self._halt()
            ticket = ticket.after_own_stop()
        self._watch.require_homed()
        self._watch.require_position()
        return ticket

    # --- stopping -----------------------------------------------------------------------------

    def _halt(self, rearm: bool = False) -> None:
        """Stop, wait for rest, and lift the STOP input unless the axis has been made safe
        meanwhile; alarms are not reported meanwhile."""
        with self._interlock.stopping(rearm) as stop:
            self._watch.motion = None
            # A make_safe that begins after this check sends its stop after the lifting.
            self._stop.stop_and_lift(lambda: self._interlock.answers_all(stop))

    def _end_motion(self, ticket: Ticket, command: str) -> None:
        """End a motion that has arrived. This stop re-arms nothing, and a stop or make_safe by
        another thread since the motion began raises."""
        self._interlock.permit(ticket, command)
        self._halt()
        self._interlock.permit(ticket.after_own_stop(), command)

    # --- one exchange -------------------------------------------------------------------------

    def _send(self, address: int, words: tuple[int, ...], ticket: Ticket, command: str) -> None:
        """Write what may set the axis going, as the interlock permits."""
        self._line.wait_until_free()
        self._link.write(address, words, permit=lambda: self._interlock.permit(ticket, command))

    def _in_motion(self) -> bool:
        return bool(self._watch.sound_state().outputs & AzOutput.MOVE)

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
                raise self._watch.error(command, f"{otherwise} within {timeout_s:g} s", LOOK)
            self._clock.sleep(poll_s)

    def _why_refused(self, refused: AzRefusalError) -> InstrumentError:
        """Return the error for a motion that the drive refused to start. Where a stop stands, none
        is under way."""
        if self._watch.sound_state().inputs & AzInput.STOP:
            self._watch.motion = None
            return self._watch.error("move", _HELD_BY_OTHERS, "stop the axis first, which lifts it")
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


_HOMED = AzInternalOutput.HOME_END | AzInternalOutput.ABSPEN
_HELD_BY_OTHERS = "a stop is set in the drive, not by this run (make-safe from another terminal)"


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
