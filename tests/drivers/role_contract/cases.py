"""The registry: for every driver of this project, how its simulator is put on its real transport.

To bring a driver under the contract, write a subclass of `SimulatedCase` that starts its simulator
and tells the truth about it, and add it to `CASES`. Every check of ``rig.testing`` then applies.
"""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from typing import Any

from simulated.axis_bench import AxisBench
from simulated.ideal import IdealBench, serving

from drivers.simulated.bench.alone import CountedFaults, clients_of
from drivers.simulated.faults.plan import FaultPlan
from drivers.simulated.faults.wire import WireFaults
from drivers.simulated.instruments.cmmt_settings import SimulatedCmmtSettings
from drivers.simulated.instruments.festo_cmmt import CmmtDrive
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
from rig.testing import TIMEOUT_S, BenchClock, Case, Service
from rig.testing.core_case import CoreCase
from rig.testing.signals import carried


class SimulatedService(Service):
    """A simulator on an ideal bench."""

    def __init__(self, faults: CountedFaults, bench: IdealBench | None = None):
        self.bench = bench if bench is not None else IdealBench(wave=carried)
        self.clock = BenchClock(self.bench)
        self.faults = faults
        self.settings = {}
        self.place = ""


class SimulatedCase(Case):
    """A driver of this project against one of its own simulators."""

    def _serve(
        self, faults: Sequence[Mapping[str, Any]], identity: tuple[str, str, str, str] | None
    ) -> AbstractContextManager[Any]:
        plan = FaultPlan.model_validate({"fault": list(faults)})
        return self._served(CountedFaults(plan, "it"), identity)

    @abstractmethod
    def _served(
        self, faults: CountedFaults, identity: tuple[str, str, str, str] | None
    ) -> AbstractContextManager[Any]: ...


class ScpiService(SimulatedService):
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
        return {"terminals": self.settings["channels"]}[what]

    def at_rest(self) -> bool:
        """Nothing is sampled."""
        happened = [value for _, what, value, _ in self.bench.entries if what == "acquisition"]
        return not happened or happened[-1] != "run"


class ScpiCase(SimulatedCase):
    """A SCPI instrument on a raw socket or HiSLIP."""

    def __init__(self, name: str, driver: str, link: str, settings: dict[str, Any]):
        self.name = name
        self.driver = driver
        self._link = link
        self._settings = settings

    @abstractmethod
    def _service(self, faults: CountedFaults) -> ScpiService: ...

    @contextmanager
    def _served(
        self, faults: CountedFaults, identity: tuple[str, str, str, str] | None
    ) -> Iterator[SimulatedService]:
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


class AxisService(SimulatedService):
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
        return {"position": position, "speed": speed, "homed": self.drive.reference.homed}[what]

    def at_rest(self) -> bool:
        """Stands, and has nowhere to go."""
        return self.truth("speed") == 0 and self.drive.axis.finished(self.bench.now_us)

    def connections(self) -> int:
        """Open TCP connections."""
        return len(self.server.transports)


class AxisCase(SimulatedCase):
    """The CMMT. Every image that is written meets the faults; of the polls of the drive's status
    (FC3 100) and of the mailbox accesses, which are many times the rest, the first of a step."""

    name = "cmmt-modbus"
    driver = "festo-cmmt"
    alike = (b"FC3 100", b"FC6 50", b"FC3 50", b"FC3 510", b"FC16 510")

    @contextmanager
    def _served(
        self, faults: CountedFaults, identity: tuple[str, str, str, str] | None
    ) -> Iterator[SimulatedService]:
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
                "communication_timeout_ms": 10_000,  # longer than PATIENT_S
            }
            yield service


# --- a rotary stage on a serial line or TCP --------------------------------------------------


class RotaryService(SimulatedService):
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


class RotaryCase(SimulatedCase):
    """The X-RST. Of the polls of angle and status, many times the rest, and of the set points of a
    stream, the first of a step meets the faults."""

    driver = "zaber-rst"
    alike = (b"get encoder.pos", b"move abs")
    stranger_says = "device id T-1000, serial number 77"  # it gives no name

    def __init__(self, link: str):
        self.name = f"rst-{link}"
        self._link = link
        self.every_fault = link == "serial"
        if link == "serial":
            self.exclusive_link = "a serial port belongs to the one who has opened it"

    @contextmanager
    def _served(
        self, faults: CountedFaults, identity: tuple[str, str, str, str] | None
    ) -> Iterator[SimulatedService]:
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


class LineAxisService(SimulatedService):
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


class LineAxisCase(SimulatedCase):
    """The AZ. Polls of state and position meet the faults once in a step."""

    name = "az-rtu"
    driver = "oriental-az"
    alike = (b"FC3 124", b"FC3 198", b"FC3 376")
    anonymous = "its registers hold no serial number that is known"
    stranger_says = "has no register 00F8h"

    @contextmanager
    def _served(
        self, faults: CountedFaults, identity: tuple[str, str, str, str] | None
    ) -> Iterator[SimulatedService]:
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
                "communication_timeout_ms": 10_000,  # longer than PATIENT_S
            }
            yield service


def stranger_to_registers(address: int, count: int, by: str) -> Sequence[int]:
    """A Modbus slave without any of them."""
    raise ModbusError(ILLEGAL_ADDRESS)


# --- a force sensor on a serial line ---------------------------------------------------------


class AmplifierCase(CoreCase):
    """The GSV-8."""

    stranger_says = "model number 06, serial 00000077"  # it gives no name

    def __init__(self) -> None:
        streams = "it ends a stream whose frames and answers are dropped, its own among them"
        super().__init__("me-gsv8", Gsv8, {}, silent_first_request=streams)
        self.name = "gsv8-serial"

    def disguise(self, core: Any, identity: tuple[str, str, str, str]) -> None:
        """Give it the model number of another amplifier."""
        own = core.amplifier.identity
        own.model_number, own.serial_number = 0x06, identity[2].zfill(8)


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
