"""The interface of another package's simulated instrument to the simulated bench: a core per role.

A laboratory's own simulator is a subclass of `GeneratorCore`, `DaqCore`, `LinearStageCore`,
`RotaryStageCore` or `ForceSensorCore` (in `force_sensor`), registered in the entry-point group
``rig.simulators`` under the name of its driver. The bench makes it with its place in the World,
puts it behind a serial or TCP server as its `link` says, and writes its table into the bench file.
docs/add-a-driver.md has examples.

A core holds the instrument's state and speaks its protocol. It never waits, reads no wall clock and
opens nothing: bytes of a client come in through `exchanges`, and what falls due on its own goes out
through `frames_until`. A protocol of lines needs `answer` alone.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from typing import Any, ClassVar, Literal

import numpy as np
import numpy.typing as npt

from drivers.simulated.faults.plan import DriveFault, MoveFault, RotaryFault
from drivers.simulated.faults.wire import WireDialect
from drivers.simulated.ports import (
    AnalogueInputPort,
    AxisPort,
    DrivePort,
    Exchange,
    Excitation,
    GeneratorPort,
    LogPort,
)
from drivers.simulated.world.axis import AxisCommand, AxisEvent, Mechanics
from drivers.simulated.world.drive import SimulatedDrive

__all__ = [
    "AnalogueInputPort",
    "AxisCommand",
    "AxisEvent",
    "AxisPort",
    "DaqCore",
    "Exchange",
    "Excitation",
    "GeneratorCore",
    "GeneratorPort",
    "InstrumentCore",
    "LinearStageCore",
    "LogPort",
    "Mechanics",
    "RotaryStageCore",
    "host_and_port",
]


def host_and_port(where: str) -> tuple[str, int]:
    """Return host and port of a place such as ``socket://127.0.0.1:4001``, for drivers that have
    them as two settings. Raises ValueError for a serial port."""
    host, _, port = where.removeprefix("socket://").rpartition(":")
    return host, int(port)


class InstrumentCore(ABC):
    """The common base of the cores of all roles."""

    roles: ClassVar[tuple[str, ...]] = ()
    """The roles of a bench file that it can play."""
    title: ClassVar[str] = ""
    """Maker and model, for messages."""
    link: ClassVar[Literal["serial", "tcp"]] = "serial"
    """Kind of the instrument's connection: a serial port, or a TCP port with the same bytes."""
    terminator: ClassVar[bytes] = b"\n"
    """Bytes that end a request, and an answer of `answer`."""
    alike: ClassVar[tuple[bytes, ...]] = ()
    """Beginnings of requests that are like one another, such as polls: of each, the contract's walk
    of faults visits the first in a step."""
    disturbances: ClassVar[tuple[str, ...]] = ()
    """Kinds of a fault plan, apart from those of the wire, that it can meet."""
    vendor: str = ""
    model: str = ""
    serial_number: str = ""
    """Begins with SIM; empty where the instrument states none."""
    firmware: str = ""

    @abstractmethod
    def bench_settings(self, where: str) -> dict[str, Any]:
        """Return the keys of a bench file's table for the driver, apart from ``driver`` and
        ``timeout_s``, and ``channels`` of a DAQ. `where` is the path of a serial port or
        ``socket://127.0.0.1:4001``; see `host_and_port`."""

    def answer(self, request: bytes, by: str) -> bytes | None:
        """Obey one request, given without its terminator; return the answer without terminator, or
        None where the instrument gives none. `by` is who asks, for the log."""
        raise NotImplementedError

    def exchanges(self, data: bytes, by: str) -> Iterable[Exchange]:
        """Take bytes of a client; return the requests that they complete, with their replies. An
        instrument whose requests are not lines overrides this."""
        unfinished: dict[str, bytes] = self.__dict__.setdefault("_unfinished", {})
        *requests, unfinished[by] = (unfinished.get(by, b"") + data).split(self.terminator)
        for request in requests:
            reply = self.answer(request, by)
            yield Exchange(request, None if reply is None else reply + self.terminator)

    def frames_until(self, now_us: int) -> bytes:
        """Return what the instrument sends without being asked since the last call, up to the World
        time `now_us` in us; no bytes for most."""
        return b""

    def wire_dialect(self) -> WireDialect:
        """Return how its protocol states errors, for fault plans."""
        return WireDialect()

    def disturb(self, kind: Any, begin_s: float, **keys: Any) -> None:
        """Take a disturbance of a fault plan from a World time on; `disturbances` names those that
        it can take. `keys` are those of the kind in docs/fault-plans.md, such as ``for_s``."""
        raise NotImplementedError(f"{self.title} cannot be {kind}")


