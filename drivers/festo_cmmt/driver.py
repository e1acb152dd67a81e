"""Festo CMMT-AS / CMMT-ST servo drive with one linear axis as a LinearStage, over Modbus TCP.

One drive, one connection, one communication time-out per axis: feeding one axis does not feed the
other. The drive positions by PROFIdrive telegram 111 with values given directly (MDI).

What keeps a lost, doubled or late line from becoming a motion:

* only absolute positions are sent; writing the same image twice asks for nothing new;
* a task begins with a rising bit, and every image carries the whole wish, so an image that arrives
  twice or after a lost one means what it says;
* at rest the reject bit stands: the image that a repetition would repeat is a stop;
* after `make_safe` no image that could move the axis is sent until `stop` was called: a procedure
  that is a few lines behind its watcher cannot set the axis going again;
* a target that another thread was about to send when `stop` was called is not sent afterwards;
* keep-alives only read. A stop that another client commanded is not overwritten by them.

Source of registers, words and sequences: the vendor's client festo-edcon 0.14.12. Not confirmed on
a CMMT, and to be tried at the first bench; the code depends on each only where this list says:

* any request feeds the communication time-out, reads too (`keep_alive`). So Festo's manuals say of
  the EMCA and CMMO drives; the vendor's client writes and reads every 10 ms;
* its expiry is fault 391 with a controlled stop (`FAULTS`), and a new connection may have to set it
  again (`CmmtLink.watch`);
* PNU 12698 and 12699 give the units of telegram 111 (`trust_units` where they do not);
* PNU 11584 and 11585 are in position units and PNU 12168 is percent of the rated torque: each is
  read back, but its unit is taken on trust (`set_limits`);
* PNU 11070 is the present torque and PNU 11704 the rated one, in one unit, and the mailbox's first
  five registers can be read in one request (`torque_percent`): the numbers are the vendor's, what
  the values are is taken from their names. A drive that refuses either has no torque to watch;
* the task's acknowledgement, ZSW1.12, stands as long as the task is in force
  (`CmmtWatch.require_task`);
* "homing" falls by itself when the reference is found (`home`);
* 20 ms of a standing reject bit are enough for the drive to see it (`REJECT_HOLD_S`).

From memory alone: safe torque off is wired and cannot be asked for over Modbus. Nothing here relies
on it; `make_safe` is a controlled stop under power.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import replace

from drivers.festo_cmmt.frames import (
    Inputs,
    Outputs,
    PosStw1,
    PosZsw1,
    Stw1,
    Zsw1,
)
from drivers.festo_cmmt.images import (
    HOME,
    POWER_OFF,
    STOP,
    TASK,
    at_rest,
    gives_way,
    task_is_taken,
)
from drivers.festo_cmmt.link import OUTPUT_IMAGE, CmmtLink, CmmtRefusalError
from drivers.festo_cmmt.preparation import (
    TORQUE,
    ask_serial_number,
    check_telegram,
    check_units,
    read_identity,
    read_rated_torque,
    real,
    set_limits,
)
from drivers.festo_cmmt.reader import CmmtReader
from drivers.festo_cmmt.settings import COMMUNICATION_FAULT, FestoCmmtSettings
from drivers.festo_cmmt.watch import LOOK, SETTLING_S, CmmtWatch
from drivers.shared.stage import (
    MotionRefusedError,
    StageInterlock,
    Ticket,
    opened,
    prepared,
    stop_and_close,
)
from rig.core.clock import Clock, WallClock
from rig.instruments.roles import Identity, LastSeen, Limits

ROLES = ("stage_z", "stage_x")
"""The roles this driver can play; which one, its settings say."""

Settings = FestoCmmtSettings
"""The settings of a bench file, under the name by which the bench asks any driver for them."""

POLL_S = 0.002
ARRIVAL_POLL_S = 0.02
KEEP_ALIVES_PER_TIMEOUT = 20
"""Number of keep-alives within one communication time-out."""
ACKNOWLEDGE_TIMEOUT_S = 0.5
"""Longest time in s that the drive may take to acknowledge a task."""
FAULT_TIMEOUT_S = 5.0
ENABLE_TIMEOUT_S = 10.0
UPDATES_Hz = 1000.0
"""Targets a second: a poll and a new target take less than a millisecond on this link."""
REJECT_HOLD_S = 0.02
"""Time in s for which a stop is held before it may be lifted: many of the drive's cycles."""


