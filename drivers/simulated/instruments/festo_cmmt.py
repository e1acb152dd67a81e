"""Simulated Festo CMMT drive with one linear axis: registers in, motion out, no I/O.

The drive positions by telegram 111: it takes an output image, shows an input image, keeps
parameters behind a mailbox, and watches that requests come. It moves its `SimulatedAxis` and writes
to the World's log who commanded what; what pushes against the axis it asks from its `AxisPort`. It
shares no code with the driver that is tested against it, its telegram included.

Registers, power and faults are here. `cmmt_telegram` takes the output image apart, `cmmt_status`
makes the input image; `cmmt_motion` homes, jogs and positions; `cmmt_reference` has the drive's own
positions, `cmmt_parameters` the parameters and their mailbox.

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

from collections.abc import Mapping, Sequence
from functools import partial

from drivers.simulated.faults.plan import DriveFault, MoveFault
from drivers.simulated.instruments.cmmt_motion import CmmtMotion
from drivers.simulated.instruments.cmmt_parameters import (
    DATA_WORDS,
    MAILBOX_WORDS,
    CmmtParameters,
    RATED_TORQUE_Nm,
)
from drivers.simulated.instruments.cmmt_reference import CmmtReference
from drivers.simulated.instruments.cmmt_settings import SimulatedCmmtSettings
from drivers.simulated.instruments.cmmt_status import input_image
from drivers.simulated.instruments.cmmt_telegram import IMAGE_WORDS, OutputImage
from drivers.simulated.ports import AxisPort
from drivers.simulated.transports.modbus_tcp import ILLEGAL_ADDRESS, ModbusError
from drivers.simulated.world.axis import AxisEvent
from drivers.simulated.world.drive import Due, SimulatedDrive

OUTPUTS, INPUTS, TIMEOUT, MAILBOX, MAILBOX_DATA = 0, 100, 400, 500, 510

TIMEOUT_FAULT = 391  # "process data communication failed"; UNCONFIRMED for Modbus
SWITCH_FAULTS = {AxisEvent.LOW_SWITCH: 114, AxisEvent.HIGH_SWITCH: 115}
FOLLOWING_FAULT = 126
HOMING_FAULT = 58


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
        self.enabled = False
        self.identity: dict[int, str] = {
            0: "Festo SE & Co. KG", 1: settings.model, 2: "V000.0.0-simulated",
            3: "www.festo.com", 4: "Servo drive", 5: settings.model,
        }  # fmt: skip
        log = partial(port.log, settings.name)
        self.parameters = CmmtParameters(settings, self._torque_Nm, log)
        self.reference = CmmtReference(settings, self.parameters)
        faults, tasks = self._motion_faults, port.tasks
        self._motion = CmmtMotion(
            settings, self.axis, self.reference, self.parameters, faults, tasks, log
        )
        self._image = OutputImage()
        self._enable_at_us: int | None = None
        self._frozen_inputs: list[int] | None = None
        """The input image that it shows whatever happens."""
        self._timeout_ms = 0
        self._fed_us = port.now_us

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
            (MAILBOX, self.parameters.mailbox),
            (MAILBOX_DATA, self.parameters.data),
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
            self._take(OutputImage(tuple(words)), by)
        elif address == TIMEOUT and count <= 2:
            self._timeout_ms = values[0]
            self.parameters.set_timeout_ms(values[0])
            self._log("timeout_ms", values[0], by)
        elif _within(address, count, MAILBOX, MAILBOX_WORDS):
            self.parameters.write_mailbox(address - MAILBOX, values, self.enabled, by)
        elif _within(address, count, MAILBOX_DATA, DATA_WORDS):
            self.parameters.write_data(address - MAILBOX_DATA, values)
        else:
            raise ModbusError(ILLEGAL_ADDRESS)

    def _feed(self) -> None:
        """Restart the time-out: any request does (UNCONFIRMED: perhaps only process data do), but a
        late one finds it expired."""
        self.settle(self._port.now_us)
        self._fed_us = self._port.now_us

    def _inputs(self) -> list[int]:
        return input_image(
            self.settings,
            self._image,
            self._motion,
            self._port.now_us,
            fault=self.fault,
            enabled=self.enabled,
            enabling=self._enable_at_us is not None,
            shows_off_mm=self.shows_off_mm,
        )

    def _torque_Nm(self) -> float:  # noqa: N802 - the unit keeps its capital
        """Return the present torque; none without power."""
        force_N = self._shown_force_N(self._port.now_us) if self.enabled else 0.0
        share = force_N / self.settings.force_at_full_torque_N
        return share * RATED_TORQUE_Nm

    # --- what an output image asks for --------------------------------------------------------

    def _take(self, image: OutputImage, by: str) -> None:
        now = self._port.now_us
        before, self._image = self._image, image
        if not image.controlled:
            if self.enabled or self._enable_at_us is not None:
                self._disable(now, by)
            return
        if image.bit(0, 7) and not before.bit(0, 7) and self.fault:
            self._log("acknowledged", self.fault, by)
            self.fault = self._motion.warning = 0
        self._power(before, image, now, by)
        if not self.enabled:
            self._motion.acknowledged = False
        elif code := self._motion.obey(before, image, now, by):
            self._fail(code, now)

    def _power(self, before: OutputImage, image: OutputImage, now: int, by: str) -> None:
        wanted = image.bits(0, 1, 2, 3)
        if self.enabled or self._enable_at_us is not None:
            if not wanted:
                self._disable(now, by)
        elif wanted and not before.bit(0, 0) and not self.fault:
            self._enable_at_us = now + self.settings.enable_delay_us

    def _disable(self, t_us: int, by: str, braking: bool = False) -> None:
        if not braking:
            self._motion.brake(self._image, t_us)
        if self.enabled:
            self._log("enabled", False, by)
        self.enabled, self._enable_at_us = False, None
        self._motion.end()

    # --- what happens by itself ---------------------------------------------------------------

    def _own_due(self, now_us: int) -> Due | None:
        """Return the communication time-out, where it has expired."""
        if not self._timeout_ms or self.fault or not self._image.controlled:
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
            self.reference.homed = False
            self._log("homed", False, "drive")

    def _catch_up(self, t_us: int) -> None:
        if self._enable_at_us is not None and t_us >= self._enable_at_us:
            self._enable_at_us, self.enabled = None, True
            self._log("enabled", True, "drive")
        for happening in self.axis.happenings(t_us):
            self._meet(happening.event, happening.t_us)
        self._motion.settle(t_us)

    def _meet(self, event: AxisEvent, t_us: int) -> None:
        if event is AxisEvent.FIXED_STOP:
            self._motion.find_fixed_stop(t_us)
        elif self._motion.homing:
            self._fail(HOMING_FAULT, t_us, braking=True)
        else:
            self._fail(SWITCH_FAULTS.get(event, FOLLOWING_FAULT), t_us, braking=True)

    def _fail(self, code: int, t_us: int, braking: bool = False) -> None:
        """Set the fault bit, disable operation and make a controlled stop (reaction
        UNCONFIRMED)."""
        self.fault = code
        self._log("fault", code, "drive")
        if self._motion.homing:
            self.reference.homed = False
        self._disable(t_us, "drive", braking)


def _within(address: int, count: int, start: int, length: int) -> bool:
    return start <= address and address + count <= start + length
