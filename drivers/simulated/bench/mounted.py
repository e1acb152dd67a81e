"""Builds the instruments of a simulated bench, wired to one World, each behind its server."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from drivers.simulated.bench.bench_file import (
    AZ_STEPS_PER_MM,
    LINK_TIMEOUT_S,
    SKIN_UNIT_MM,
    Endpoints,
)
from drivers.simulated.bench.options import (
    HEAD,
    USUAL_FORCE_SENSOR,
    Options,
    Stages,
    drive_kind,
)
from drivers.simulated.faults.plan import FORCE_SENSOR, Placed
from rig.core.entry_points import SIMULATORS, load
from rig.core.errors import ConfigurationError

if TYPE_CHECKING:
    from drivers.simulated.faults.plan import ConverterFault, FaultPlan
    from drivers.simulated.faults.wire import WireDialect, WireFaults
    from drivers.simulated.instruments.festo_cmmt import CmmtDrive
    from drivers.simulated.instruments.force_sensor import ForceSensorCore
    from drivers.simulated.instruments.oriental_az import AzDrive
    from drivers.simulated.instruments.zaber_rst import SimulatedRotaryStage
    from drivers.simulated.transports.scpi_servers import HislipServer, ScpiSocketServer
    from drivers.simulated.transports.serial_server import PtyServer
    from drivers.simulated.transports.serial_tcp import InstrumentTcpServer
    from drivers.simulated.world.contact_geometry import Where
    from drivers.simulated.world.monitor import Monitor, WatchSettings
    from drivers.simulated.world.world import World


AZ_LINE = "stages"
"""The serial line of the AZ pair, whose units are z and x in this order."""


ANY_PORT = 502
"""Stands for the drive's port in a bench file that is only recorded."""

ROTARY_START_deg = 8.0
"""Angle of the rotary stage when it is switched on."""


