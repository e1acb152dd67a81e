"""Simulated Festo CMMT drive with one linear axis: registers in, motion out, no I/O.

The drive positions by telegram 111: it takes an output image, shows an input image, keeps
parameters behind a mailbox, and watches that requests come. It moves its `SimulatedAxis` and writes
to the World's log who commanded what; what pushes against the axis it asks from its `AxisPort`. It
shares no code with the driver that is tested against it, its telegram included.

Everything is evaluated lazily at exact World times: a communication time-out has stopped the
axis when it expired, not when the axis was asked for next. World positions are the
carriage's, which equal the drive's own after homing, and must be asked from `position_mm`.

Sources: register map, words and sequences from the vendor's client festo-edcon 0.14.12. UNCONFIRMED
on a drive, each marked in its place: what the time-out does and which number it gives, what feeds
it, the units' parameters, the meaning of the clamping torque and of the present one, what an
unhomed or out-of-range task is answered with, which jog bit is which way, the identification's
texts.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from drivers.simulated.faults.plan import DriveFault, MoveFault
from drivers.simulated.ports import AxisPort
from drivers.simulated.transports.modbus_tcp import ILLEGAL_ADDRESS, ModbusError
from drivers.simulated.world.axis import AxisCommand, AxisEvent, Mechanics
from drivers.simulated.world.drive import Due, FARTHER_THAN_ANY_SWITCH_mm, SimulatedDrive

IMAGE_WORDS = 28
OUTPUTS, INPUTS, TIMEOUT, MAILBOX, MAILBOX_DATA = 0, 100, 400, 500, 510
MAILBOX_WORDS, DATA_WORDS = 5, 100

TIMEOUT_FAULT = 391  # "process data communication failed"; UNCONFIRMED for Modbus
SOFTWARE_LIMIT_FAULTS = (109, 110)  # negative, positive
LIMIT_PARAMETERS_FAULT = 113
SWITCH_FAULTS = {AxisEvent.LOW_SWITCH: 114, AxisEvent.HIGH_SWITCH: 115}
FOLLOWING_FAULT = 126
HOMING_FAULT = 58
STOP_NOT_FOUND_WARNING = 279

TELEGRAM = 111
ARRIVED_mm = 0.01
"""Window of "target reached"."""
NOMINAL_SPEED_mm_s = 1000.0
"""Speed that NIST_B defines as 100 %."""

# Parameter numbers (PNU), from the vendor's pnu_map.csv.
_TELEGRAM, _SERIAL, _FIRMWARE, _TIMEOUT_ms = 3490, 2021, 2266, 4854
_POSITION_UNIT, _SPEED_UNIT = 12698, 12699  # UNCONFIRMED that they describe telegram 111
_CLAMPING, _LOW_LIMIT, _HIGH_LIMIT = 12168, 11584, 11585
_TORQUE, _RATED_TORQUE = 11070, 11704
RATED_TORQUE_Nm = 0.5
"""UNCONFIRMED that both are in Nm."""
_WRITABLE = frozenset({_TELEGRAM, _CLAMPING, _LOW_LIMIT, _HIGH_LIMIT})


@dataclass(frozen=True)
class SimulatedCmmtSettings:
    """The settings of one simulated drive, and its faults."""

    name: str = "stage_z"
    """Name of the drive in the World, its log and fault plans."""
    model: str = "CMMT-ST-C8-1C-MP-S0"
    serial: str = "SIMZ1"
    """Serial number, at most five characters."""
    position_unit_mm: float = 0.001
    speed_unit_mm_s: float = 0.001
    full_acceleration_mm_s2: float = 1000.0
    force_at_full_torque_N: float = 100.0
    home_mm: float = 0.0
    homing_speed_mm_s: float = 20.0
    jog_speed_mm_s: float = 10.0
    unhomed_offset_mm: float = 37.5
    """Error of the drive's position before it has been homed."""
    enable_delay_us: int = 20_000
    mechanics: Mechanics = field(default_factory=Mechanics)
    faults: tuple[MoveFault, ...] = ()


