"""Simulated Zaber X-RST rotary stage: commands in, replies and motion out, no I/O.

The stage speaks Zaber ASCII, keeps settings and warning flags, and turns its `SimulatedAxis`, whose
millimetres are degrees here. It writes to the World's log who commanded what. It shares no code
with the driver that is tested against it, the protocol's framing included.

Everything is evaluated lazily at exact World times. World angles are the carriage's, which equal
the stage's own after homing, and must be asked from `angle_deg`.

Sources: traffic of the vendor's client zaber-motion 10.2.0. UNCONFIRMED on a stage: that a move
without reference is rejected, and with which word; that a command with a wrong check is not
answered; which flags ``warnings clear`` clears; the microstep (an X-RST120AK's, from memory); that
a stop brakes with the setting ``accel``; that it has no communication time-out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from drivers.simulated.faults.plan import RaisedFlag, RotaryFault, TurnedKnob
from drivers.simulated.faults.wire import WireDialect
from drivers.simulated.ports import DrivePort, Exchange
from drivers.simulated.world.axis import AxisCommand, AxisEvent, Mechanics
from drivers.simulated.world.drive import SimulatedDrive

PRIORITY = (
    *("FF", "FN", "FZ", "FH", "FV", "FO", "FC", "FM", "FD", "FQ", "FI", "FA", "FR", "FS", "FB"),
    *("FP", "FE", "FT", "WL", "WV", "WT", "WS", "WM", "WP", "WR", "WH", "NC", "NI", "ND", "NR"),
    *("NT", "NU", "NJ"),
)
"""Warning flags, the gravest first."""
POWERLESS = frozenset({"FF", "FN", "FZ", "FH", "FV", "FO", "FC", "FM", "FD"})
"""Flags that keep the stage from turning while one of them is set."""
PERSISTENT = frozenset({*POWERLESS, "WV", "WT", "WP", "WR", "WH", "NC"})
"""Flags that ``warnings clear`` does not clear, because their cause remains."""
SPEED_DATA = 1.6384
ACCELERATION_DATA = 1.6384e-4
LARGEST = 2**31 - 1
LONGEST_COMMAND = 200
KNOB_SPEED_deg_s = 5.0


@dataclass(frozen=True)
class SimulatedRotarySettings:
    """The mechanics and settings of one simulated stage, and its faults."""

    name: str = "rotary"
    """Name of the stage in the World, its log and fault plans."""
    number: int = 1
    """Number of the stage on the chain."""
    device_id: str = "50919"
    serial: str = "SIM00001"
    """A real one is a number; the vendor's client identifies no stage with letters in it."""
    firmware: str = "7.38"
    microstep_deg: float = 0.00015625
    resolution: int = 64
    turn_microsteps: int | None = 2_304_000
    """``limit.cycle.dist``; None where the firmware does not know it."""
    encoder: bool = True
    """Without one, a stage that is held back does not know it."""
    referenced: bool = False
    """True if the stage has been homed before the World begins."""
    start_deg: float = 40.0
    """Angle of the stage when the World begins."""
    homing_speed_deg_s: float = 20.0
    max_speed_deg_s: float = 24.0
    """Factory setting of ``maxspeed``."""
    acceleration_deg_s2: float = 200.0
    """Factory setting of ``accel``."""
    stall_window_deg: float = 0.5
    """Largest lag of the stage, beyond which it stops itself."""
    faults: tuple[RotaryFault, ...] = ()


class _RejectedError(Exception):
    """A command that is not obeyed; its only argument is the reason."""


