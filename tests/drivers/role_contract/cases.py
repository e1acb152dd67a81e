"""The registry: for every installed driver, how its simulator is put on its real transport.

To bring a driver under the contract, write a subclass of `Case` that starts its simulator and tells
the truth about it, and add it to `CASES`. Everything in ``test_every_driver.py`` then applies.
"""

from __future__ import annotations

import os
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import replace
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from simulated.axis_bench import AxisBench
from simulated.ideal import IdealBench, serving

from drivers.simulated.faults.plan import FaultPlan, ReplyFault
from drivers.simulated.faults.wire import FaultyLink, WireFaults
from drivers.simulated.instruments.festo_cmmt import CmmtDrive, SimulatedCmmtSettings
from drivers.simulated.instruments.keysight_33500b import Keysight33500B
from drivers.simulated.instruments.keysight_u2300a import KeysightU2300A
from drivers.simulated.instruments.me_gsv8 import Gsv8
from drivers.simulated.instruments.oriental_az import AzDrive, SimulatedAzSettings
from drivers.simulated.instruments.zaber_rst import SimulatedRotarySettings, SimulatedRotaryStage
from drivers.simulated.transports.modbus_rtu import RtuLine
from drivers.simulated.transports.modbus_tcp import ILLEGAL_ADDRESS, ModbusError, ModbusTcpServer
from drivers.simulated.transports.scpi import ScpiInstrument
from drivers.simulated.transports.scpi_servers import HislipServer, ScpiSocketServer
from drivers.simulated.transports.serial_server import PtyServer
from drivers.simulated.transports.serial_tcp import SerialTcpServer
from drivers.simulated.world.axis import Mechanics
from rig.core.clock import Clock

from .roles import carried, pressed

TIMEOUT_S = 0.1
STRANGER = ("ACME", "T-1000", "77", "0.1")


class BenchClock(Clock):
    """The clock of an ideal bench: time passes when somebody sleeps, and only then."""

    def __init__(self, bench: IdealBench):
        super().__init__()
        self._bench = bench

    def now(self) -> float:
        """Bench time in seconds."""
        return self._bench.now_us * 1e-6

    def _pass(self, seconds: float) -> None:
        self._bench.now_us += max(1, round(seconds * 1e6))


class CountedFaults(WireFaults):
    """Faults that remember which requests there were."""

    def __init__(self, plan: FaultPlan, device: str):
        super().__init__(plan, device)
        self.heard: list[bytes] = []

    @property
    def requests(self) -> int:
        """How many there were."""
        return len(self.heard)

    def fault_for(self, request: bytes, reply: bytes | None) -> ReplyFault | None:
        """Count a request; the fault that befalls it."""
        self.heard.append(request)
        return super().fault_for(request, reply)


class Service(ABC):
    """A simulator that is running on its transport."""

    def __init__(self, faults: CountedFaults, bench: IdealBench | None = None):
        self.bench = bench if bench is not None else IdealBench(wave=carried)
        self.clock: Clock = BenchClock(self.bench)
        self.faults = faults
        self.settings: dict[str, Any] = {}
        """A bench file's table for the driver."""
        self.place = ""
        """How messages name where the instrument is."""

    def now_s(self) -> float:
        """Bench time in seconds."""
        return self.clock.now()

    def sleep(self, seconds: float) -> None:
        """Let bench time pass."""
        self.clock.sleep(seconds)

    def in_real_time(self) -> AbstractContextManager[None]:
        """Meanwhile time goes by itself, for a module's `make_safe` that waits on the wall clock;
        most need not."""
        return nullcontext()

    @abstractmethod
    def truth(self, what: str) -> Any:
        """What the simulated instrument really does, by the role's quantity."""

    @abstractmethod
    def at_rest(self) -> bool:
        """Whether the instrument does nothing that has to be stopped."""

    @abstractmethod
    def connections(self) -> int:
        """How many connections clients hold open."""


