"""Simulated Oriental Motor AZ drive (AZD-KD) with one linear actuator: registers in, motion out.

The drive positions by direct data operation, shows its state in registers, keeps parameters, and
watches that requests come over its line. It moves its `SimulatedAxis` and writes to the World's log
who commanded what; what pushes against the axis it asks from its `AxisPort`. It shares no code with
the driver that is tested against it.

Everything is evaluated lazily at exact World times: a communication time-out has stopped the
axis when it expired, not when the axis was asked for next. World positions are the
carriage's, which equal the drive's own after homing, and must be asked from `position_mm`.

Sources: the register map of the vendor's manual HP-5142E (sister product, same scheme), the
vendor's ROS stack om_modbus_master and public code that drives an AZD-KD. UNCONFIRMED on a drive,
each marked in its place: which commands are refused with exception 04, what a STOP input that
stands does to later commands, when the communication time-out begins to run, alarms 10h, 33h, 4Ah
and 70h, what software overtravel does to a target beyond it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from drivers.simulated.faults.plan import DriveFault, MoveFault
from drivers.simulated.ports import AxisPort, DigitalInputPort
from drivers.simulated.transports.modbus_tcp import ILLEGAL_ADDRESS, ModbusError
from drivers.simulated.world.axis import AxisCommand, AxisEvent, Mechanics
from drivers.simulated.world.drive import Due, SimulatedDrive

SLAVE_ERROR = 4

# Alarms. 10h, 33h, 4Ah and 70h are from memory.
POSITION_DEVIATION, ABSOLUTE_POSITION, HOMING_INCOMPLETE = 0x10, 0x33, 0x4A
HOMING_FAILED, LIMIT_SENSOR, LINE_TIMEOUT, OPERATION_DATA = 0x62, 0x66, 0x85, 0x70

# Upper registers of 32-bit values.
DATA_NUMBER, OPERATION_TYPE, POSITION, SPEED = 0x58, 0x5A, 0x5C, 0x5E
STARTING_RATE, STOPPING_RATE, CURRENT, TRIGGER, DESTINATION = 0x60, 0x62, 0x64, 0x66, 0x68
INPUT_COMMAND, OUTPUT_STATUS, PRESENT_ALARM = 0x7C, 0x7E, 0x80
COMMAND_POSITION, FEEDBACK_POSITION = 0xC6, 0xCC
FEEDBACK_RPM, FEEDBACK_Hz = 0xCE, 0xD0
REMAINING_DWELL, DIRECT_IO, TORQUE = 0xD2, 0xD4, 0xD6
"""Registers. UNCONFIRMED: the content of 00D2h, which reads 0, and that 00D6h is the torque."""
DIRECT_INPUTS = 10
DRIVER_TEMPERATURE, MOTOR_TEMPERATURE = 0xF8, 0xFA
ALARM_RESET, INTERNAL_OUTPUTS = 0x180, 0x178
OVERTRAVEL, HIGH_LIMIT, LOW_LIMIT = 0x386, 0x388, 0x38A
LINE_TIMEOUT_ms, ERRORS_TO_ALARM, SLAVE_ERROR_RESPONSE = 0x138A, 0x138C, 0x1392
TRIGGERED_BY = {
    -7: DATA_NUMBER, -6: OPERATION_TYPE, -5: POSITION, -4: SPEED,
    -3: STARTING_RATE, -2: STOPPING_RATE, -1: CURRENT,
}  # fmt: skip
_RANGES = {
    DATA_NUMBER: (0, 255),
    OPERATION_TYPE: (0, 22),
    POSITION: (-(2**31), 2**31 - 1),
    SPEED: (-4_000_000, 4_000_000),
    STARTING_RATE: (1, 1_000_000_000),
    STOPPING_RATE: (1, 1_000_000_000),
    CURRENT: (0, 1000),
    TRIGGER: (-7, 1),
    DESTINATION: (0, 1),
    INPUT_COMMAND: (0, 0xFFFF),
    ALARM_RESET: (0, 1),
    OVERTRAVEL: (-1, 3),
    HIGH_LIMIT: (-(2**31), 2**31 - 1),
    LOW_LIMIT: (-(2**31), 2**31 - 1),
    LINE_TIMEOUT_ms: (0, 10_000),
    ERRORS_TO_ALARM: (1, 10),
    SLAVE_ERROR_RESPONSE: (0, 1),
}
"""Registers that can be written, and their accepted values; others are refused with exception
04."""
_ABSOLUTE, _FROM_COMMAND, _FROM_FEEDBACK, _STOP_TYPE = 1, 2, 3, 0
_START, _HOME, _STOP, _FREE, _RESET = 0x08, 0x10, 0x20, 0x40, 0x80
IN_POSITION_mm = 0.01
ROOM_TEMPERATURE = 312
"""Room temperature in tenths of a degree."""


@dataclass(frozen=True)
class SimulatedAzSettings:
    """The settings of one simulated drive, and its faults."""

    name: str = "stage_z"
    """Name of the drive in the World, its log and fault plans."""
    unit_id: int = 1
    steps_per_mm: float = 3000.0
    """Resolution 9000 steps a revolution, lead 3 mm (assumed)."""
    lead_mm: float = 3.0
    force_at_full_current_N: float = 100.0
    home_mm: float = 0.0
    homing_speed_mm_s: float = 20.0
    homing_rate_mm_s2: float = 1000.0
    unhomed_offset_mm: float = 37.5
    """Error of the drive's position before it has been homed."""
    mechanics: Mechanics = field(default_factory=Mechanics)
    """Mechanics of the axis. Its following window is the limit of the drive's position deviation
    alarm."""
    faults: tuple[MoveFault, ...] = ()