class Instruments:
    """The instruments of the bench, wired to its World, behind servers that do not listen yet."""

    def __init__(self, world: World, options: Options, faults: FaultPlan):
        from drivers.simulated.faults.plan import (
            DAQ,
            FORCE_STREAM,
            GENERATOR,
            ROTARY,
            ConverterFault,
            TimedFault,
        )
        from drivers.simulated.faults.wire import WireFaults
        from drivers.simulated.instruments.keysight_u2300a import KeysightU2300A
        from drivers.simulated.instruments.zaber_rst import ZABER_DIALECT
        from drivers.simulated.transports.scpi_servers import SCPI_DIALECT, HislipServer
        from drivers.simulated.transports.serial_server import PtyServer

        def wire(device: str, dialect: WireDialect) -> WireFaults:
            tell = partial(world.log, device, "injected", by="plan")
            return WireFaults(faults, device, dialect, tell, world)

        self._world = world
        settings = world.settings
        skin = options.fixture != "film-clamp"
        self._link = settings.generator_link
        self.generator = None if skin else _generator(world, wire(GENERATOR, SCPI_DIALECT))
        daq = KeysightU2300A(
            settings.daq_model, world, world, buffer_samples=settings.daq_buffer_samples
        )
        self.daq = HislipServer(daq, faults=wire(DAQ, SCPI_DIALECT))
        world.on_fault(DAQ, lambda fault, t_us: daq.overrun())
        self.serial: list[PtyServer | InstrumentTcpServer] = []
        """Servers that must follow the time by themselves once it has no owner any more."""
        self.rotary = _rotary(world, faults) if options.fixture == HEAD else None
        self.turning: PtyServer | None = None
        if self.rotary is not None:
            self.turning = PtyServer(
                self.rotary.line(),
                world,
                slaved=options.slaved,
                faults=wire(ROTARY, ZABER_DIALECT),
                name=ROTARY,
            )
            self.serial.append(self.turning)
        turned = None if self.rotary is None else self.rotary.angles_deg
        mount = partial(_skin_drives, turned) if skin else _clamp_drives
        self.drives = mount(world, partial(_drive, options.stages, world, faults, skin))
        self.stages = self._serve_stages(options, wire)
        self.sensor_driver = options.replace.get(FORCE_SENSOR, USUAL_FORCE_SENSOR)
        self.sensor = sensor = _force_sensor(world, self.sensor_driver)
        _refuse_impossible(sensor, self.sensor_driver, faults.of(ConverterFault, FORCE_SENSOR))
        dialect = sensor.wire_dialect()
        self.force = _serve_sensor(
            sensor, world, options.slaved, wire(FORCE_SENSOR, dialect), wire(FORCE_STREAM, dialect)
        )

        def disturb(fault: TimedFault, t_us: int) -> None:
            assert isinstance(fault, ConverterFault), "the World keeps the others to itself"
            sensor.disturb(fault.kind, t_us * 1e-6, **_keys_of(fault))

        world.on_fault(FORCE_SENSOR, disturb)
        self.serial.append(self.force)

    def _serve_stages(
        self, options: Options, wire: Callable[[str, WireDialect], WireFaults]
    ) -> list[Any]:
        """Create the servers of z and x: one each, or their common line."""
        from drivers.simulated.instruments.oriental_az import AzDrive
        from drivers.simulated.transports.modbus_rtu import RTU_DIALECT, RtuLine
        from drivers.simulated.transports.modbus_tcp import MODBUS_DIALECT, ModbusTcpServer
        from drivers.simulated.transports.serial_server import PtyServer

        servers: list[Any] = [
            ModbusTcpServer(drive, faults=wire(drive.settings.name, MODBUS_DIALECT))
            for drive in self.drives
            if not isinstance(drive, AzDrive)
        ]
        if on_line := [drive for drive in self.drives if isinstance(drive, AzDrive)]:
            line = PtyServer(
                RtuLine(on_line, self._world),
                self._world,
                slaved=options.slaved,
                faults={drive.name: wire(drive.name, RTU_DIALECT) for drive in on_line},
                name=AZ_LINE,
            )
            self.serial.append(line)
            first = isinstance(self.drives[0], AzDrive)
            servers.insert(0 if first else len(servers), line)
        return servers

    def monitor(self, settings: WatchSettings | None) -> Monitor | None:
        """The World's monitor of the bench, if it is asked for."""
        from drivers.simulated.world.monitor import Monitor

        if settings is None:
            return None
        tell = partial(self._world.log, "world", by="monitor")
        return Monitor(settings, self._world.pressed_N, self._active, tell)

    def _active(self) -> Iterator[str]:
        """Return the names of what moves or is driven now."""
        now_us = self._world.now_us
        for drive in self.drives:
            speed = drive.velocity_mm_s(now_us)
            if speed:
                yield f"{drive.settings.name} moves at {speed:.3g} mm/s"
        if self.rotary is not None and (speed := self.rotary.speed_deg_s(now_us)):
            yield f"rotary turns at {speed:.3g} deg/s"
        if self.generator is not None and self._world.driven:
            yield "generator drives the vibrator"

    @property
    def servers(self) -> list[Any]:
        """All of them, in the order in which they start."""
        first = [] if self.generator is None else [self.generator]
        last = [] if self.turning is None else [self.turning]
        return [*first, self.daq, *self.stages, *last, self.force]

    @property
    def models(self) -> dict[str, str]:
        """Maker and model of each simulated instrument, by role."""
        from drivers.simulated.instruments.oriental_az import AzDrive

        models = {"daq": f"Keysight {self._world.settings.daq_model}"}
        if self.generator is not None:
            models["generator"] = "Keysight 33500B"
        if self.rotary is not None:
            models["rotary"] = "Zaber X-RST"
        for drive in self.drives:
            az = isinstance(drive, AzDrive)
            models[drive.settings.name] = "Oriental Motor AZ" if az else "Festo CMMT"
        return {**models, FORCE_SENSOR: self.sensor.title or self.sensor_driver}

    def listening(self) -> Endpoints:
        """Return the addresses at which the instruments listen."""
        generator = 0 if self.generator is None else self.generator.port
        stages = [getattr(stage, "port", None) or stage.path for stage in self.stages]
        rotary = "" if self.turning is None else self.turning.path
        return self._endpoints(generator, self.daq.port, stages, place_of(self.force), rotary)

    def anywhere(self) -> Endpoints:
        """The same without this process's port numbers, for a text that is only recorded."""
        stages = [ANY_PORT if hasattr(stage, "port") else AZ_LINE for stage in self.stages]
        return self._endpoints(0, 0, stages, FORCE_SENSOR, "rotary")

    def _endpoints(
        self, generator: int, daq: int, stages: list[int | str], force: str, rotary: str
    ) -> Endpoints:
        by_link = {
            "socket": f"TCPIP::127.0.0.1::{generator}::SOCKET",
            "hislip": f"TCPIP::127.0.0.1::hislip0,{generator}::INSTR",
        }
        return Endpoints(
            daq=f"TCPIP::127.0.0.1::hislip0,{daq}::INSTR",
            stages=(stages[0], stages[-1]),
            force_sensor={
                "driver": self.sensor_driver,
                **self.sensor.bench_settings(force),
                "timeout_s": LINK_TIMEOUT_S,
            },
            generator=by_link[self._link],
            rotary=rotary,
        )