class Case(ABC):
    """One driver on one transport."""

    name: str
    driver: str
    """Entry point of group ``rig.drivers``."""
    every_fault = True
    """False where another case has the same driver on the same transport: the walk of all faults
    over all requests takes seconds."""
    alike: tuple[bytes, ...] = ()
    """Beginnings of requests that a driver says many times over, such as a poll or the reading of
    one parameter like another: the walk of faults visits the first of each in every step. All
    other requests are visited every one."""
    exclusive_link = ""
    """Why nothing can be connected beside a live connection, where that is so."""
    deaf_greeting = ""
    """Why nobody misses the answer to the very first request, where that is so."""
    drives_nothing = ""
    """Why the module's `make_safe` has nothing to do, where that is so."""
    anonymous = ""
    """Why the instrument cannot say that it is simulated, where that is so."""
    stranger_told = "ACME T-1000"
    """How another instrument than the expected one is named in the refusal."""

    def __repr__(self) -> str:
        return self.name

    def module(self) -> Any:
        """The driver, found as the program finds it."""
        (entry,) = entry_points(group="rig.drivers", name=self.driver)
        return entry.load()

    def serve(
        self, *fault: dict[str, Any], identity: tuple[str, str, str, str] | None = None
    ) -> Any:
        """A context manager that gives a running `Service`; `identity` makes it a stranger."""
        plan = FaultPlan.model_validate({"fault": [{"device": "it", **one} for one in fault]})
        return self._serve(self.faults(plan), identity)

    def faults(self, plan: FaultPlan) -> CountedFaults:
        """The plan's faults, as this case's transport meets them."""
        return CountedFaults(plan, "it")

    @abstractmethod
    def _serve(self, faults: CountedFaults, identity: tuple[str, str, str, str] | None) -> Any: ...


def clients_of(pty: str) -> int:
    """Descriptors of this process on a pseudo-terminal, without the server's own."""
    line, found = str(Path(pty).resolve()), 0
    for descriptor in os.listdir("/proc/self/fd"):  # noqa: PTH208 - names only
        with suppress(OSError):
            found += str(Path(f"/proc/self/fd/{descriptor}").readlink()) == line
    return found - 1


class ScpiService(Service):
    """A SCPI core behind one of the TCP servers."""

    core: ScpiInstrument
    server: Any

    def connections(self) -> int:
        """Open TCP connections."""
        return len(self.server.transports)


class GeneratorService(ScpiService):
    """Channel 1 of a simulated 33500B."""

    core: Keysight33500B

    def truth(self, what: str) -> Any:
        """The channel's state."""
        state = self.core.state(1)
        return {
            "frequency": state.frequency_Hz,
            "amplitude": state.amplitude_Vpp / 2,
            "on": state.on,
        }[what]

    def at_rest(self) -> bool:
        """Output off."""
        return not self.core.state(1).on


class DaqService(ScpiService):
    """A simulated U2300A."""

    def truth(self, what: str) -> Any:
        """Its records are checked by what the terminals carried."""
        raise KeyError(what)

    def at_rest(self) -> bool:
        """Nothing is sampled."""
        happened = [value for _, what, value, _ in self.bench.entries if what == "acquisition"]
        return not happened or happened[-1] != "run"


class ScpiCase(Case):
    """A SCPI instrument on a raw socket or HiSLIP."""

    def __init__(self, name: str, driver: str, link: str, settings: dict[str, Any]):
        self.name = name
        self.driver = driver
        self._link = link
        self._settings = settings

    @abstractmethod
    def _service(self, faults: CountedFaults) -> ScpiService: ...

    @contextmanager
    def _serve(
        self, faults: CountedFaults, identity: tuple[str, str, str, str] | None
    ) -> Iterator[Service]:
        service = self._service(faults)
        if identity is not None:
            service.core.identity = identity
        kind = HislipServer if self._link == "hislip" else ScpiSocketServer
        service.server = kind(service.core, faults=faults)
        with serving(service.server):
            port = service.server.port
            where = f"hislip0,{port}::INSTR" if self._link == "hislip" else f"{port}::SOCKET"
            service.place = f"TCPIP::127.0.0.1::{where}"
            service.settings = {
                "driver": self.driver,
                "resource": service.place,
                "timeout_s": TIMEOUT_S,
                **self._settings,
            }
            yield service


class GeneratorCase(ScpiCase):
    """The 33500B."""

    def _service(self, faults: CountedFaults) -> ScpiService:
        service = GeneratorService(faults)
        service.core = Keysight33500B(service.bench, service.bench)
        return service


class DaqCase(ScpiCase):
    """One model of the U2300A family; HiSLIP stands for USBTMC, whose messages it has."""

    def __init__(self, model: str):
        wiring = {"channels": {"load_cell": 101, "film": 102}}
        super().__init__(f"{model}-hislip", "keysight-u2300a", "hislip", wiring)
        self._model = model
        self.every_fault = model == "U2331A"

    def _service(self, faults: CountedFaults) -> ScpiService:
        service = DaqService(faults)
        service.core = KeysightU2300A(self._model, service.bench, service.bench)
        return service