class AxisAndInputs(AxisPort, DigitalInputPort, Protocol):
    """The World's side of a drive with direct inputs."""


class AzDrive(SimulatedDrive[MoveFault]):
    """One drive and its actuator; a `LineDevice` for `RtuLine`."""

    def __init__(self, settings: SimulatedAzSettings, port: AxisAndInputs):
        super().__init__(
            settings.name,
            settings.mechanics,
            lambda mm, t_us: port.load_N(settings.name, mm, t_us),
            settings.faults,
            port,
        )
        self.settings = settings
        self._inputs: DigitalInputPort = port
        self.alarm = 0
        self.homed = False
        """ABSPEN: the drive knows where it is."""
        self.homing = False
        self._moving = False
        """True if a motion has begun whose end has not been seen."""
        self._values = _factory_values(settings)
        self._zero_mm = -settings.unhomed_offset_mm
        self._target_mm: float | None = None
        self._home_end = False
        self._frozen: dict[int, int] = {}
        """Values that it shows whatever happens, by upper register."""
        self._heard_us = port.now_us

    # --- the line's side ----------------------------------------------------------------------

    @property
    def name(self) -> str:
        """Name of the drive in the World and fault plans."""
        return self.settings.name

    @property
    def unit_id(self) -> int:
        """Address of the drive on the line."""
        return self.settings.unit_id

    def heard(self) -> None:
        """Restart the time-out, which a frame to any drive does; a late one finds it expired."""
        self.settle(self._port.now_us)
        self._heard_us = self._port.now_us

    def read(self, address: int, count: int, by: str) -> Sequence[int]:
        """Return `count` successive registers; raises ModbusError if one of them does not exist."""
        return [self._register(one) for one in range(address, address + count)]

    def write(self, address: int, values: Sequence[int], by: str) -> None:
        """Take the values, all or none; what they start is refused where it cannot be done.

        Raises ModbusError if they are refused.
        """
        wanted: dict[int, int] = {}
        for register, value in enumerate(values, address):
            pair = register & ~1
            if pair not in _RANGES:
                raise ModbusError(ILLEGAL_ADDRESS)
            old = wanted.get(pair, self._values[pair]) & 0xFFFFFFFF
            shift = 0 if register & 1 else 16
            wanted[pair] = _signed(old & ~(0xFFFF << shift) | value << shift)
        for pair, value in wanted.items():
            low, high = _RANGES[pair]
            if not low <= value <= high:
                raise ModbusError(SLAVE_ERROR)  # out of range: its cause in the error history
        before = dict(self._values)
        self._values.update(wanted)
        try:
            self._obey(wanted, before, by)
        except ModbusError:
            self._values = before
            raise

    # --- what happens by itself ---------------------------------------------------------------

    def _own_due(self, now_us: int) -> Due | None:
        """Return the communication time-out, where it has expired."""
        if not self._values[LINE_TIMEOUT_ms] or self.alarm:
            return None
        deadline = self._heard_us + 1000 * self._values[LINE_TIMEOUT_ms]
        return (deadline, self._expire) if deadline < now_us else None

    def _freeze_status(self) -> None:
        now_us = self._port.now_us
        self._frozen = {pair: shown(self, now_us) for pair, shown in _SHOWN.items()}

    def _expire(self, t_us: int) -> None:
        self._fail(LINE_TIMEOUT, t_us)

    def _apply_own_fault(self, fault: MoveFault, t_us: int, velocity_mm_s: float) -> None:
        if isinstance(fault, DriveFault):
            self._fail(fault.code or POSITION_DEVIATION, t_us)
        elif fault.kind == "limit-switch":
            self._fail(LIMIT_SENSOR, t_us)
        else:
            self.homed = self._home_end = False
            self._log("homed", False, "drive")
            self._fail(ABSOLUTE_POSITION, t_us)

    def _catch_up(self, t_us: int) -> None:
        for happening in self.axis.happenings(t_us):
            if self.homing:
                self._fail(HOMING_FAILED, happening.t_us, braking=True)
            elif happening.event is AxisEvent.FOLLOWING_ERROR:
                self._fail(POSITION_DEVIATION, happening.t_us, braking=True)
            else:
                self._fail(LIMIT_SENSOR, happening.t_us, braking=True)
        if self._moving and self.axis.finished(t_us):
            self._arrive(t_us)

    def _arrive(self, t_us: int) -> None:
        self._moving = False
        position = self.axis.position(t_us)
        self._log("at-rest", round(position, 6), "drive")
        if self.homing:
            self.homing, self.homed, self._home_end = False, True, True
            self._zero_mm = position - self.settings.home_mm
            self._log("homed", True, "drive")

    def _fail(self, code: int, t_us: int, braking: bool = False) -> None:
        """Switch ALM-A on and READY off, and stop the motor."""
        self.alarm = code
        self._log("fault", code, "drive")
        if self.homing:
            self.homed = False
        if not braking:
            self.axis.stop(t_us, self._stopping())
        self._rest()

    def _rest(self) -> None:
        """End the operation under way."""
        self.homing = False
        self._target_mm = self._motion_faults.runs_to_mm = None

    # --- what is written ----------------------------------------------------------------------

    def _obey(self, wanted: dict[int, int], before: dict[int, int], by: str) -> None:
        if LINE_TIMEOUT_ms in wanted:
            self._log("timeout_ms", wanted[LINE_TIMEOUT_ms], by)
        if wanted.get(ALARM_RESET) == 1 and before[ALARM_RESET] != 1:
            self._reset_alarm(by)
        if INPUT_COMMAND in wanted:
            self._input(before[INPUT_COMMAND], wanted[INPUT_COMMAND], by)
        trigger = self._values[TRIGGER]
        if TRIGGER in wanted and trigger == 1:
            self._values[TRIGGER] = 0
            self._operate(by)
        elif TRIGGERED_BY.get(trigger) in wanted:
            self._operate(by)

    def _reset_alarm(self, by: str) -> None:
        if self.alarm:
            self._log("acknowledged", self.alarm, by)
            self.alarm = 0

    def _input(self, before: int, now: int, by: str) -> None:
        rising = now & ~before
        if rising & _RESET:
            self._reset_alarm(by)
        if now & (_STOP | _FREE):
            self._stop(by)
        elif rising & _HOME:
            self._home(by)
        elif rising & _START:
            raise ModbusError(SLAVE_ERROR)  # stored operation data: not simulated

    def _stop(self, by: str) -> None:
        if self._moving:
            self._log("stop", None, by)
            self.axis.stop(self._port.now_us, self._stopping())
        self._rest()

    def _require_ready(self) -> None:
        """Refuse as not executable (8Dh) while an alarm or a STOP input is on (UNCONFIRMED)."""
        if self.alarm or self._values[INPUT_COMMAND] & (_STOP | _FREE):
            raise ModbusError(SLAVE_ERROR)

    def _home(self, by: str) -> None:
        self._require_ready()
        self._target_mm, self._home_end, self.homing = None, False, True
        own = self.settings
        self._log("homing", own.home_mm, by)
        rate = own.homing_rate_mm_s2
        self._start(AxisCommand(own.home_mm, own.homing_speed_mm_s, rate, rate))

    def _operate(self, by: str) -> None:
        """Start the direct data operation that its registers describe."""
        values, now_us = self._values, self._port.now_us
        kind, speed = values[OPERATION_TYPE], values[SPEED]
        if kind == _STOP_TYPE:
            self._stop(by)
            return
        self._require_ready()
        if self.homing:
            raise ModbusError(SLAVE_ERROR)
        if kind not in (_ABSOLUTE, _FROM_COMMAND, _FROM_FEEDBACK) or speed <= 0:
            self._fail(OPERATION_DATA, now_us)  # the others are not simulated
            return
        distance = values[POSITION] / self.settings.steps_per_mm
        here = self.axis.position(now_us)
        if kind == _ABSOLUTE:
            if not self.homed:
                self._fail(HOMING_INCOMPLETE, now_us)
                return
            target = self._zero_mm + distance
        elif kind == _FROM_COMMAND:
            target = here + self.axis.following_error(now_us) + distance
        else:
            target = here + distance
        target = self._limited(target)
        again = self._target_mm is not None  # until a stop or an alarm
        self._target_mm = target
        if not again:
            self._port.tasks.begin(self.settings.name, self._port.now_us)
        speed_mm_s = speed / self.settings.steps_per_mm
        if not again:
            self._log("move", {"target_mm": round(target, 6), "speed_mm_s": speed_mm_s}, by)
        force_N = values[CURRENT] / 1000 * self.settings.force_at_full_current_N
        self.axis.force_limit_N = force_N
        rates = (
            values[rate] / self.settings.steps_per_mm for rate in (STARTING_RATE, STOPPING_RATE)
        )
        self._start(self._motion_faults.command(target, speed_mm_s, *rates))

    def _limited(self, target_mm: float) -> float:
        """Software overtravel: as far as it lets it go (UNCONFIRMED)."""
        if self._values[OVERTRAVEL] < 0 or not self.homed:
            return target_mm
        low, high = (
            self._zero_mm + self._values[limit] / self.settings.steps_per_mm
            for limit in (LOW_LIMIT, HIGH_LIMIT)
        )
        return min(max(target_mm, low), high)

    def _start(self, command: AxisCommand) -> None:
        self._moving = True
        self.axis.move(self._port.now_us, command)

    def _stopping(self) -> float:
        """Deceleration of a stop in mm/s2: homing's own, or that of the latest motion."""
        if self.homing:
            return self.settings.homing_rate_mm_s2
        return self._values[STOPPING_RATE] / self.settings.steps_per_mm

    # --- what is read -------------------------------------------------------------------------

    def _register(self, address: int) -> int:
        pair = address & ~1
        shown = _SHOWN.get(pair)
        if pair in self._frozen:
            value = self._frozen[pair]
        elif shown is not None:
            value = shown(self, self._port.now_us)
        elif pair in self._values:
            value = self._values[pair]
        else:
            raise ModbusError(ILLEGAL_ADDRESS)
        return value & 0xFFFF if address & 1 else value >> 16 & 0xFFFF

    def direct_inputs(self) -> int:
        """Return the levels of DIN0 to DIN9, in the lower register; outputs are not simulated."""
        levels = {
            bit: self._inputs.input_high(self.settings.name, f"DIN{bit}")
            for bit in range(DIRECT_INPUTS)
        }
        return _word(levels)

    def _steps(self, position_mm: float) -> int:
        return round((position_mm - self._zero_mm) * self.settings.steps_per_mm)

    def _torque(self, now: int) -> int:
        """Return the present torque in tenths of a percent; none with an alarm."""
        force_N = 0.0 if self.alarm else self._shown_force_N(now)
        return round(1000 * force_N / self.settings.force_at_full_current_N)

    def _status(self, now: int) -> int:
        """Return the outputs as they are assigned at the factory."""
        here = self.axis.position(now)
        resting = self.axis.finished(now)
        arrived = self._target_mm is not None and abs(here - self._target_mm) <= IN_POSITION_mm
        return _word(
            {
                3: bool(self._values[INPUT_COMMAND] & _START),
                4: self._home_end,
                5: self._is_ready(now),
                7: bool(self.alarm),
                13: not resting,
                14: resting and (arrived or self._target_mm is None),
                15: abs(self.axis.following_error(now)) > IN_POSITION_mm,
            }
        )

    def _is_ready(self, now: int) -> bool:
        held = bool(self._values[INPUT_COMMAND] & (_STOP | _FREE))
        return not self.alarm and not held and self.axis.finished(now)

    def _internal_outputs(self, now: int) -> int:
        """Return registers 0178h and 0179h as one word of 32 bits."""
        upper = _word({0: self._home_end, 1: self.homed})
        lower = _word(
            {
                1: bool(self.alarm),
                3: True,
                4: self._is_ready(now),
                6: not self.axis.finished(now),
            }
        )
        return upper << 16 | lower