def place_of(server: PtyServer | InstrumentTcpServer) -> str:
    """Return where a force sensor is served, as its core's `bench_settings` takes it."""
    port = getattr(server, "port", None)
    return server.path if port is None else f"socket://127.0.0.1:{port}"  # type: ignore[union-attr]


def _force_sensor(world: World, driver: str) -> ForceSensorCore:
    """The simulator that is registered for a driver, in the World."""
    from drivers.simulated.instruments.me_gsv8 import Gsv8, Sensor

    made: ForceSensorCore = load(SIMULATORS, driver)(world, world, FORCE_SENSOR)
    if isinstance(made, Gsv8):
        made.sensor = Sensor(zero_mV_V=world.settings.force_sensor_zero_mV_V)
    return made


def _keys_of(fault: ConverterFault) -> dict[str, Any]:
    """The keys of a fault beyond its kind and moment, as `disturb` of a core takes them."""
    own = type(fault).model_fields.keys() - Placed.model_fields.keys() - {"kind"}
    return {key: getattr(fault, key) for key in sorted(own)}


def _refuse_impossible(
    sensor: ForceSensorCore, driver: str, faults: tuple[ConverterFault, ...]
) -> None:
    """ConfigurationError where a fault plan disturbs a sensor as its simulator cannot be."""
    for fault in faults:
        if fault.kind not in sensor.disturbances:
            can = ", ".join(sensor.disturbances) or "none"
            raise ConfigurationError(
                f"the fault plan has a fault of kind {fault.kind} for the {FORCE_SENSOR}, which "
                f"the simulator of {driver!r} does not have (it has: {can})",
                "leave that fault out of the plan",
            )


def _serve_sensor(
    sensor: ForceSensorCore,
    world: World,
    slaved: bool,
    faults: WireFaults,
    stream_faults: WireFaults,
) -> PtyServer | InstrumentTcpServer:
    """Create the server of a force sensor's link. Its frames are watched if the World's settings
    ask for it and the monitor knows them."""
    from drivers.simulated.instruments.me_gsv8 import Gsv8
    from drivers.simulated.transports.serial_server import PtyServer
    from drivers.simulated.transports.serial_tcp import InstrumentTcpServer
    from drivers.simulated.world.monitor import WatchedLine

    line: ForceSensorCore | WatchedLine = sensor
    if world.settings.watch is not None and isinstance(sensor, Gsv8):
        line = WatchedLine(sensor, partial(world.log, FORCE_SENSOR, by="monitor"))
    if sensor.link == "tcp":
        return InstrumentTcpServer(line, world, slaved, faults, stream_faults)
    return PtyServer(line, world, slaved, faults, stream_faults, name=FORCE_SENSOR)