# --- an axis on Modbus TCP -------------------------------------------------------------------


class FreeBench(AxisBench):
    """An axis's bench whose time can be let go."""

    _at_us = 0
    _free_from_ns: int | None = None

    @property  # type: ignore[override]
    def now_us(self) -> int:
        """Time set by hand, or going by itself from where it stood."""
        if self._free_from_ns is None:
            return self._at_us
        return self._at_us + (time.monotonic_ns() - self._free_from_ns) // 1000

    @now_us.setter
    def now_us(self, value: int) -> None:
        self._at_us = value

    @contextmanager
    def free(self) -> Iterator[None]:
        """Time goes by itself."""
        self._free_from_ns = time.monotonic_ns()
        try:
            yield
        finally:
            self._at_us, self._free_from_ns = self.now_us, None


class AxisService(Service):
    """A simulated CMMT; fast, so that a walk of faults over all its motions is."""

    bench: FreeBench

    def __init__(self, faults: CountedFaults):
        super().__init__(faults, FreeBench())
        self.drive = CmmtDrive(
            SimulatedCmmtSettings(
                homing_speed_mm_s=500.0,
                full_acceleration_mm_s2=50_000.0,
                mechanics=Mechanics(start_mm=3.0),
            ),
            self.bench,
        )
        self.server = ModbusTcpServer(self.drive, faults=faults)

    def in_real_time(self) -> AbstractContextManager[None]:
        """`make_safe` waits until the axis stands."""
        return self.bench.free()

    def truth(self, what: str) -> Any:
        """The carriage, and what the drive knows."""
        now = self.bench.now_us
        position, speed = self.drive.position_mm(now), self.drive.velocity_mm_s(now)
        return {"position": position, "speed": speed, "homed": self.drive.homed}[what]

    def at_rest(self) -> bool:
        """Stands, and has nowhere to go."""
        return self.truth("speed") == 0 and self.drive.axis.finished(self.bench.now_us)

    def connections(self) -> int:
        """Open TCP connections."""
        return len(self.server.transports)


class AxisCase(Case):
    """The CMMT. Every image that is written meets the faults; of the polls of the drive's status
    (FC3 100) and of the mailbox accesses, which are many times the rest, the first of a step."""

    name = "cmmt-modbus"
    driver = "festo-cmmt"
    alike = (b"FC3 100", b"FC6 50", b"FC3 50", b"FC3 510", b"FC16 510")

    @contextmanager
    def _serve(
        self, faults: CountedFaults, identity: tuple[str, str, str, str] | None
    ) -> Iterator[Service]:
        service = AxisService(faults)
        if identity is not None:
            vendor, model, _, revision = identity
            service.drive.identity.update({0: vendor, 1: model, 2: revision, 4: "axis", 5: model})
        with serving(service.server):
            service.place = f"127.0.0.1:{service.server.port}"
            service.settings = {
                "driver": self.driver,
                "axis": "z",
                "host": "127.0.0.1",
                "port": service.server.port,
                "timeout_s": TIMEOUT_S,
                "low_limit_mm": 0.0,
                "high_limit_mm": 80.0,
                "max_speed_mm_s": 500.0,
                "acceleration_mm_s2": 20_000.0,
                "deceleration_mm_s2": 20_000.0,
                "full_acceleration_mm_s2": 50_000.0,
                "torque_limit_percent": 30.0,
            }
            yield service


# --- a rotary stage on a serial line or TCP --------------------------------------------------


class RotaryService(Service):
    """A simulated X-RST; it homes fast, so that a walk of faults over all its motions is."""

    bench: FreeBench

    def __init__(self, faults: CountedFaults, link: str):
        super().__init__(faults, FreeBench())
        self.stage = SimulatedRotaryStage(
            SimulatedRotarySettings(
                start_deg=3.0, homing_speed_deg_s=90.0, acceleration_deg_s2=2000.0
            ),
            self.bench,
        )
        self.server: Any
        if link == "serial":
            self.server = PtyServer(self.stage.line(), self.bench, slaved=True, faults=faults)
        else:
            self.server = SerialTcpServer(self.stage.line, faults=faults)

    def in_real_time(self) -> AbstractContextManager[None]:
        """`make_safe` waits until the stage stands."""
        return self.bench.free()

    def truth(self, what: str) -> Any:
        """What it really does, and what it knows."""
        now = self.bench.now_us
        angle, speed = self.stage.angle_deg(now), self.stage.speed_deg_s(now)
        homed = not self.stage.flags & {"WR", "WH"}
        return {"angle": angle, "speed": speed, "homed": homed}[what]

    def at_rest(self) -> bool:
        """Stands, and has nowhere to go."""
        return self.truth("speed") == 0 and self.stage.axis.finished(self.bench.now_us)

    def connections(self) -> int:
        """Who has the line or a TCP connection open."""
        if isinstance(self.server, SerialTcpServer):
            return len(self.server.transports)
        return clients_of(self.place)