_SHOWN: dict[int, Callable[[AzDrive, int], int]] = {
    OUTPUT_STATUS: AzDrive._status,
    PRESENT_ALARM: lambda drive, now: drive.alarm,
    COMMAND_POSITION: lambda drive, now: drive._steps(
        drive.axis.position(now) + drive.axis.following_error(now) + drive.shows_off_mm
    ),
    0xC8: lambda drive, now: 0,  # command speed; not simulated
    0xCA: lambda drive, now: 0,
    FEEDBACK_POSITION: lambda drive, now: drive._steps(
        drive.axis.position(now) + drive.shows_off_mm
    ),
    FEEDBACK_RPM: lambda drive, now: round(drive.axis.velocity(now) * 60 / drive.settings.lead_mm),
    FEEDBACK_Hz: lambda drive, now: round(drive.axis.velocity(now) * drive.settings.steps_per_mm),
    REMAINING_DWELL: lambda drive, now: 0,
    DIRECT_IO: lambda drive, now: drive.direct_inputs(),
    TORQUE: lambda drive, now: drive._torque(now),
    DRIVER_TEMPERATURE: lambda drive, now: ROOM_TEMPERATURE,
    MOTOR_TEMPERATURE: lambda drive, now: ROOM_TEMPERATURE,
    INTERNAL_OUTPUTS: AzDrive._internal_outputs,
}
"""Values that are made when they are read, by upper register."""


def _factory_values(settings: SimulatedAzSettings) -> dict[int, int]:
    """Everything that can be written, as it is after power-up."""
    low, high = (
        round(mm * settings.steps_per_mm)
        for mm in (settings.mechanics.low_switch_mm, settings.mechanics.high_switch_mm)
    )
    return {
        **dict.fromkeys(_RANGES, 0),
        SPEED: 1000,
        STARTING_RATE: 1_000_000,
        STOPPING_RATE: 1_000_000,
        CURRENT: 1000,
        OVERTRAVEL: 3,
        LOW_LIMIT: low,
        HIGH_LIMIT: high,
        ERRORS_TO_ALARM: 3,
        SLAVE_ERROR_RESPONSE: 1,
    }


def _signed(value: int) -> int:
    return value - (1 << 32) if value >> 31 else value


def _word(bits: dict[int, bool]) -> int:
    """Return a word with these of its bits set."""
    return sum(1 << bit for bit, on in bits.items() if on)
