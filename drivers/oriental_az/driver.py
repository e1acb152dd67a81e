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
while the other is talked to. So each axis minds that every drive of its line is heard
(`keep_alive`), and a drive that may not have heard a stop is told as failed.

Sources: HP-5142E (sister product, same registers), om_modbus_master (vendor), M2FS-Control (an
AZD-KD in use), pages of HM-60262E. Not confirmed on an AZ, and to be tried at the first bench:

* starting is refused with exception 04 while STOP stands (`_command_stop`);
* an unknown register is refused with exception 02 (`_identify`);
* speed is in steps/s, rates in steps/s2 (`_motion`);
* time-out, limits and overtravel take effect at once, without the command "configuration";
* MOVE shows within `BEGIN_S` after a start (`moving`); outputs are assigned as at the factory;
* HOME-END falls when homing begins and rises when it is over (`home`).

Steps per mm cannot be asked for: they are taken on trust. Nor is there a serial number. On a
vertical axis an alarm that cuts the current, or FREE, drops the load unless a brake is fitted: FREE
is never used; `make_safe` is a stop under power.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntFlag

from drivers.oriental_az.link import AzLink, RefusedError, RtuLine, halves, reading, signed, writing
from drivers.oriental_az.settings import ALARMS, Settings
from rig.core.clock import Clock, WallClock
from rig.core.errors import InstrumentError, InstrumentTimeoutError
from rig.instruments.roles import Identity, Reach

ROLES = ("stage_z", "stage_x")
"""The roles this driver can play; which one, its settings say."""

# Upper registers of 32-bit values.
DIRECT_DATA, OPERATION_TYPE = 0x58, 0x5A
INPUT_COMMAND, OUTPUT_STATUS = 0x7C, 0x7E
COMMAND_POSITION = 0xC6
TEMPERATURES = 0xF8
INTERNAL_OUTPUTS = 0x178
ALARM_RESET = 0x180
OVERTRAVEL, HIGH_LIMIT, LOW_LIMIT = 0x386, 0x388, 0x38A
LINE_TIMEOUT_ms, SLAVE_ERROR_RESPONSE = 0x138A, 0x1392
ABSOLUTE, TRIGGER_ALL, TO_EXECUTION = 1, 1, 0
DECELERATION_STOP, EXCEPTION_REPLY = 1, 1
STATE_REGISTERS = (6, 4)
"""Input command, outputs and alarm; in turn without the alarm, which the outputs show as well."""
POSITION_REGISTERS = (8, 10)
"""Command position up to feedback position; in turn with the feedback speed."""
OUTSIDE_C = (-40.0, 150.0)
"""Beyond these no drive or motor tells a temperature."""

ARRIVAL_POLL_S = 0.02
POLL_S = 0.005
KEEP_ALIVES_PER_TIMEOUT = 5
"""How often each drive is asked for its state within its communication time-out."""
OVERDUE = 2.0
"""From how many times as late it does not wait for the line to be free."""
JUST_SEEN_S = 0.05
"""So old may be what tells that an axis is on its way."""
UPDATE_S = 0.02
"""Of a line at its fastest: a look at the axis and a new target, and room for keep-alives."""
BEGIN_S = 0.1
"""How long the drive may take to show that it moves."""
ACKNOWLEDGE_TIMEOUT_S = 0.5
ALARM_TIMEOUT_S = 5.0
SETTLING_S = 1.0
"""What a motion may take beyond its profile."""
PAST_mm = 0.1
"""How far beyond its target an axis may be seen that has come to it from rest."""


class Input(IntFlag):
    """Driver input command, lower register."""

    NONE = 0
    HOME = 0x10
    STOP = 0x20


class Output(IntFlag):
    """Driver output status, lower register, as assigned at the factory."""

    READY = 1 << 5
    ALARM = 1 << 7
    MOVE = 1 << 13


class Internal(IntFlag):
    """Internal outputs, upper register."""

    HOME_END = 1 << 0
    ABSPEN = 1 << 1


@dataclass(frozen=True)
class State:
    """What a drive shows of itself."""

    inputs: int
    outputs: int
    alarm: int