class RotaryCase(Case):
    """The X-RST. Of the polls of angle and status, many times the rest, and of the set points of a
    stream, the first of a step meets the faults."""

    driver = "zaber-rst"
    alike = (b"get encoder.pos", b"move abs")
    stranger_told = "device id T-1000, serial number 77"  # it tells no name

    def __init__(self, link: str):
        self.name = f"rst-{link}"
        self._link = link
        self.every_fault = link == "serial"
        if link == "serial":
            self.exclusive_link = "a serial port belongs to the one who has opened it"

    @contextmanager
    def _serve(
        self, faults: CountedFaults, identity: tuple[str, str, str, str] | None
    ) -> Iterator[Service]:
        service = RotaryService(faults, self._link)
        if identity is not None:
            _, model, number, firmware = identity
            service.stage.settings = replace(
                service.stage.settings,
                device_id=model,
                serial=number,
                firmware=firmware,
                turn_microsteps=0,
            )
        with serving(service.server):
            serial = self._link == "serial"
            server = service.server
            service.place = server.path if serial else f"socket://127.0.0.1:{server.port}"
            service.settings = {
                "driver": self.driver,
                "port": service.place,
                "timeout_s": TIMEOUT_S,
                "microstep_deg": 0.00015625,
                "low_limit_deg": -5.0,
                "high_limit_deg": 90.0,
                "max_speed_deg_s": 60.0,
                "max_acceleration_deg_s2": 2000.0,
            }
            yield service


# --- an axis on a serial line ----------------------------------------------------------------


class LineAxisService(Service):
    """A simulated AZ drive, as fast as the CMMT above, on a line with another drive."""

    bench: FreeBench

    def __init__(self, faults: CountedFaults):
        super().__init__(faults, FreeBench())
        self.drive = self._drive("it", 1)
        line = RtuLine([self.drive, self._drive("the other", 2)], self.bench)
        faultless = WireFaults(FaultPlan(), "")
        self.server = PtyServer(
            line, self.bench, slaved=True, faults={"it": faults, "the other": faultless}
        )

    def _drive(self, name: str, unit_id: int) -> AzDrive:
        return AzDrive(
            SimulatedAzSettings(
                name,
                unit_id,
                homing_speed_mm_s=500.0,
                homing_rate_mm_s2=50_000.0,
                mechanics=Mechanics(start_mm=3.0),
            ),
            self.bench,
        )

    def in_real_time(self) -> AbstractContextManager[None]:
        """`make_safe` waits until the axis stands."""
        return self.bench.free()

    def truth(self, what: str) -> Any:
        """The carriage, and what the drive knows."""
        now = self.bench.now_us
        position, speed = self.drive.position_mm(now), self.drive.velocity_mm_s(now)
        return {"position": position, "speed": speed, "homed": self.drive.homed}[what]

    def at_rest(self) -> bool:
        """Stands, and has nowhere to go."""
        return self.truth("speed") == 0 and self.drive.axis.finished(self.bench.now_us)

    def connections(self) -> int:
        """Who has the line open."""
        return clients_of(self.place)


class LineAxisCase(Case):
    """The AZ. Polls of state and position meet the faults once in a step."""

    name = "az-rtu"
    driver = "oriental-az"
    alike = (b"FC3 124", b"FC3 198", b"FC3 376")
    anonymous = "its registers hold no serial number that is known"
    stranger_told = "has no register 00F8h"

    @contextmanager
    def _serve(
        self, faults: CountedFaults, identity: tuple[str, str, str, str] | None
    ) -> Iterator[Service]:
        service = LineAxisService(faults)
        if identity is not None:
            service.drive.read = stranger_to_registers  # type: ignore[method-assign]
        with serving(service.server):
            service.place = service.server.path
            service.settings = {
                "driver": self.driver,
                "axis": "z",
                "port": service.place,
                "parity": "N",
                "unit_id": 1,
                "timeout_s": TIMEOUT_S,
                "steps_per_mm": 3000.0,
                "low_limit_mm": 0.0,
                "high_limit_mm": 80.0,
                "max_speed_mm_s": 500.0,
                "acceleration_mm_s2": 20_000.0,
                "deceleration_mm_s2": 20_000.0,
                "torque_limit_percent": 30.0,
            }
            yield service