def _drive(
    stages: Stages, world: World, faults: FaultPlan, fine: bool, name: str
) -> CmmtDrive | AzDrive:
    make = _az_drive if drive_kind(stages, name) == "az" else _cmmt_drive
    return make(world, faults, fine, name)


def _cmmt_drive(world: World, faults: FaultPlan, fine: bool, name: str) -> CmmtDrive:
    from drivers.simulated.faults.plan import STAGE_Z, MoveFault
    from drivers.simulated.instruments.festo_cmmt import CmmtDrive, SimulatedCmmtSettings

    serial = "SIMZ1" if name == STAGE_Z else "SIMX1"
    own = SimulatedCmmtSettings(name, serial=serial, faults=faults.of(MoveFault, name))
    return CmmtDrive(replace(own, position_unit_mm=SKIN_UNIT_MM) if fine else own, world)


def _az_drive(world: World, faults: FaultPlan, fine: bool, name: str) -> AzDrive:
    from drivers.simulated.faults.plan import STAGES, MoveFault
    from drivers.simulated.instruments.oriental_az import AzDrive, SimulatedAzSettings

    unit_id = STAGES.index(name) + 1
    own = SimulatedAzSettings(name, unit_id, AZ_STEPS_PER_MM, faults=faults.of(MoveFault, name))
    return AzDrive(own, world)


def _clamp_drives(
    world: World, make_drive: Callable[[str], CmmtDrive | AzDrive]
) -> list[CmmtDrive | AzDrive]:
    """The z stage, with the vibrator on it above the film."""
    from drivers.simulated.faults.plan import STAGE_Z

    clamp = world.settings.clamp
    z = make_drive(STAGE_Z)
    z.axis.stiffest_load_N_mm = clamp.stiffness_N_mm + clamp.creep_stiffness_N_mm
    world.mount(z.positions_mm)
    return [z]


def _rotary(world: World, faults: FaultPlan) -> SimulatedRotaryStage:
    """The rotary stage, which carries the head."""
    from drivers.simulated.faults.plan import ROTARY, RotaryFault
    from drivers.simulated.instruments.zaber_rst import (
        SimulatedRotarySettings,
        SimulatedRotaryStage,
    )

    own = SimulatedRotarySettings(
        ROTARY, start_deg=ROTARY_START_deg, faults=faults.of(RotaryFault, ROTARY)
    )
    return SimulatedRotaryStage(own, world)


def _skin_drives(
    turned_deg: Where | None, world: World, make_drive: Callable[[str], CmmtDrive | AzDrive]
) -> list[CmmtDrive | AzDrive]:
    """The z and the x stage, with the skin on them above the plate or the head that is turned."""
    from drivers.simulated.faults.plan import STAGES
    from drivers.simulated.world.plate_world import PlateWorldSettings, mount_skin

    settings = world.settings
    assert isinstance(settings, PlateWorldSettings)
    drives = [make_drive(name) for name in STAGES]
    z, x = drives
    stiffness = mount_skin(world, settings, z, x, turned_deg)
    for drive in drives:
        drive.axis.stiffest_load_N_mm = stiffness
    if turned_deg is None and not settings.skin_mount.jitter_um:  # nothing else moves the load
        z.axis.other_axis, x.axis.other_axis = x.axis, z.axis
    return drives


def _generator(world: World, faults: WireFaults) -> HislipServer | ScpiSocketServer:
    from drivers.simulated.instruments.keysight_33500b import Keysight33500B
    from drivers.simulated.transports.scpi_servers import HislipServer, ScpiSocketServer

    hislip = world.settings.generator_link == "hislip"
    server_class = HislipServer if hislip else ScpiSocketServer
    return server_class(Keysight33500B(world, world), faults=faults)