@dataclass(frozen=True)
class Place:
    """Where an axis is told to be and where it is, in steps."""

    command: int
    feedback: int


class Axis:
    """One drive and its axis. `connect` has identified it and set its limits.

    One thread at a time commands motions; any thread may call `stop` or `make_safe` at any time: a
    target that another thread was about to send is not sent afterwards.
    """

    def __init__(self, settings: Settings, clock: Clock, line: RtuLine):
        self._settings = settings
        self._clock = clock
        self._device = settings.role
        self._link = AzLink(self._device, line, settings.unit_id, settings.timeout_s, clock)
        self._line = line
        self._identity = Identity("Oriental Motor", "AZ", "unknown", "unknown")
        self._sending = threading.Lock()
        self._made_safe = 0
        """How often the axis was made safe, and how many of these a stop has answered."""
        self._rearmed = 0
        self._halts = 0
        """How often it was told to stop and wait for rest."""
        self._in_charge = False
        """Whether this connection has taken the drive over: from then on, alarms are ours."""
        self._told_alarm = 0
        self._halting = False
        self._stop_stands = False
        """Whether a stop of ours may not have been lifted."""
        self._turn = 0
        """Which of two lengths is next."""
        self._state_at_s = -1.0
        self._target: int | None = None
        """Where the motion under way ends, in steps."""
        self._way = 0
        """In which direction from where it began: 1, -1, or 0 where it stood there."""
        self._past_mm = PAST_mm
        self._begun_at_s = 0.0
        self._arrive_by_s = 0.0
        self._place = Place(0, 0)
        self._place_at_s = -1.0
        self._abspen_seen = -1
        """The link's failures when the drive was seen to know where it is: it forgets that only
        with an alarm or without power, and without power it does not answer."""

    # --- the role -----------------------------------------------------------------------------

    @property
    def identity(self) -> Identity:
        """Who answered at connect; an AZ tells neither serial number nor firmware."""
        return self._identity

    def reach(self) -> Mapping[str, Reach]:
        """Position and speed that the bench file allows; what the line has time for."""
        own, owner = self._settings, f"{self._device} {self.identity.model}"
        line = f"{owner}: its line carries a look and a new target in {self._update_s():.3g} s"
        return {
            "position": Reach(own.low_limit_mm, own.high_limit_mm, "mm", owner),
            "speed": Reach(1 / own.steps_per_mm, own.max_speed_mm_s, "mm/s", owner),
            "update_rate": Reach(0.0, 1 / self._update_s(), "Hz", line),
        }

    def homed(self) -> bool:
        """Whether the drive knows where it is (ABSPEN)."""
        self._look()
        return bool(self._internal() & Internal.ABSPEN)

    def home(self) -> None:
        """Find the reference by the method in the drive's parameters, and wait for it."""
        self._take_charge()
        self._halt(self._rearmed)
        self._abspen_seen = -1
        was_homed = bool(self._internal() & Internal.ABSPEN)
        self._put(INPUT_COMMAND, halves(Input.HOME))
        self._await(
            "home",
            lambda: (
                bool(self._look().outputs & Output.MOVE)
                or (not was_homed and bool(self._internal() & Internal.ABSPEN))
            ),
            ACKNOWLEDGE_TIMEOUT_S,
            "did not begin to home",
        )
        self._await(
            "home",
            lambda: not self._look().outputs & Output.MOVE and self._internal() & _HOMED == _HOMED,
            self._settings.homing_timeout_s,
            "did not find its reference",
            ARRIVAL_POLL_S,
        )
        self.stop()

    def position_mm(self) -> float:
        """The measured position."""
        return self._mm(self._where().feedback)

    def start_move(self, position_mm: float, speed_mm_s: float) -> None:
        """Begin to move there, or change the target of the motion under way.

        A motion under way is changed by one write. What ended it meanwhile (an alarm, somebody
        else's stop) is read as often as keep-alives do; the drive itself refuses to start while it
        stands. LimitError outside `reach`; InstrumentError, and nothing sent, where another thread
        stops the axis meanwhile.
        """
        reach = self.reach()
        reach["position"].require(self._device, "position", position_mm)
        reach["speed"].require(self._device, "speed", speed_mm_s)
        fresh = self._target is None
        if fresh:
            self._prepare_motion()
        else:
            self._refuse_if_made_safe("move")
            if self._clock.now() - self._state_at_s >= OVERDUE * self._keep_alive_s():
                self._require_own(self._look())
        target = round(position_mm * self._settings.steps_per_mm)
        halts = self._halts
        way_mm = self._mm(target - self._place.feedback)
        unseen_mm = self._settings.max_speed_mm_s * (self._clock.now() - self._place_at_s)
        self._target = target
        self._way = (way_mm > 0) - (way_mm < 0)
        self._past_mm = PAST_mm if fresh else PAST_mm + unseen_mm + self._braking_mm()
        self._arrive_by_s = self._longest_s(abs(way_mm) + unseen_mm, speed_mm_s)
        try:
            self._put(*self._motion(target, speed_mm_s), halts)
        except RefusedError as refused:
            self._target = None
            raise self._why_refused(refused) from refused
        self._begun_at_s = self._clock.now()
        self._arrive_by_s += self._begun_at_s

    def moving(self) -> bool:
        """Whether a motion is under way; an alarm, or a motion that ended elsewhere, raises.

        An axis that has just been seen on its way is not asked again.
        """
        self._refuse_if_made_safe("move")
        if self._just_seen_on_its_way():
            return True
        state = self._look()
        moves = bool(state.outputs & Output.MOVE)
        target = self._target  # another thread may stop the axis
        if target is None:
            return moves
        self._require_own(state)
        here = self._where().feedback
        now_s = self._clock.now()
        if moves and now_s <= self._arrive_by_s:
            return True
        if not moves and self._is_there(here, target):
            return False
        if not moves and now_s < self._begun_at_s + BEGIN_S:
            return True
        raise self._error(
            "move",
            f"stands at {self._mm(here):g} mm and has not arrived at {self._mm(target):g} mm",
            "look for what holds the axis; the motion may still be under way",
        )

    def move_to(self, position_mm: float, speed_mm_s: float) -> None:
        """Move there, wait, verify by measured position, and end the motion."""
        self.start_move(position_mm, speed_mm_s)
        while self.moving():
            self._clock.sleep(ARRIVAL_POLL_S)
        self.stop()

    def stop(self) -> None:
        """Stop by the STOP input, wait for rest and lift it: afterwards the axis may move again.

        An alarm does not keep it from being verified; it is raised by the next call.
        """
        answered = self._made_safe
        self._halt(answered)
        self._rearmed = answered

    def keep_alive(self) -> None:
        """Read the drive's state, unless that has just been done: it feeds the communication
        time-outs of the whole line. Where the line is busy and there is time, it is left for later:
        the drives of a line take turns. What ended a motion raises, and so does an alarm, once when
        it appears, and a drive of the line that is not heard while another one is."""
        if self._link.charging or self._line.waiting:
            return
        age = (self._clock.now() - self._state_at_s) / self._keep_alive_s()
        if age >= OVERDUE or (age >= 1 and self._line.free):
            state = self._read_state()
            if not state.alarm:
                self._told_alarm = 0
            if self._in_charge and not self._halting and state.alarm != self._told_alarm:
                self._require_sound(state)
            if self._target is not None:
                self._require_own(state)
        self._mind_the_line()

    def make_safe(self) -> None:
        """Have the STOP input stand, and verify that the drive has it.

        It waits for answers, not for bench time, so that a watcher may call it while the bench's
        clock stands: the axis is at rest after speed / deceleration at most. No motion is begun
        afterwards until `stop` has been called, which waits for rest. Over a connection that turns
        out to be broken it is said again, once: a stop may arrive twice.
        """
        self._made_safe += 1
        try:
            self._command_stop()
        except InstrumentTimeoutError:
            raise
        except InstrumentError:
            self._command_stop()

    def close(self) -> None:
        """Let go of the line; where nobody else talks on it, its drives meet their time-out."""
        self._link.close()

    # --- connecting ---------------------------------------------------------------------------

    def prepare(self) -> None:
        """Identify; set time-out and limits and read them back; stop what moves."""
        own = self._settings
        self._identify()
        self._link.set_value(LINE_TIMEOUT_ms, own.communication_timeout_ms)
        self._line.watch(own.unit_id, self._device, own.communication_timeout_ms * 1e-3)
        self._link.set_value(SLAVE_ERROR_RESPONSE, EXCEPTION_REPLY)
        self._halt(self._rearmed)
        self._link.set_value(LOW_LIMIT, round(own.low_limit_mm * own.steps_per_mm))
        self._link.set_value(HIGH_LIMIT, round(own.high_limit_mm * own.steps_per_mm))
        if self._link.read_value(OVERTRAVEL) < 0:  # switched off
            self._link.set_value(OVERTRAVEL, DECELERATION_STOP)

    def stop_and_wait(self) -> None:
        """A stop for somebody who only came to stop; it stands until a run lifts it."""
        self._command_stop()
        self._await_rest()

    def _identify(self) -> None:
        """An AZ tells no name; what has none of its registers is none."""
        try:
            words = self._link.read(TEMPERATURES, 4)
        except RefusedError as refused:
            raise self._stranger(f"has no register {TEMPERATURES:04X}h") from refused
        for pair in (words[:2], words[2:]):
            celsius = signed(pair[0] << 16 | pair[1]) / 10
            if not OUTSIDE_C[0] < celsius < OUTSIDE_C[1]:
                raise self._stranger(f"tells a temperature of {celsius:g} C")

    def _stranger(self, why: str) -> InstrumentError:
        return self._error(
            "identify",
            f"{self._link.where} {why}",
            "an Oriental Motor AZ drive is expected; correct port and unit_id in the bench file",
        )

    # --- taking charge ------------------------------------------------------------------------

    def _take_charge(self) -> None:
        """Old alarms are reset once; nothing where that has been done."""
        self._refuse_if_made_safe("switch on")
        state = self._look()
        if state.alarm and not self._in_charge:
            self._reset_alarm()
        self._in_charge = True

    def _reset_alarm(self) -> None:
        """Pulse the reset; an alarm that stays is told."""
        for value in (1, 0):
            self._put(ALARM_RESET, halves(value))
        give_up = self._clock.now() + ALARM_TIMEOUT_S
        while alarm := self._read_state().alarm:
            if self._clock.now() > give_up:
                raise self._alarmed(alarm)
            self._clock.sleep(POLL_S)

    def _prepare_motion(self) -> None:
        """Before the first write of a motion: no alarm, no stop of ours that was not lifted because
        an answer was lost, homed, and its place known. What has just been seen is not asked again:
        with an alarm the drive does not start."""
        self._refuse_if_made_safe("move")
        now_s = self._clock.now()
        unseen = now_s - self._state_at_s > OVERDUE * self._keep_alive_s()
        if not self._in_charge or self._told_alarm or unseen:
            self._take_charge()
        if self._stop_stands:
            self._halt(self._rearmed)
        if self._abspen_seen != self._link.failures:
            if not self._internal() & Internal.ABSPEN:
                raise self._error("move", "the axis has not been homed", "home it first")
            self._abspen_seen = self._link.failures
        if now_s - self._place_at_s > JUST_SEEN_S:
            self._where()

    # --- stopping -----------------------------------------------------------------------------

    def _halt(self, answered: int) -> None:
        """Stop, wait for rest, and lift the stop unless the axis is made safe meanwhile; alarms are
        not news meanwhile."""
        with self._sending:
            self._target = None
            self._halts += 1
        self._halting = self._stop_stands = True
        try:
            self._line.wait_until_free()
            self._say_stop(charge=True)
            self._await_rest()
            self._line.wait_until_free()
            with self._sending:
                if self._made_safe == answered:
                    self._link.write(INPUT_COMMAND, halves(Input.NONE))
                    self._stop_stands = False
        finally:
            self._halting = False

    def _say_stop(self, charge: bool) -> None:
        with self._sending:
            self._link.write(INPUT_COMMAND, halves(Input.STOP), charge, urgent=True)

    def _command_stop(self) -> None:
        """STOP stands, read back, within the drive's time-out."""
        give_up = time.monotonic() + self._settings.timeout_s
        self._say_stop(charge=False)
        while not self._link.read(INPUT_COMMAND, 2, waits=False)[1] & Input.STOP:
            if time.monotonic() > give_up:
                raise self._error("make safe", "did not take the stop", _LOOK)

    def _await_rest(self) -> None:
        longest = self._settings.max_speed_mm_s / self._settings.deceleration_mm_s2 + SETTLING_S
        give_up = self._clock.now() + longest
        while self._read_state().outputs & Output.MOVE:
            if self._clock.now() > give_up:
                raise self._error("stop", f"is still moving after {longest:g} s", _LOOK)
            self._clock.sleep(POLL_S)

    # --- one exchange -------------------------------------------------------------------------

    def _put(self, address: int, words: tuple[int, ...], halts: int | None = None) -> None:
        """Write what may set the axis going, unless it has been made safe, or was stopped after so
        many `halts`."""
        self._line.wait_until_free()
        with self._sending:
            self._refuse_if_made_safe("move")
            if halts not in (None, self._halts):
                self._target = None
                raise self._error("move", "the axis was stopped meanwhile", "begin it again")
            self._link.write(address, words)

    def _motion(self, target: int, speed_mm_s: float) -> tuple[int, tuple[int, ...]]:
        """Where and what to write for a motion; in turn without the data's number."""
        own = self._settings
        values = (
            0,  # operation data number
            ABSOLUTE,
            target,
            round(speed_mm_s * own.steps_per_mm),
            round(own.acceleration_mm_s2 * own.steps_per_mm),
            round(own.deceleration_mm_s2 * own.steps_per_mm),
            round(10 * own.torque_limit_percent),
            TRIGGER_ALL,
        )
        words = tuple(word for value in values for word in halves(value))
        return (OPERATION_TYPE, words[2:]) if self._next_turn() else (DIRECT_DATA, words)

    def _next_turn(self) -> int:
        self._turn ^= 1
        return self._turn

    def _read_state(self) -> State:
        count = STATE_REGISTERS[self._next_turn()]
        words = self._link.read(INPUT_COMMAND, count)
        if count == 4 and words[3] & Output.ALARM:
            words = self._link.read(INPUT_COMMAND, 6)
        alarm = words[5] if len(words) == 6 else 0
        self._state_at_s = self._clock.now()
        return State(words[1], words[3], alarm)

    def _look(self) -> State:
        """The drive's state; an alarm raises."""
        state = self._read_state()
        self._require_sound(state)
        return state

    def _internal(self) -> int:
        return self._link.read(INTERNAL_OUTPUTS, 2)[0]

    def _where(self) -> Place:
        """Where the axis is; one that is held back, or runs past its target, raises."""
        words = self._link.read(COMMAND_POSITION, POSITION_REGISTERS[self._next_turn()])
        place = Place(signed(words[0] << 16 | words[1]), signed(words[6] << 16 | words[7]))
        self._place, self._place_at_s = place, self._clock.now()
        target = self._target  # another thread may stop the axis
        if self._in_charge and target is not None:
            self._require_way(place, target)
        return place

    def _await(
        self,
        command: str,
        condition: Callable[[], bool],
        timeout_s: float,
        otherwise: str,
        poll_s: float = POLL_S,
    ) -> None:
        """Poll until the condition is met."""
        give_up = self._clock.now() + timeout_s
        while not condition():
            self._refuse_if_made_safe(command)
            if self._clock.now() > give_up:
                raise self._error(command, f"{otherwise} within {timeout_s:g} s", _LOOK)
            self._clock.sleep(poll_s)

    # --- judging ------------------------------------------------------------------------------

    def _require_sound(self, state: State) -> None:
        """Once we are in charge: no alarm."""
        if self._in_charge and state.alarm:
            self._told_alarm = state.alarm
            raise self._alarmed(state.alarm)

    def _require_own(self, state: State) -> None:
        """The motion under way is still in force: nobody else has stopped it."""
        if state.inputs & Input.STOP and self._made_safe == self._rearmed:
            self._target = None
            raise self._error("move", "the motion was ended by somebody else", _LOOK)

    def _require_way(self, place: Place, target: int) -> None:
        lag_mm = self._mm(place.command - place.feedback)
        if abs(lag_mm) > self._settings.following_limit_mm:
            self._end_motion(
                f"is held back by {abs(lag_mm):.3g} mm at {self._mm(place.feedback):g} mm on the "
                f"way to {self._mm(target):g} mm, at {self._settings.torque_limit_percent:g} % of "
                "its current",
                "something is in the way; if it belongs there, raise torque_limit_percent",
            )
        if self._mm(place.feedback - target) * self._way > self._past_mm:
            self._end_motion(
                f"ran past its target: it is at {self._mm(place.feedback):g} mm on the way to "
                f"{self._mm(target):g} mm",
                "look at the sensor and at the drive's settings before it moves again",
            )

    def _end_motion(self, cause: str, hint: str) -> None:
        """Stop, then say why."""
        self._target = None
        with contextlib.suppress(InstrumentError):  # why it is stopped is the news
            self._say_stop(charge=True)
        raise self._error("move", cause, hint)

    def _why_refused(self, refused: RefusedError) -> InstrumentError:
        """What the drive shows after it would not start."""
        state = self._look()
        if state.inputs & Input.STOP:
            return self._error("move", "the axis was stopped by somebody else", "stop it first")
        return refused

    def _mind_the_line(self) -> None:
        unheard = self._line.unheard()
        if unheard is not None:
            device, silent_s = unheard
            raise InstrumentError(
                device,
                "keep alive",
                f"has not answered for {silent_s:.1f} s while another drive on {self._line.path} "
                "is talked to, which feeds its communication time-out: it may go on moving",
                "switch it off by hand if it moves; check its cable and its power",
            )

    def _just_seen_on_its_way(self) -> bool:
        now_s, target = self._clock.now(), self._target
        return (
            target is not None
            and now_s - self._place_at_s <= JUST_SEEN_S
            and now_s - self._state_at_s <= OVERDUE * self._keep_alive_s()
            and now_s <= self._arrive_by_s
            and not self._is_there(self._place.feedback, target)
        )

    def _is_there(self, feedback: int, target: int) -> bool:
        return abs(self._mm(feedback - target)) <= self._settings.position_tolerance_mm

    def _refuse_if_made_safe(self, command: str) -> None:
        if self._made_safe != self._rearmed:
            raise self._error(
                command, "the axis was made safe meanwhile", "stop it before the next motion"
            )

    def _alarmed(self, code: int) -> InstrumentError:
        self._target, self._abspen_seen = None, -1
        known = ALARMS.get(code)
        meaning = known.meaning if known else "see the drive's manual"
        remedy = known.remedy if known else "look the number up in the vendor's software"
        return self._error("drive alarm", f"{code:02X}h ({meaning})", remedy)

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
        """A look and a new target, beside the keep-alives of two drives."""
        line, unit = self._line, self._settings.unit_id
        look = reading(unit, COMMAND_POSITION, max(POSITION_REGISTERS))
        target = writing(unit, DIRECT_DATA, (0,) * 16)
        state = reading(unit, INPUT_COMMAND, max(STATE_REGISTERS))
        kept_alive = 2 * line.exchange_s(state) / self._keep_alive_s()
        return max(UPDATE_S, (line.exchange_s(look) + line.exchange_s(target)) / (1 - kept_alive))


_HOMED = Internal.HOME_END | Internal.ABSPEN
_LOOK = "look at the drive's display and at the axis"


def connect(settings: Settings, clock: Clock) -> Axis:
    """Connect to the drive, leaving its axis at rest and its own limits set."""
    line = RtuLine.shared(settings.port, settings.baudrate, settings.parity, clock, settings.role)
    axis = Axis(settings, clock, line)
    try:
        axis.prepare()
    except BaseException:
        axis.close()
        raise
    return axis


def make_safe(settings: Settings) -> None:
    """Stop the axis over a connection of its own and wait for rest; idempotent."""
    clock = WallClock()
    line = RtuLine(settings.port, settings.baudrate, settings.parity, clock)
    with contextlib.closing(Axis(settings, clock, line)) as axis:
        axis.stop_and_wait()