def stranger_to_registers(address: int, count: int, by: str) -> Sequence[int]:
    """A Modbus slave without any of them."""
    raise ModbusError(ILLEGAL_ADDRESS)


# --- a force sensor on a serial line ---------------------------------------------------------


class PressedBench(IdealBench):
    """A bench that presses on a force sensor."""

    noise_key = (3, 0, 0)

    def force_N(self, times_s: Any) -> Any:  # noqa: N802 - the unit keeps its capital
        """The true force."""
        return pressed(times_s)


class LineFaults(CountedFaults):
    """Faults of a serial line: answers and stream are counted together and keep their order."""

    def __init__(self, plan: FaultPlan, device: str):
        super().__init__(plan, device)
        self._line = FaultyLink(self)

    def link(self) -> FaultyLink:
        """The one line."""
        return self._line


class LineClock(BenchClock):
    """Time passes in the server's thread, which sends what falls due, as a control server does."""

    def __init__(self, bench: IdealBench, server: PtyServer):
        super().__init__(bench)
        self._server = server

    def _pass(self, seconds: float) -> None:
        def advance() -> None:
            super(LineClock, self)._pass(seconds)
            self._server.pump()
            done.set()

        done = threading.Event()
        loop = self._server._loop
        assert loop is not None, "the server has been started"
        loop.call_soon_threadsafe(advance)
        assert done.wait(5)


class AmplifierService(Service):
    """A simulated GSV-8 on a pseudo-terminal."""

    bench: PressedBench

    def __init__(self, faults: CountedFaults):
        super().__init__(faults, PressedBench())
        self.core = Gsv8(self.bench, self.bench)
        self.server = PtyServer(
            self.core, self.bench, slaved=True, faults=faults, stream_faults=faults
        )
        self.clock = LineClock(self.bench, self.server)

    def truth(self, what: str) -> Any:
        """The stream, and what the sensor is."""
        return {
            "rate": self.core.rate,
            "streaming": self.core.streaming,
            "bytes": self.server.bytes_sent,
            "matrix": self.core.sensor.matrix,
            "zero": self.core.sensor.zero_mV_V,
        }[what]

    def at_rest(self) -> bool:
        """Silent."""
        return not self.core.streaming

    def connections(self) -> int:
        """Who has the line open."""
        return clients_of(self.place)


class AmplifierCase(Case):
    """The GSV-8. Its three channels are set up alike, and so one of them meets the faults."""

    name = "gsv8-serial"
    driver = "me-gsv8"
    alike = (b"A2 ", b"14 ")
    exclusive_link = "a serial port belongs to the one who has opened it"
    deaf_greeting = "it ends a stream whose frames and answers are dropped, its own among them"
    drives_nothing = "a sensor drives nothing, and its stream guards the rest of the bench"
    stranger_told = "model number 06, serial 00000077"  # it tells no name

    def faults(self, plan: FaultPlan) -> CountedFaults:
        """Those of one line."""
        return LineFaults(plan, "it")

    @contextmanager
    def _serve(
        self, faults: CountedFaults, identity: tuple[str, str, str, str] | None
    ) -> Iterator[Service]:
        service = AmplifierService(faults)
        if identity is not None:
            service.core.model, service.core.serial_number = 0x06, identity[2].zfill(8)
        with serving(service.server):
            service.place = service.server.path
            service.settings = {
                "driver": self.driver,
                "port": service.place,
                "timeout_s": TIMEOUT_S,
            }
            yield service


CASES: tuple[Case, ...] = (
    GeneratorCase("33500b-socket", "keysight-33500b", "socket", {"max_amplitude_V": 3.0}),
    GeneratorCase("33500b-hislip", "keysight-33500b", "hislip", {"max_amplitude_V": 3.0}),
    DaqCase("U2331A"),
    DaqCase("U2542A"),
    AxisCase(),
    RotaryCase("serial"),
    RotaryCase("tcp"),
    LineAxisCase(),
    AmplifierCase(),
)