@dataclass(frozen=True)
class _Image:
    """The output image, taken apart word by word."""

    words: tuple[int, ...] = (0,) * IMAGE_WORDS

    def bit(self, word: int, bit: int) -> bool:
        """Return the bit of STW1 (0), POS_STW1 (1), POS_STW2 (2) or STW2 (3)."""
        return bool(self.words[word] >> bit & 1)

    def bits(self, *bits: int) -> bool:
        """Return whether all these bits of STW1 are set."""
        return all(self.bit(0, bit) for bit in bits)

    @property
    def target(self) -> int:
        low, high = self.words[5:7]
        value = low | high << 16
        return value - (1 << 32) if value >> 31 else value

    @property
    def motion(self) -> tuple[int, ...]:
        """Return the values of a task: override, target, speed, acceleration, deceleration."""
        return self.words[4:11]

    @property
    def speed(self) -> float:
        """Return the requested speed in units, override included."""
        return (self.words[7] | self.words[8] << 16) * min(self.words[4] / 0x4000, 1.0)


class CmmtDrive(SimulatedDrive[MoveFault]):
    """One drive and its axis; a `RegisterDevice` for `ModbusTcpServer`."""

    def __init__(self, settings: SimulatedCmmtSettings, port: AxisPort):
        super().__init__(
            settings.name,
            settings.mechanics,
            lambda mm, t_us: port.load_N(settings.name, mm, t_us),
            settings.faults,
            port,
        )
        self.settings = settings
        self.fault = 0
        self.warning = 0
        self.enabled = False
        self.homed = False
        self.homing = False
        self.identity: dict[int, str] = {
            0: "Festo SE & Co. KG", 1: settings.model, 2: "V000.0.0-simulated",
            3: "www.festo.com", 4: "Servo drive", 5: settings.model,
        }  # fmt: skip
        self._image = _Image()
        self._controlled = False
        self._enable_at_us: int | None = None
        self._zero_mm = -settings.unhomed_offset_mm
        self._target_mm: float | None = None
        self._acknowledged = False
        self._paused = False
        self._fixed_stop = False
        self._jogging = 0
        """Direction of jogging: 1, -1, or 0 for none."""
        self._frozen_inputs: list[int] | None = None
        """The input image that it shows whatever happens."""
        self._timeout_ms = 0
        self._fed_us = port.now_us
        self._mailbox = [0] * MAILBOX_WORDS
        self._data = [0] * DATA_WORDS
        self._parameters = _factory_parameters(settings)

    # --- the World's side ---------------------------------------------------------------------

    def trip(self, code: int) -> None:
        """Report this fault now, for a fault plan."""
        now = self._port.now_us
        self.settle(now)
        self._fail(code, now)

    # --- the registers' side ------------------------------------------------------------------

    def identification(self) -> Mapping[int, str]:
        """Return the vendor, product code, revision, URL, product name, model."""
        self._feed()
        return self.identity

    def read(self, address: int, count: int, by: str) -> Sequence[int]:
        """Return images, time-out or mailbox; one block at a time.

        Raises ModbusError for other addresses.
        """
        self._feed()
        if _within(address, count, INPUTS, IMAGE_WORDS):
            return (self._frozen_inputs or self._inputs())[address - INPUTS :][:count]
        for start, block in (
            (OUTPUTS, self._image.words),
            (TIMEOUT, (self._timeout_ms, 0)),
            (MAILBOX, self._mailbox),
            (MAILBOX_DATA, self._data),
        ):
            if _within(address, count, start, len(block)):
                return block[address - start :][:count]
        raise ModbusError(ILLEGAL_ADDRESS)

    def write(self, address: int, values: Sequence[int], by: str) -> None:
        """Take an output image, the time-out or mailbox words.

        Raises ModbusError for other addresses.
        """
        self._feed()
        count = len(values)
        if _within(address, count, OUTPUTS, IMAGE_WORDS):
            words = list(self._image.words)
            words[address : address + count] = values
            self._take(_Image(tuple(words)), by)
        elif address == TIMEOUT and count <= 2:
            self._timeout_ms = values[0]
            self._parameters[_TIMEOUT_ms] = struct.pack("<f", values[0])
            self._log("timeout_ms", values[0], by)
        elif _within(address, count, MAILBOX, MAILBOX_WORDS):
            self._mailbox[address - MAILBOX : address - MAILBOX + count] = values
            if address <= MAILBOX + 3 < address + count:
                self._mailbox[3] = self._access_parameter(by)
        elif _within(address, count, MAILBOX_DATA, DATA_WORDS):
            self._data[address - MAILBOX_DATA : address - MAILBOX_DATA + count] = values
        else:
            raise ModbusError(ILLEGAL_ADDRESS)

    def _feed(self) -> None:
        """Restart the time-out: any request does (UNCONFIRMED: perhaps only process data do), but a
        late one finds it expired."""
        self.settle(self._port.now_us)
        self._fed_us = self._port.now_us

    # --- what happens by itself ---------------------------------------------------------------

    def _own_due(self, now_us: int) -> Due | None:
        """Return the communication time-out, where it has expired."""
        if not self._controlled or not self._timeout_ms or self.fault:
            return None
        deadline = self._fed_us + 1000 * self._timeout_ms
        return (deadline, self._expire) if deadline < now_us else None

    def _freeze_status(self) -> None:
        self._frozen_inputs = self._inputs()

    def _expire(self, t_us: int) -> None:
        if not self.fault:  # the axis may have met something just before
            self._fail(TIMEOUT_FAULT, t_us)

    def _apply_own_fault(self, fault: MoveFault, t_us: int, velocity_mm_s: float) -> None:
        if isinstance(fault, DriveFault):
            self._fail(fault.code or FOLLOWING_FAULT, t_us)
        elif fault.kind == "limit-switch":
            met = AxisEvent.LOW_SWITCH if velocity_mm_s < 0 else AxisEvent.HIGH_SWITCH
            self._fail(SWITCH_FAULTS[met], t_us)
        else:
            self.homed = False
            self._log("homed", False, "drive")

    def _catch_up(self, t_us: int) -> None:
        if self._enable_at_us is not None and t_us >= self._enable_at_us:
            self._enable_at_us, self.enabled = None, True
            self._log("enabled", True, "drive")
        for happening in self.axis.happenings(t_us):
            self._meet(happening.event, happening.t_us)
        if self._moving and self.axis.finished(t_us):
            self._arrive(t_us)

    def _meet(self, event: AxisEvent, t_us: int) -> None:
        if event is AxisEvent.FIXED_STOP:
            self._fixed_stop = True
            self._log("fixed-stop", round(self.axis.position(t_us), 6), "drive")
        elif self.homing:
            self._fail(HOMING_FAULT, t_us, braking=True)
        else:
            self._fail(SWITCH_FAULTS.get(event, FOLLOWING_FAULT), t_us, braking=True)

    def _arrive(self, t_us: int) -> None:
        self._moving = False
        position = self.axis.position(t_us)
        self._log("at-rest", round(position, 6), "drive")
        if self.homing:
            self.homing, self.homed = False, True
            self._zero_mm = position - self.settings.home_mm
            self._log("homed", True, "drive")
        elif self._seeking() and not (self._fixed_stop or self._paused):
            self.warning = STOP_NOT_FOUND_WARNING  # UNCONFIRMED: may be parametrised as a fault

    def _seeking(self) -> bool:
        return self._target_mm is not None and self.axis.seeks_fixed_stop

    def _fail(self, code: int, t_us: int, braking: bool = False) -> None:
        """Set the fault bit, disable operation and make a controlled stop (reaction
        UNCONFIRMED)."""
        self.fault = code
        self._log("fault", code, "drive")
        if self.homing:
            self.homed = False
        self._disable(t_us, "drive", braking)

    def _disable(self, t_us: int, by: str, braking: bool = False) -> None:
        if not braking:
            self.axis.stop(t_us, self._deceleration())
        if self.enabled:
            self._log("enabled", False, by)
        self.enabled, self._enable_at_us = False, None
        self.homing = self._acknowledged = self._paused = False
        self._target_mm, self._runs_to_mm, self._jogging = None, None, 0

    # --- what an output image asks for --------------------------------------------------------

    def _take(self, image: _Image, by: str) -> None:
        now = self._port.now_us
        before, self._image = self._image, image
        self._controlled = image.bit(0, 10)
        if not self._controlled:
            if self.enabled or self._enable_at_us is not None:
                self._disable(now, by)
            return
        if image.bit(0, 7) and not before.bit(0, 7) and self.fault:
            self._log("acknowledged", self.fault, by)
            self.fault = self.warning = 0
        self._power(before, image, by)
        if self.enabled:
            self._move(before, image, by)
        else:
            self._acknowledged = False

    def _power(self, before: _Image, image: _Image, by: str) -> None:
        wanted = image.bits(0, 1, 2, 3)
        if self.enabled or self._enable_at_us is not None:
            if not wanted:
                self._disable(self._port.now_us, by)
        elif wanted and not before.bit(0, 0) and not self.fault:
            self._enable_at_us = self._port.now_us + self.settings.enable_delay_us

    def _move(self, before: _Image, image: _Image, by: str) -> None:
        """Stop, pause, home, jog, start or change a task, in this order of precedence."""
        now = self._port.now_us
        if not image.bit(0, 4):
            if self._moving:
                self._log("stop", None, by)
            if self._target_mm is not None or self.homing or self._jogging:
                self.axis.stop(now, self._deceleration())
            self._target_mm, self._runs_to_mm, self._jogging = None, None, 0
            self.homing = self._acknowledged = self._paused = False
            return
        self._limit_force(image)
        if self._target_mm is not None and not image.bit(0, 5):
            if not self._paused:
                self.axis.stop(now, self._deceleration())
            self._paused = True
        elif self._paused:
            self._paused = False
            self._go(by)
        if image.bit(0, 11) and not before.bit(0, 11):
            self._home(by)
        elif self.homing and not image.bit(0, 11):
            self.axis.stop(now, self._deceleration())
            self.homing = False
        self._jog(image.bit(0, 8) - image.bit(0, 9), by)
        if not image.bit(0, 6):
            self._acknowledged = False
        elif not before.bit(0, 6):
            self._begin(by)
        elif image.bit(1, 12) and self._acknowledged and image.motion != before.motion:
            self._begin(by, again=True)

    def _limit_force(self, image: _Image) -> None:
        """Set the force limit of a travel to fixed stop, from the clamping torque."""
        seeking = image.bit(3, 8)
        self.axis.seeks_fixed_stop = seeking
        (percent,) = struct.unpack("<f", self._parameters[_CLAMPING])
        clamping = percent / 100 * self.settings.force_at_full_torque_N  # percent UNCONFIRMED
        self.axis.force_limit_N = clamping if seeking else self.settings.mechanics.peak_force_N

    def _home(self, by: str) -> None:
        self._target_mm, self.homed, self.homing, self._jogging = None, False, True, 0
        self._log("homing", self.settings.home_mm, by)
        self._start(AxisCommand(
            self.settings.home_mm,
            self.settings.homing_speed_mm_s,
            self.settings.full_acceleration_mm_s2,
            self.settings.full_acceleration_mm_s2,
        ))  # fmt: skip

    def _jog(self, way: int, by: str) -> None:
        """Move as long as one of the two bits is set, as far as the software limits let it."""
        at_work = self._target_mm is not None and self._moving
        if way == self._jogging or self.homing or at_work:
            return
        self._target_mm, self._paused, self._jogging = None, False, way
        self._log("jog", way, by)
        if way == 0:
            self.axis.stop(self._port.now_us, self._deceleration())
            return
        limited = self._image.bit(2, 14) and self.homed
        end = self._limits()[way > 0] if limited else way * FARTHER_THAN_ANY_SWITCH_mm
        rate = self.settings.full_acceleration_mm_s2
        self._start(AxisCommand(end, self.settings.jog_speed_mm_s, rate, rate))

    def _begin(self, by: str, again: bool = False) -> None:
        """Take the task in the image; what cannot be done is not acknowledged."""
        image, settings = self._image, self.settings
        absolute = image.bit(1, 8)
        if not image.bit(1, 15) or image.bit(1, 14) or self.homing or image.speed <= 0:
            self._log("refused", "not a positioning task", by)  # records, setup: not simulated
            return
        if absolute and not self.homed:
            self._log("refused", "not homed", by)  # UNCONFIRMED
            return
        target = image.target * settings.position_unit_mm
        if absolute:
            target += self._zero_mm
        else:
            target += self.axis.position(self._port.now_us)
        if image.bit(2, 14) and self.homed and (code := self._limit_fault(target)):
            self._fail(code, self._port.now_us)  # UNCONFIRMED: it may move as far as it can
            return
        self._target_mm, self._acknowledged, self._jogging = target, True, 0
        if not again:
            self._port.tasks.begin(self.settings.name, self._port.now_us)
        self._go(by, quiet=again)

    def _limits(self) -> tuple[float, float]:
        """Return the software limits as World positions."""
        low, high = (
            self._zero_mm
            + struct.unpack("<q", self._parameters[number])[0] * self.settings.position_unit_mm
            for number in (_LOW_LIMIT, _HIGH_LIMIT)
        )
        return low, high

    def _limit_fault(self, target_mm: float) -> int:
        low, high = self._limits()
        if low >= high:
            return LIMIT_PARAMETERS_FAULT
        if target_mm < low - 1e-9:
            return SOFTWARE_LIMIT_FAULTS[0]
        return SOFTWARE_LIMIT_FAULTS[1] if target_mm > high + 1e-9 else 0

    def _go(self, by: str, quiet: bool = False) -> None:
        assert self._target_mm is not None
        if not self._image.bit(0, 5):
            self._paused = True
            return
        speed = self._image.speed * self.settings.speed_unit_mm_s
        rates = (self._rate(9), self._deceleration())
        if not quiet:
            self._log("move", {"target_mm": round(self._target_mm, 6), "speed_mm_s": speed}, by)
        target = self._target_mm if self._runs_to_mm is None else self._runs_to_mm
        self._start(AxisCommand(target, speed * self._speed_share, *rates))

    def _start(self, command: AxisCommand) -> None:
        self._fixed_stop, self.warning, self._moving = False, 0, True
        self.axis.move(self._port.now_us, command)

    def _rate(self, word: int) -> float:
        share = min(max(self._image.words[word], 1) / 0x4000, 1.0)
        return share * self.settings.full_acceleration_mm_s2

    def _deceleration(self) -> float:
        """Deceleration of a controlled stop: the task's, or the full one without a task."""
        return self._rate(10) if self._image.words[10] else self.settings.full_acceleration_mm_s2

    # --- what an input image shows ------------------------------------------------------------

    def _inputs(self) -> list[int]:
        now = self._port.now_us
        position, velocity = self.axis.position(now), self.axis.velocity(now)
        shown = position - self._zero_mm + self.shows_off_mm
        counts = round(shown / self.settings.position_unit_mm)
        speed = round(velocity / NOMINAL_SPEED_mm_s * 0x40000000)
        words = [
            self._zsw1(now, position, velocity),
            self._pos_zsw1(position),
            self._pos_zsw2(now, velocity),
            self._fixed_stop << 8 | self.enabled << 11,
            self.enabled << 11 | self.enabled << 13,
            *_halves(counts),
            *_halves(speed),
            self.fault,
            self.warning,
        ]
        return words + [0] * (IMAGE_WORDS - len(words))

    def _zsw1(self, now: int, position: float, velocity: float) -> int:
        image, fault = self._image, bool(self.fault)
        pending = self._enable_at_us is not None
        inhibited = fault or (image.bit(0, 0) and not self.enabled and not pending)
        speeding = self.axis.acceleration(now) * velocity
        error = abs(self.axis.following_error(now))
        arrived = (
            self._target_mm is not None
            and self.axis.finished(now)
            and abs(position - self._target_mm) <= ARRIVED_mm
        )
        return _word(
            not inhibited,
            not inhibited and image.bit(0, 0),
            self.enabled,
            fault,
            image.bit(0, 1),
            image.bit(0, 2),
            inhibited,
            bool(self.warning),
            error <= self.settings.mechanics.following_window_mm,
            True,
            arrived or self._fixed_stop,
            self.homed,
            self._acknowledged,
            velocity == 0 and self.axis.finished(now),
            speeding > 0,
            speeding < 0,
        )

    def _pos_zsw1(self, position: float) -> int:
        mechanics = self.settings.mechanics
        return (
            (position <= mechanics.low_switch_mm) << 8
            | (position >= mechanics.high_switch_mm) << 9
            | (self._jogging != 0) << 10
            | self.homing << 11
            | (self._target_mm is not None) << 15
        )

    def _pos_zsw2(self, now: int, velocity: float) -> int:
        busy = self._target_mm is not None
        return (
            busy << 2
            | (velocity > 0) << 4
            | (velocity < 0) << 5
            | self._fixed_stop << 12
            | self._fixed_stop << 13
            | (busy and self.axis.seeks_fixed_stop) << 14
            | ((busy or self.homing or bool(self._jogging)) and not self.axis.finished(now)) << 15
        )

    # --- parameters ---------------------------------------------------------------------------

    def _access_parameter(self, by: str) -> int:
        """Execute the mailbox: 1 reads, 2 writes; 0x10 for done, 3 for an error."""
        number, subindex, elements, what, length = self._mailbox
        known = self._torque() if number == _TORQUE else self._parameters.get(number)
        if known is None or subindex or not elements:
            return 3
        if what == 1:
            self._mailbox[4] = len(known)
            padded = known + b"\0" * (len(known) % 2)
            self._data[: len(padded) // 2] = struct.unpack(f"<{len(padded) // 2}H", padded)
            return 0x10
        if what != 2 or number not in _WRITABLE or length != len(known) or self.enabled:
            return 3
        raw = struct.pack(f"<{DATA_WORDS}H", *self._data)[:length]
        if number == _CLAMPING and not _positive(raw):
            return 3
        self._parameters[number] = raw
        self._log("parameter", {"number": number, "raw": raw.hex()}, by)
        return 0x10

    def _torque(self) -> bytes:
        """Return the present torque; none without power."""
        force_N = self._shown_force_N(self._port.now_us) if self.enabled else 0.0
        share = force_N / self.settings.force_at_full_torque_N
        return struct.pack("<f", share * RATED_TORQUE_Nm)


def _factory_parameters(settings: SimulatedCmmtSettings) -> dict[int, bytes]:
    unit = settings.position_unit_mm
    low, high = (
        round(mm / unit)
        for mm in (settings.mechanics.low_switch_mm, settings.mechanics.high_switch_mm)
    )
    return {
        _TELEGRAM: struct.pack("<H", TELEGRAM),
        _SERIAL: settings.serial.encode("ascii").ljust(5, b"\0")[:5],
        _FIRMWARE: b"simulated".ljust(30, b"\0"),
        _TIMEOUT_ms: struct.pack("<f", 0.0),
        _POSITION_UNIT: _si_unit(settings.position_unit_mm, 0x00),
        _SPEED_UNIT: _si_unit(settings.speed_unit_mm_s, 0x03),
        _CLAMPING: struct.pack("<f", 100.0),
        _RATED_TORQUE: struct.pack("<f", RATED_TORQUE_Nm),
        _LOW_LIMIT: struct.pack("<q", low),
        _HIGH_LIMIT: struct.pack("<q", high),
    }


def _si_unit(millimetres: float, per: int) -> bytes:
    """CiA 402 objects 60A8h and 60A9h: power of ten, metre (01h), per second (03h) or nothing."""
    power = round(math.log10(millimetres * 1e-3))
    return struct.pack("<I", (power & 0xFF) << 24 | 0x01 << 16 | per << 8)


def _positive(raw: bytes) -> bool:
    (value,) = struct.unpack("<f", raw)
    return math.isfinite(value) and value > 0


def _word(*bits: bool) -> int:
    """Return bits from bit 0 up."""
    return sum(bit << index for index, bit in enumerate(bits))


def _halves(value: int) -> tuple[int, int]:
    """Return a 32-bit value, low word first."""
    return value & 0xFFFF, value >> 16 & 0xFFFF


def _within(address: int, count: int, start: int, length: int) -> bool:
    return start <= address and address + count <= start + length