class FestoAxis:
    """One drive and its axis. `connect` has identified it and set its limits.

    One thread at a time commands motions; any thread may call `stop` or `make_safe` at any time.
    """

    def __init__(self, settings: FestoCmmtSettings, clock: Clock):
        self._settings = settings
        self._clock = clock
        self._device = settings.role
        self._link = CmmtLink(
            self._device,
            settings.host,
            settings.port,
            settings.unit_id,
            settings.timeout_s,
            clock,
        )
        self._identity: Identity | None = None
        self._interlock = StageInterlock(self._device)
        self._watch = CmmtWatch(self._link, self._interlock, self._send_stop, settings, clock)
        self._rated_torque: float | None = None
        """Rated torque in the drive's unit; None where it does not report its torque."""

    # --- the role -----------------------------------------------------------------------------

    @property
    def identity(self) -> Identity:
        """Identity of the drive that answered when it was connected."""
        assert self._identity is not None, "connect() identifies before anything else"
        return self._identity

    def limits(self) -> Mapping[str, Limits]:
        """Return the position and speed that the bench file allows; how often there may be a new
        target."""
        own, limited_by = self._settings, f"{self._device} {self.identity.model}"
        return {
            "position": Limits(own.low_limit_mm, own.high_limit_mm, "mm", limited_by),
            "speed": Limits(own.speed_unit_mm_s, own.max_speed_mm_s, "mm/s", limited_by),
            "update_rate": Limits(0.0, UPDATES_Hz, "Hz", limited_by),
        }

    @property
    def misreadings(self) -> int:
        """See `CountsMisreadings`."""
        return self._watch.travel.misreadings

    def last_seen(self) -> LastSeen | None:
        """See `RemembersPosition`."""
        return self._watch.last_seen()

    def homed(self) -> bool:
        """Return whether the drive knows where it is (ZSW1.11)."""
        return Zsw1.HOMED in self._watch.sound().zsw1

    def home(self) -> None:
        """Find the reference by the method in the drive's parameters, and wait for it."""
        ticket = self._interlock.ticket()
        self._take_charge(ticket)
        self._watch.travel.forget()
        self._halt()  # homing begins with a rising bit: it must have been low
        ticket = ticket.after_own_stop()
        was_homed = Zsw1.HOMED in self._watch.seen.zsw1
        self._send(replace(at_rest(self._settings), stw1=HOME), ticket, "home")
        self._await(
            "home",
            ticket,
            lambda seen: (
                PosZsw1.HOMING in seen.pos_zsw1
                or (not was_homed and Zsw1.HOMED in seen.zsw1)  # it stood there: over at once
            ),
            ACKNOWLEDGE_TIMEOUT_S,
            "did not begin to home",
        )
        self._await(
            "home",
            ticket,
            lambda seen: Zsw1.HOMED in seen.zsw1 and PosZsw1.HOMING not in seen.pos_zsw1,
            self._settings.homing_timeout_s,
            "did not find its reference",
            ARRIVAL_POLL_S,
        )
        self._end_motion(ticket, "home")
        self._watch.travel.forget()

    def position_mm(self) -> float:
        """Return the measured position."""
        return self._watch.sound().position * self._settings.position_unit_mm

    def start_move(self, position_mm: float, speed_mm_s: float) -> None:
        """Begin to move there, or change the target of the motion under way.

        A running task is changed by one read and one write. The read ends a motion that met a
        fault, the torque limit or another client's stop; what was read less than 10 ms before is
        not read again (`CmmtWatch.require_task`). Raises LimitError outside `limits`, and
        InstrumentError with nothing sent where another thread stops the axis or makes it safe
        meanwhile.
        """
        self._start(position_mm, speed_mm_s)

    def _start(self, position_mm: float, speed_mm_s: float) -> Ticket:
        """Do what `start_move` does, and return the ticket of the motion."""
        own, ticket = self._settings, self._interlock.ticket()
        limits = self.limits()
        limits["position"].require(self._device, "position", position_mm)
        limits["speed"].require(self._device, "speed", speed_mm_s)
        before = self._watch.motion if self._watch.acknowledged else None
        fresh = before is None
        if fresh:
            self._prepare_task(ticket)
        else:
            self._interlock.require_armed("move")
            self._watch.require_task()
        target = round(position_mm / own.position_unit_mm)
        wish = replace(
            at_rest(own),
            stw1=TASK,
            pos_stw1=PosStw1.MDI | PosStw1.ABSOLUTE | PosStw1.CONTINUOUS_UPDATE,
            target=target,
            speed=round(speed_mm_s / own.speed_unit_mm_s),
        )
        # Before it is sent: a task whose answer is lost has to be watched all the same. It is then
        # not known which target an axis under way has; one that runs past the new one is stopped.
        motion = self._watch.begin(target, speed_mm_s, fresh)
        try:
            self._send(wish, ticket, "move")
        except MotionRefusedError:  # what stops the axis ends the motion of before as well
            self._watch.motion = None
            raise
        except CmmtRefusalError:
            self._watch.take_back(motion, before, ticket)
            raise
        if fresh:
            self._await(
                "move", ticket, task_is_taken, ACKNOWLEDGE_TIMEOUT_S, "did not accept the task"
            )
            self._watch.acknowledged = True
        return ticket

    def moving(self) -> bool:
        """Return whether a motion is under way; raises InstrumentError for a fault and for a motion
        that was not ended by us."""
        return self._watch.moves()

    def move_to(self, position_mm: float, speed_mm_s: float) -> None:
        """Move there, wait, verify by measured position, and end the task.

        Raises InstrumentError where another thread stops the axis or makes it safe on its way.
        """
        ticket = self._start(position_mm, speed_mm_s)
        while self.moving():
            self._clock.sleep(ARRIVAL_POLL_S)
        self._end_motion(ticket, "move")

    def stop(self) -> None:
        """Stop in a controlled way and wait for rest; an axis that was made safe may move again.

        A fault does not keep the stop from being verified; it is raised by the next call.
        """
        self._halt(rearm=True)

    def fault(self) -> str | None:
        """See `ReportsFault`."""
        seen = self._watch.read()
        return self._watch.fault_in_words(seen)[0] if Zsw1.FAULT in seen.zsw1 else None

    def acknowledge_timeout(self) -> bool:
        """See `LinearStage`. The next motion opens a new connection, which sets the time-out again,
        takes charge of the drive again and acknowledges the fault on the way."""
        seen = self._watch.read()
        if Zsw1.FAULT not in seen.zsw1 or seen.fault != COMMUNICATION_FAULT:
            return False
        self._link.close()
        self._watch.in_charge, self._watch.reported_fault = False, 0
        return True

    def torque_percent(self) -> float | None:
        """See `ReadsTorque`: percent of the rated torque, by three requests to the mailbox.

        Raises InstrumentError if the drive's value is not finite.
        """
        if self._rated_torque is None:
            return None
        torque = real(self._link.watched_parameter(TORQUE))
        if not math.isfinite(torque):
            raise self._watch.error(f"read parameter {TORQUE}", f"its torque is {torque}", LOOK)
        return 100 * torque / self._rated_torque

    def keep_alive(self) -> None:
        """Feed the communication time-out by reading the drive's state, unless that has just been
        done. Raises InstrumentError for what ended a motion, and for a fault once, when it
        appears."""
        every_s = self._settings.communication_timeout_ms * 1e-3 / KEEP_ALIVES_PER_TIMEOUT
        if not self._link.charge.under_way and self._watch.age_s >= every_s:
            self._watch.keep_alive()

    def make_safe(self) -> None:
        """Command a controlled stop and verify that the drive has taken it.

        It waits for answers, not for time, so that a watcher may call it while the bench's clock
        stands: the axis is at rest after speed / deceleration at most. No motion is begun
        afterwards until `stop` has been called, which waits for rest. A connection that turns out
        to be broken is opened again, once.
        """
        self._interlock.make_safe(self._command_stop)

    def _command_stop(self) -> None:
        give_up = time.monotonic() + self._settings.timeout_s
        self._send_stop(charge=False)
        while not gives_way(self._watch.read(charge=False)):
            if time.monotonic() > give_up:
                raise self._watch.error("make safe", "did not accept the stop", LOOK)

    def close(self) -> None:
        """Close the connection; the drive meets its communication time-out and holds."""
        self._link.close()

    # --- connecting ---------------------------------------------------------------------------

    def prepare(self) -> None:
        """Identify; set time-out, limits and torque and read them back; stop what moves."""
        identity = read_identity(self._link)
        self._identity = replace(identity, serial_number=ask_serial_number(self._link))
        self._link.watch(self._settings.communication_timeout_ms)
        check_telegram(self._link)
        check_units(self._link, self._settings)
        if Zsw1.OPERATION_ENABLED in self._watch.read().zsw1:
            self._halt()
        set_limits(self._link, self._settings)
        self._rated_torque = read_rated_torque(self._link)

    def stop_and_wait(self) -> None:
        """Stop and wait for rest; a drive without power is only watched."""
        if Zsw1.OPERATION_ENABLED in self._watch.read().zsw1:
            self._halt()
        else:
            self._await_rest()

    # --- taking charge ------------------------------------------------------------------------

    def _take_charge(self, ticket: Ticket) -> None:
        """Take control, acknowledge old faults once and switch the power on, unless it is on."""
        self._interlock.require_armed("switch on")
        seen = self._watch.sound()
        if Zsw1.OPERATION_ENABLED in seen.zsw1:
            self._watch.in_charge = True
            return
        off = replace(at_rest(self._settings), stw1=POWER_OFF)
        self._send(off, ticket, "switch on")
        if Zsw1.FAULT in seen.zsw1:
            self._acknowledge(off, ticket)
        self._watch.in_charge = True
        self._await(
            "switch on",
            ticket,
            lambda seen: Zsw1.CONTROL_REQUESTED in seen.zsw1,
            ACKNOWLEDGE_TIMEOUT_S,
            "does not accept control",
        )
        self._send(at_rest(self._settings), ticket, "switch on")
        self._await(
            "switch on",
            ticket,
            lambda seen: Zsw1.OPERATION_ENABLED in seen.zsw1,
            ENABLE_TIMEOUT_S,
            "did not switch on",
        )

    def _acknowledge(self, off: Outputs, ticket: Ticket) -> None:
        """Pulse the acknowledge bit; raise InstrumentError if the fault remains."""
        pulse = replace(off, stw1=off.stw1 | Stw1.ACKNOWLEDGE_FAULT)
        self._send(pulse, ticket, "switch on")
        give_up = self._clock.now() + FAULT_TIMEOUT_S
        while Zsw1.FAULT in (seen := self._watch.read()).zsw1:
            if self._clock.now() > give_up:
                raise self._watch.end_by_fault(seen)
            self._clock.sleep(POLL_S)
        self._send(off, ticket, "switch on")

    def _prepare_task(self, ticket: Ticket) -> None:
        """Check before the first write of a task that the power is on, the axis is homed, and no
        old task is still acknowledged."""
        self._take_charge(ticket)
        if Zsw1.HOMED not in self._watch.sound().zsw1:
            raise self._watch.error("move", "the axis has not been homed", "home it first")
        if Zsw1.TASK_ACKNOWLEDGED in self._watch.seen.zsw1:  # the task bit has to be low to rise
            self._send(at_rest(self._settings), ticket, "move")
            self._await(
                "move",
                ticket,
                lambda seen: Zsw1.TASK_ACKNOWLEDGED not in seen.zsw1,
                ACKNOWLEDGE_TIMEOUT_S,
                "still shows an earlier task",
            )

    # --- stopping -----------------------------------------------------------------------------

    def _halt(self, rearm: bool = False) -> None:
        """Stop and wait for rest; faults are not reported meanwhile."""
        with self._interlock.stopping(rearm):
            self._watch.motion = None
            self._send_stop()
            self._clock.sleep(REJECT_HOLD_S)
            self._await_rest()

    def _end_motion(self, ticket: Ticket, command: str) -> None:
        """End the task of a motion that has arrived. This stop re-arms nothing, and a stop or
        make_safe by another thread since the motion began raises."""
        self._interlock.permit(ticket, command)
        self._halt()
        self._interlock.permit(ticket.after_own_stop(), command)

    def _await_rest(self) -> None:
        longest = self._settings.max_speed_mm_s / self._settings.deceleration_mm_s2 + SETTLING_S
        give_up = self._clock.now() + longest
        while Zsw1.STOPPED not in self._watch.read().zsw1:
            if self._clock.now() > give_up:
                raise self._watch.error("stop", f"is still moving after {longest:g} s", LOOK)
            self._clock.sleep(POLL_S)

    def _stopping(self) -> Outputs:
        """Return the image that stops the axis. It neither takes power from an axis that has it,
        which may hang by it, nor gives power to one that has none."""
        powered = Zsw1.OPERATION_ENABLED in self._watch.seen.zsw1
        return replace(at_rest(self._settings), stw1=STOP if powered else POWER_OFF)

    # --- one exchange -------------------------------------------------------------------------

    def _send(self, wish: Outputs, ticket: Ticket, command: str) -> None:
        """Send an image that may set the axis going, as the interlock permits."""
        self._link.write(
            OUTPUT_IMAGE,
            wish.registers(),
            permit=lambda: self._interlock.permit(ticket, command),
        )

    def _send_stop(self, charge: bool = True) -> None:
        self._link.write(OUTPUT_IMAGE, self._stopping().registers(), charge)

    def _await(
        self,
        command: str,
        ticket: Ticket,
        condition: Callable[[Inputs], bool],
        timeout_s: float,
        otherwise: str,
        poll_s: float = POLL_S,
    ) -> None:
        """Poll until the drive's state meets the condition; a stop by another thread raises."""
        give_up = self._clock.now() + timeout_s
        while not condition(self._watch.sound()):
            self._interlock.permit(ticket, command)
            if self._clock.now() > give_up:
                raise self._watch.error(command, f"{otherwise} within {timeout_s:g} s", LOOK)
            self._clock.sleep(poll_s)


def connect(settings: FestoCmmtSettings, clock: Clock) -> FestoAxis:
    """Connect to the drive, leaving its axis at rest and its own limits set."""
    return prepared(FestoAxis(settings, clock))


def open_reader(settings: FestoCmmtSettings, clock: Clock) -> CmmtReader:
    """See `OffersReader`."""
    return opened(CmmtReader(settings, clock))


def make_safe(settings: FestoCmmtSettings) -> None:
    """Stop the axis over a connection of its own and wait for rest; may be called repeatedly."""
    stop_and_close(FestoAxis(settings, WallClock()))