class GeneratorCore(InstrumentCore):
    """A simulated signal generator, whose channel 1 drives the vibrator.

    It informs the World of every change of its output with
    ``port.excite(1, Excitation(on, "SIN", frequency_Hz, amplitude_V, offset_V, phase_rad), by)``.
    """

    roles = ("generator",)

    def __init__(self, port: GeneratorPort, log: LogPort, name: str = "generator"):
        """Switch the instrument on, its output off."""
        self.port, self.log, self.name = port, log, name


class DaqCore(InstrumentCore):
    """A simulated data acquisition unit.

    It calls ``port.begin_acquisition()`` when it begins to sample and takes samples with
    ``port.volts(...)``, whose terminals are 101 and 102, whatever its own inputs are called.
    """

    roles = ("daq",)

    def __init__(self, port: AnalogueInputPort, log: LogPort, name: str = "daq"):
        """Switch the instrument on."""
        self.port, self.log, self.name = port, log, name

    @property
    @abstractmethod
    def acquiring(self) -> bool:
        """True if it samples now."""

    def channel(self, terminal: int) -> Any:
        """Return what the setting `channels` of the driver calls a terminal of the World (101 or
        102)."""
        return terminal


class _StageCore(SimulatedDrive[Any], InstrumentCore):
    """The common base of linear and rotary stages; in millimetres, or in degrees if it turns.

    The World's positions are those of a stage that has been homed: its reference is at 0.
    """

    mechanics: ClassVar[Mechanics] = Mechanics()
    """Mechanics of the axis, and its position when it is switched on."""
    disturbances: ClassVar[tuple[str, ...]] = (
        *("stuck", "runaway", "slow", "drive-fault", "limit-switch", "reference-lost"),
    )
    limits: tuple[float, float]
    """The travel that the bench needs, for `bench_settings`: lowest and highest position."""

    def __init__(self, port: DrivePort, load: Any, name: str, faults: Sequence[Any]):
        super().__init__(name, self.mechanics, load, faults, port)
        self.port, self.name = port, name
        self.homed = False
        """True if it has found its reference."""
        self.failure = ""
        """Reason why it has stopped by itself; "" for no reason. `recover` forgets it."""
        self._homing = False
        self._moving = False
        """True if a motion has begun whose end has not been seen."""

    # --- what a protocol asks of it -----------------------------------------------------------

    @property
    def position(self) -> float:
        """Present position of the carriage."""
        return self.position_mm(self._port.now_us)

    @property
    def speed(self) -> float:
        """Present speed, negative towards smaller positions."""
        return self.velocity_mm_s(self._port.now_us)

    @property
    def moving(self) -> bool:
        """True if a motion is under way now."""
        self.settle(self._port.now_us)
        return self._moving

    def move(self, target: float, speed: float, acceleration: float, by: str) -> None:
        """Begin a motion, or change the one under way without a stop between."""
        now_us = self._port.now_us
        self.settle(now_us)
        self._homing = False
        if not self._moving:
            self._port.tasks.begin(self.name, now_us)
            self._log("move", {"target": round(target, 6), "speed": round(speed, 6)}, by)
        if self._motion_faults.runs_to_mm is not None:
            target = self._motion_faults.runs_to_mm
        self._go(target, speed, acceleration)

    def home(self, speed: float, acceleration: float, by: str) -> None:
        """Begin to look for the reference, at position 0; `homed` is true when it stands there."""
        self.settle(self._port.now_us)
        self._homing, self.homed = True, False
        self._log("homing", 0.0, by)
        self._go(0.0, speed, acceleration)

    def stop(self, deceleration: float, by: str) -> None:
        """Begin to brake."""
        now_us = self._port.now_us
        self.settle(now_us)
        self._log("stop", None, by)
        self._homing, self._motion_faults.runs_to_mm = False, None
        self.axis.stop(now_us, deceleration)

    def recover(self) -> None:
        """Forget a failure, so that it can move again."""
        self.failure = ""

    def _go(self, target: float, speed: float, acceleration: float) -> None:
        if self.failure:
            return
        self._moving = True
        own = AxisCommand(
            target, speed * self._motion_faults.speed_share, acceleration, acceleration
        )
        self.axis.move(self._port.now_us, own)

    # --- what happens by itself ---------------------------------------------------------------

    def _catch_up(self, t_us: int) -> None:
        for happening in self.axis.happenings(t_us):
            self._fail(happening.event.value, happening.t_us)
        if not self._moving or not self.axis.finished(t_us):
            return
        self._moving = False
        self._log("at-rest", round(self.axis.position(t_us), 6), "drive")
        if self._homing:
            self._homing, self.homed = False, True
            self._log("homed", True, "drive")

    def _fail(self, reason: str, t_us: int) -> None:
        """Brake, and refuse to move until `recover`."""
        self.failure, self._homing = reason, False
        self._motion_faults.runs_to_mm = None
        self._log("fault", reason, "drive")
        self.axis.stop(t_us, self.mechanics.quick_deceleration_mm_s2)

    def _apply_own_fault(self, fault: Any, t_us: int, velocity_mm_s: float) -> None:
        if isinstance(fault, DriveFault):
            self._fail(f"fault {fault.code or 1}", t_us)
        elif fault.kind == "limit-switch":
            event = AxisEvent.LOW_SWITCH if velocity_mm_s < 0 else AxisEvent.HIGH_SWITCH
            self._fail(event.value, t_us)
        else:
            self.homed = False
            self._log("homed", False, "drive")