class SimulatedRotaryStage(SimulatedDrive[RotaryFault]):
    """One stage; `line` gives what a connection to it talks to."""

    def __init__(self, settings: SimulatedRotarySettings, port: DrivePort):
        window = settings.stall_window_deg if settings.encoder else math.inf
        mechanics = Mechanics(
            start_mm=settings.start_deg,
            low_switch_mm=-math.inf,
            high_switch_mm=math.inf,
            following_window_mm=window,
        )
        super().__init__(settings.name, mechanics, lambda angle, t_us: 0.0, settings.faults, port)
        self.settings = settings
        self.flags: set[str] = set() if settings.referenced else {"WR", "WH"}
        self.homing = False
        self._moving = False
        """True if a motion has begun whose end has not been seen."""
        self.values: dict[str, int] = self._factory_values()
        """Settings that can be changed."""
        self._zero_deg = 0.0 if settings.referenced else settings.start_deg

    # --- the World's side ---------------------------------------------------------------------

    def angle_deg(self, t_us: int) -> float:
        """Return the angle of the stage at a World time."""
        return self.position_mm(t_us)

    def angles_deg(self, times_us: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        """Return the angles of the stage at ascending World times; shape of `times_us`."""
        return self.positions_mm(times_us)

    def speed_deg_s(self, t_us: int) -> float:
        """Return the speed of the stage at a World time."""
        return self.velocity_mm_s(t_us)

    # --- the chain's side ---------------------------------------------------------------------

    def line(self) -> ChainLine:
        """Return a connection's line to this stage."""
        return ChainLine(self)

    def answer(self, message: bytes, by: str) -> Exchange | None:
        """Obey one command, given without its line end, and return it with the reply to send;
        return None where it is for another stage or its checksum is wrong."""
        body, colon, given = message.rpartition(b":")
        if colon and given != b"%02X" % _check(body):
            return None
        words = (body if colon else message).decode("ascii", "replace").split()
        address = [0, 0]
        for place in range(2):
            if words and words[0].isdigit():
                address[place] = int(words.pop(0))
        number = words.pop(0) if words and (words[0].isdigit() or words[0] == "--") else None
        if address[0] not in (0, self.settings.number):
            return None
        self.settle(self._port.now_us)
        try:
            if address[1] > 1:
                raise _RejectedError("BADAXIS")
            said, data = "OK", self._obey(words, by)
        except _RejectedError as error:
            said, data = "RJ", str(error)
        self.settle(self._port.now_us)
        status = "BUSY" if self._moving else "IDLE"
        flag = next((flag for flag in PRIORITY if flag in self.flags), "--")
        head = f"{self.settings.number:02d} {address[1]}" + (f" {number}" if number else "")
        reply = f"{head} {said} {status} {flag} {data}".encode("ascii", "replace")
        check = b":%02X" % _check(reply) if colon else b""
        return Exchange(" ".join(words).encode(), b"@" + reply + check + b"\r\n")

    # --- commands -----------------------------------------------------------------------------

    def _obey(self, words: list[str], by: str) -> str:
        """Return the data of the reply, or why it is rejected."""
        now = self._port.now_us
        match words:
            case []:
                return "0"
            case ["get", name]:
                return self._get(name)
            case ["set", name, value]:
                self._set(name, _whole(value), by)
            case ["warnings"]:
                return self._warnings()
            case ["warnings", "clear"]:
                flags = self._warnings()
                self.flags &= PERSISTENT
                return flags
            case ["home"]:
                self._home(by)
            case ["stop" | "estop" as how]:
                self._log(how, None, by)
                mechanics, own = self.axis.mechanics, self._acceleration(self.values["accel"])
                self._end_motion()
                self.axis.stop(now, mechanics.quick_deceleration_mm_s2 if how == "estop" else own)
            case ["move", "abs" | "rel" | "min" | "max", *_]:
                self._move(words[1:], by)
            case ["driver", "enable"]:
                self.flags -= POWERLESS
            case _:
                raise _RejectedError("BADCOMMAND")
        return "0"

    def _get(self, name: str) -> str:
        own, now = self.settings, self._port.now_us
        setpoint = self.axis.position(now) + self.axis.following_error(now)
        known: dict[str, Callable[[], object]] = {
            "deviceid": lambda: own.device_id,
            "version": lambda: own.firmware,
            "version.build": lambda: 16012,
            "system.serial": lambda: own.serial,
            "system.axiscount": lambda: 1,
            "peripheralid": lambda: 0,
            "resolution": lambda: own.resolution,
            "pos": lambda: self._microsteps(setpoint),
        }
        if own.encoder:
            known["encoder.pos"] = lambda: self._microsteps(self.axis.position(now))
        if own.turn_microsteps is not None:
            known["limit.cycle.dist"] = lambda: own.turn_microsteps
        known |= {name: partial(self.values.__getitem__, name) for name in self.values}
        if name not in known:
            raise _RejectedError("BADCOMMAND")
        return str(known[name]())

    def _set(self, name: str, value: int, by: str) -> None:
        if name not in self.values:
            raise _RejectedError("BADCOMMAND")
        if abs(value) > LARGEST or (value < 1 and not name.startswith("limit.")):
            raise _RejectedError("BADDATA")
        self.values[name] = value
        self._log("setting", {"name": name, "value": value}, by)

    def _warnings(self) -> str:
        flags = [flag for flag in PRIORITY if flag in self.flags]
        return " ".join((f"{len(flags):02d}", *flags))

    def _home(self, by: str) -> None:
        self._require_power()
        self._interrupt()
        self._end_motion()
        self.homing = True
        self.flags |= {"WR", "WH"}
        self._log("homing", 0.0, by)
        acceleration = self._acceleration(self.values["accel"])
        self._start(AxisCommand(0.0, self.settings.homing_speed_deg_s, acceleration, acceleration))

    def _move(self, words: list[str], by: str) -> None:
        """``abs N``, ``rel N``, ``min`` or ``max``, each with speed and acceleration or without."""
        self._require_power()
        how, numbers = words[0], [_whole(word) for word in words[1:]]
        low, high = self.values["limit.min"], self.values["limit.max"]
        if how in ("abs", "rel"):
            if not numbers:
                raise _RejectedError("BADDATA")
            target = numbers.pop(0)
            if how == "rel":
                target += self._microsteps(self.axis.position(self._port.now_us))
        else:
            target = low if how == "min" else high
        speed, acceleration = [*numbers, 0, 0][:2]
        bad = len(numbers) > 2 or speed < 0 or acceleration < 0
        if bad or not low <= target <= high or "WR" in self.flags:
            raise _RejectedError("BADDATA")  # UNCONFIRMED for a stage without reference
        target_deg = self._zero_deg + target * self.settings.microstep_deg
        speed_deg_s = self._speed(speed or self.values["maxspeed"])
        rate = self._acceleration(acceleration or self.values["accel"])
        fresh = not self._moving
        self._interrupt()
        if fresh:
            self._port.tasks.begin(self.settings.name, self._port.now_us)
            turn = {"target_deg": round(target_deg, 6), "speed_deg_s": round(speed_deg_s, 6)}
            self._log("turn", turn, by)
        self._start(self._motion_faults.command(target_deg, speed_deg_s, rate, rate))

    def _require_power(self) -> None:
        if self.flags & POWERLESS:
            raise _RejectedError("DRIVERDISABLED")

    def _interrupt(self) -> None:
        """Set the flags for a new command that interrupts a motion, and end homing."""
        by_hand = "NC" in self.flags
        self.flags -= {"NC", "NI", "WM"}
        if self._moving and not by_hand:
            self.flags.add("NI")
        self.homing = False

    def _end_motion(self) -> None:
        """End homing, and the motion of a runaway."""
        self.homing, self._motion_faults.runs_to_mm = False, None

    def _start(self, command: AxisCommand) -> None:
        self._moving = True
        self.axis.move(self._port.now_us, command)

    # --- what happens by itself ---------------------------------------------------------------

    def _catch_up(self, t_us: int) -> None:
        for happening in self.axis.happenings(t_us):
            stalled = happening.event is AxisEvent.FOLLOWING_ERROR
            self._raise("FS" if stalled else "WL", happening.t_us)
        if not self._moving or not self.axis.finished(t_us):
            return
        self._moving = False
        angle = self.axis.position(t_us)
        self._log("at-rest", round(angle, 6), "stage")
        if self.homing:
            self.homing = False
            self.flags -= {"WR", "WH"}
            self._zero_deg = angle
            self._log("homed", True, "stage")

    def _raise(self, flag: str, t_us: int) -> None:
        """Set a flag; a fault and a limit sensor end the motion."""
        self.flags.add(flag)
        self._log("flag", flag, "stage")
        if flag.startswith("F") or flag == "WL":
            self._end_motion()
            self.axis.stop(t_us, self.axis.mechanics.quick_deceleration_mm_s2)

    def _apply_own_fault(self, fault: RotaryFault, t_us: int, velocity_mm_s: float) -> None:
        if isinstance(fault, RaisedFlag):
            self._raise(fault.flag, t_us)
        elif isinstance(fault, TurnedKnob):
            self._turn_by_hand(fault.by_deg, t_us)
        else:
            self._raise("WL" if fault.kind == "limit-switch" else "WR", t_us)

    def _turn_by_hand(self, by_deg: float, t_us: int) -> None:
        """Let the knob take the stage over, also during a turn."""
        if self._moving:
            self.flags.add("NI")
        self.flags.add("NC")
        self._end_motion()
        self._moving = True
        rate = self._acceleration(self.values["accel"])
        target = self.axis.position(t_us) + by_deg
        self.axis.move(t_us, AxisCommand(target, KNOB_SPEED_deg_s, rate, rate))

    # --- units --------------------------------------------------------------------------------

    def _factory_values(self) -> dict[str, int]:
        own = self.settings
        return {
            "limit.min": 0,
            "limit.max": round(360.0 / own.microstep_deg),
            "maxspeed": round(own.max_speed_deg_s / own.microstep_deg * SPEED_DATA),
            "accel": round(own.acceleration_deg_s2 / own.microstep_deg * ACCELERATION_DATA),
            "comm.checksum": 1,
        }

    def _microsteps(self, world_deg: float) -> int:
        return round((world_deg - self._zero_deg) / self.settings.microstep_deg)

    def _speed(self, data: int) -> float:
        return data / SPEED_DATA * self.settings.microstep_deg

    def _acceleration(self, data: int) -> float:
        return data / ACCELERATION_DATA * self.settings.microstep_deg


class ChainLine:
    """The line of a stage's connection, which cuts bytes into commands; a `SerialInstrument`."""

    def __init__(self, stage: SimulatedRotaryStage):
        self._stage = stage
        self._came = b""

    def exchanges(self, data: bytes, by: str) -> Iterable[Exchange]:
        """Return the commands that these bytes complete, with their replies."""
        *lines, self._came = (self._came + data).replace(b"\r", b"\n").split(b"\n")
        self._came = self._came[-LONGEST_COMMAND:]
        for line in lines:
            _, slash, message = line.partition(b"/")
            if slash and (exchange := self._stage.answer(message, by)) is not None:
                yield exchange

    def frames_until(self, now_us: int) -> bytes:
        """Return nothing: the stage sends only answers."""
        return b""


def _whole(word: str) -> int:
    try:
        return int(word)
    except ValueError as error:
        raise _RejectedError("BADDATA") from error


def _check(body: bytes) -> int:
    """Return two's complement of the sum of bytes."""
    return (256 - sum(body) % 256) % 256


def _wrong_check(reply: bytes) -> bytes | None:
    body, colon, given = reply.rstrip().rpartition(b":")
    return body + b":%02X\r\n" % (int(given, 16) ^ 0xFF) if colon else None


def _rejection(reply: bytes, reason: str) -> bytes | None:
    """Return an accepted command's reply as a rejection; None where it was rejected already."""
    body, colon, _ = reply[1:].rstrip().rpartition(b":")
    if not colon or b" OK " not in body:
        return None
    head, status = body.split(b" OK ", 1)
    state = b" ".join(status.split(b" ")[:2])
    spoilt = head + b" RJ " + state + b" " + reason.encode()
    return b"@" + spoilt + b":%02X\r\n" % _check(spoilt)


ZABER_DIALECT = WireDialect(rejection=_rejection, checksum=_wrong_check)