class LinearStageCore(_StageCore):
    """A simulated linear stage, as ``stage_z`` or ``stage_x``; positions in mm."""

    roles = ("stage_z", "stage_x")
    limits = (0.0, 14.0)

    def __init__(
        self,
        port: AxisPort,
        log: LogPort,
        name: str = "stage_z",
        faults: Sequence[MoveFault] = (),
    ):
        """Switch the stage on. Its name says which of the stages it is: what it pushes against."""
        super().__init__(port, lambda mm, t_us: port.load_N(name, mm, t_us), name, faults)


class RotaryStageCore(_StageCore):
    """A simulated rotary stage; positions in degrees, whatever their names say."""

    roles = ("rotary",)
    limits = (0.0, 30.0)
    mechanics = Mechanics(
        start_mm=8.0, low_switch_mm=-math.inf, high_switch_mm=math.inf, following_window_mm=math.inf
    )
    disturbances = ("stuck", "runaway", "slow", "limit-switch", "reference-lost")

    def __init__(
        self,
        port: DrivePort,
        log: LogPort,
        name: str = "rotary",
        faults: Sequence[RotaryFault] = (),
    ):
        """Switch the stage on."""
        super().__init__(port, lambda deg, t_us: 0.0, name, faults)

    def angles_deg(self, times_us: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        """Return the angles in deg, (n,), at ascending World times (n,)."""
        return self.positions_mm(times_us)

    def speed_deg_s(self, t_us: int) -> float:
        """Return how fast it turns or turned at a World time."""
        return self.velocity_mm_s(t_us)
