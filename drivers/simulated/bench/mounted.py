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
    STAGE_TIMEOUT_S,
    X_REACH_MM,
    Z_REACH_MM,
    Endpoints,
    ROTARY_REACH_deg,
)
from drivers.simulated.bench.options import (
    HEAD,
    USUAL_FORCE_SENSOR,
    Options,
    Stages,
    drive_kind,
    simulator_of,
)
from drivers.simulated.faults.plan import DAQ, FORCE_SENSOR, GENERATOR, ROTARY, STAGES, Placed
from rig.core.errors import ConfigurationError

if TYPE_CHECKING:
    from drivers.simulated.faults.plan import ConverterFault, FaultPlan
    from drivers.simulated.faults.wire import WireDialect, WireFaults
    from drivers.simulated.instruments.core import (
        InstrumentCore,
        LinearStageCore,
        RotaryStageCore,
    )
    from drivers.simulated.instruments.festo_cmmt import CmmtDrive
    from drivers.simulated.instruments.force_sensor import ForceSensorCore
    from drivers.simulated.instruments.keysight_u2300a import KeysightU2300A
    from drivers.simulated.instruments.oriental_az import AzDrive
    from drivers.simulated.instruments.zaber_rst import SimulatedRotaryStage
    from drivers.simulated.transports.scpi_servers import HislipServer, ScpiSocketServer
    from drivers.simulated.transports.serial_server import PtyServer
    from drivers.simulated.transports.serial_tcp import InstrumentTcpServer
    from drivers.simulated.world.contact_geometry import Where
    from drivers.simulated.world.monitor import Monitor, WatchSettings
    from drivers.simulated.world.world import World

    Drive = CmmtDrive | AzDrive | LinearStageCore


FILM_WIRED = {"load_cell": 101, "film": 102}
STRIPS_WIRED = {"strip_1": 101, "strip_2": 102}
"""Wiring of the World's terminals."""
LIMITS = {
    "stage_z": (0.0, Z_REACH_MM),
    "stage_x": (0.0, X_REACH_MM),
    ROTARY: (0.0, ROTARY_REACH_deg),
}
"""Ranges of the stages, in mm and deg."""

AZ_LINE = "stages"
"""The serial line of the AZ pair, whose units are z and x in this order."""


ANY_PORT = 502
"""Stands for the drive's port in a bench file that is only recorded."""
ANY_PLACE = "socket://127.0.0.1:0"
"""Stands there for the place of an instrument on TCP that has a core."""

ROTARY_START_deg = 8.0
"""Angle of the rotary stage when it is switched on."""


class Instruments:
    """The instruments of the bench, wired to its World, behind servers that do not listen yet."""

    def __init__(self, world: World, options: Options, faults: FaultPlan):
        from drivers.simulated.faults.plan import ConverterFault, TimedFault
        from drivers.simulated.faults.wire import WireFaults

        def wire(device: str, dialect: WireDialect) -> WireFaults:
            log = partial(world.log, device, "injected", by="plan")
            return WireFaults(faults, device, dialect, log, world)

        self._world, self._options, self._faults, self._wire = world, options, faults, wire
        self._skin = options.fixture != "film-clamp"
        self._link = world.settings.generator_link
        self.serial: list[PtyServer | InstrumentTcpServer] = []
        """Servers that must follow the time by themselves once it has no owner any more."""
        self._own: dict[str, tuple[InstrumentCore, PtyServer | InstrumentTcpServer]] = {}
        """Simulators of other packages with their servers, by role."""
        self.generator = None if self._skin else self._make_generator()
        self.converter: KeysightU2300A | None = None
        """The DAQ that converts while time passes; None for one of another package."""
        self.daq = self._make_daq()
        self.rotary = self._make_rotary() if options.fixture == HEAD else None
        self.turning = None if self.rotary is None else self._serve_rotary(self.rotary)
        turned = None if self.rotary is None else self.rotary.angles_deg
        mount = partial(_skin_drives, turned) if self._skin else _clamp_drives
        self.drives = mount(world, self._make_drive)
        self.stages = self._serve_stages()
        self.sensor_driver = options.replace.get(FORCE_SENSOR, USUAL_FORCE_SENSOR)
        self.sensor = sensor = _force_sensor(world, self.sensor_driver)
        _refuse_impossible(sensor, self.sensor_driver, FORCE_SENSOR, faults.of(ConverterFault))
        self.force = self._serve_sensor(sensor)

        def disturb(fault: TimedFault, t_us: int) -> None:
            assert isinstance(fault, ConverterFault), "the World keeps the others to itself"
            sensor.disturb(fault.kind, t_us * 1e-6, **_keys_of(fault))

        world.on_fault(FORCE_SENSOR, disturb)
        self.serial.append(self.force)

    # --- simulators of other packages ---------------------------------------------------------

    def _replacement(self, role: str, planned: tuple[Any, ...]) -> Any:
        """Return the core that takes the place of the usual instrument in a role, put behind its
        server; None where none does."""
        if role not in self._options.replace:
            return None
        driver = self._options.replace[role]
        make: Any = simulator_of(role, driver)
        if role in LIMITS:  # a stage, whose faults are its own affair
            core = make(self._world, self._world, role, planned)
            core.limits = LIMITS[role]
        else:
            core = make(self._world, self._world, role)
        _refuse_impossible(core, driver, role, planned)
        server = _server_of(core, self._world, self._options.slaved, role, self._wire)
        self._own[role] = core, server
        self.serial.append(server)
        return core

    def _make_generator(self) -> Any:
        """Return the server of the generator."""
        from drivers.simulated.transports.scpi_servers import SCPI_DIALECT

        if self._replacement(GENERATOR, ()) is not None:
            return self._own[GENERATOR][1]
        return _generator(self._world, self._wire(GENERATOR, SCPI_DIALECT))

    def _make_daq(self) -> Any:
        """Return the server of the DAQ."""
        from drivers.simulated.faults.plan import Overrun
        from drivers.simulated.transports.scpi_servers import SCPI_DIALECT, HislipServer

        world, settings = self._world, self._world.settings
        core = self._replacement(DAQ, self._faults.of(Overrun, DAQ))
        if core is not None:
            world.on_fault(DAQ, lambda fault, t_us: core.disturb(fault.kind, t_us * 1e-6))
            return self._own[DAQ][1]
        from drivers.simulated.instruments.keysight_u2300a import KeysightU2300A

        samples = settings.daq_buffer_samples
        daq = KeysightU2300A(settings.daq_model, world, world, buffer_samples=samples)
        self.converter = daq
        world.on_fault(DAQ, lambda fault, t_us: daq.overrun())
        return HislipServer(daq, faults=self._wire(DAQ, SCPI_DIALECT))

    def _make_rotary(self) -> SimulatedRotaryStage | RotaryStageCore:
        from drivers.simulated.faults.plan import RotaryFault

        planned: tuple[Any, ...] = self._faults.of(RotaryFault, ROTARY)
        core: RotaryStageCore | None = self._replacement(ROTARY, planned)
        return _rotary(self._world, self._faults) if core is None else core

    def _serve_rotary(
        self, rotary: SimulatedRotaryStage | RotaryStageCore
    ) -> PtyServer | InstrumentTcpServer:
        from drivers.simulated.instruments.zaber_rst import ZABER_DIALECT, SimulatedRotaryStage
        from drivers.simulated.transports.serial_server import PtyServer

        if not isinstance(rotary, SimulatedRotaryStage):
            return self._own[ROTARY][1]
        server = PtyServer(
            rotary.line(),
            self._world,
            slaved=self._options.slaved,
            faults=self._wire(ROTARY, ZABER_DIALECT),
            name=ROTARY,
        )
        self.serial.append(server)
        return server

    def _make_drive(self, name: str) -> Drive:
        """Return the drive of a stage."""
        from drivers.simulated.faults.plan import MoveFault

        planned: tuple[Any, ...] = self._faults.of(MoveFault, name)
        core: LinearStageCore | None = self._replacement(name, planned)
        if core is not None:
            return core
        return _drive(self._options.stages, self._world, self._faults, self._skin, name)

    # --- servers ------------------------------------------------------------------------------

    def _serve_stages(self) -> dict[str, Any]:
        """Return the server of each stage, by its name: one each, or their common line."""
        from drivers.simulated.instruments.festo_cmmt import CmmtDrive
        from drivers.simulated.instruments.oriental_az import AzDrive
        from drivers.simulated.transports.modbus_rtu import RTU_DIALECT, RtuLine
        from drivers.simulated.transports.modbus_tcp import MODBUS_DIALECT, ModbusTcpServer
        from drivers.simulated.transports.serial_server import PtyServer

        servers: dict[str, Any] = {}
        on_line = [drive for drive in self.drives if isinstance(drive, AzDrive)]
        line: Any = None
        if on_line:
            line = PtyServer(
                RtuLine(on_line, self._world),
                self._world,
                slaved=self._options.slaved,
                faults={drive.name: self._wire(drive.name, RTU_DIALECT) for drive in on_line},
                name=AZ_LINE,
            )
            self.serial.append(line)
        for drive in self.drives:
            if isinstance(drive, AzDrive):
                servers[drive.name] = line
            elif isinstance(drive, CmmtDrive):
                name = drive.settings.name
                servers[name] = ModbusTcpServer(drive, faults=self._wire(name, MODBUS_DIALECT))
            else:
                servers[drive.name] = self._own[drive.name][1]
        return servers

    def _serve_sensor(self, sensor: ForceSensorCore) -> PtyServer | InstrumentTcpServer:
        """Return the server of the force sensor; its frames are watched where the World's settings
        ask for that and the monitor knows them."""
        from drivers.simulated.faults.plan import FORCE_STREAM
        from drivers.simulated.instruments.me_gsv8 import Gsv8
        from drivers.simulated.world.monitor import WatchedLine

        line: Any = sensor
        if self._world.settings.watch is not None and isinstance(sensor, Gsv8):
            line = WatchedLine(sensor, partial(self._world.log, FORCE_SENSOR, by="monitor"))
        return _server_of(
            sensor,
            self._world,
            self._options.slaved,
            FORCE_SENSOR,
            self._wire,
            line,
            self._wire(FORCE_STREAM, sensor.wire_dialect()),
        )

    def monitor(self, settings: WatchSettings | None) -> Monitor | None:
        """Return the World's monitor of the bench, if it is asked for."""
        from drivers.simulated.world.monitor import Monitor

        if settings is None:
            return None
        log = partial(self._world.log, "world", by="monitor")
        places = {_name_of(drive): drive.positions_mm for drive in self.drives}
        if self.rotary is not None:
            places[ROTARY] = self.rotary.angles_deg
        return Monitor(settings, self._world.pressed_N, self._active, log, places)

    def _active(self) -> Iterator[str]:
        """Return the names of what moves or is driven now."""
        now_us = self._world.now_us
        for drive in self.drives:
            speed = drive.velocity_mm_s(now_us)
            if speed:
                yield f"{_name_of(drive)} moves at {speed:.3g} mm/s"
        if self.rotary is not None and (speed := self.rotary.speed_deg_s(now_us)):
            yield f"rotary turns at {speed:.3g} deg/s"
        if self.generator is not None and self._world.driven:
            yield "generator drives the vibrator"

    @property
    def servers(self) -> list[Any]:
        """All of them, in the order in which they start."""
        each = [self.generator, self.daq, *self.stages.values(), self.turning, self.force]
        return list(dict.fromkeys(server for server in each if server is not None))

    @property
    def models(self) -> dict[str, str]:
        """Maker and model of each simulated instrument, by role."""
        from drivers.simulated.instruments.oriental_az import AzDrive

        models = {DAQ: f"Keysight {self._world.settings.daq_model}"}
        if self.generator is not None:
            models[GENERATOR] = "Keysight 33500B"
        if self.rotary is not None:
            models[ROTARY] = "Zaber X-RST"
        for drive in self.drives:
            az = isinstance(drive, AzDrive)
            models[_name_of(drive)] = "Oriental Motor AZ" if az else "Festo CMMT"
        models[FORCE_SENSOR] = self.sensor.title or self.sensor_driver
        own = {role: core.title for role, (core, _) in self._own.items()}
        return {**models, **{r: title or self._options.replace[r] for r, title in own.items()}}

    def listening(self) -> Endpoints:
        """Return the addresses at which the instruments listen."""
        generator = getattr(self.generator, "port", 0)
        stages = {n: getattr(one, "port", None) or one.path for n, one in self.stages.items()}
        rotary = getattr(self.turning, "path", "")
        places = {role: place_of(server) for role, (_, server) in self._own.items()}
        daq = getattr(self.daq, "port", 0)
        return self._endpoints(generator, daq, stages, place_of(self.force), rotary, places)

    def anywhere(self) -> Endpoints:
        """Return the same without this process's port numbers, for a text that is only recorded."""
        stages = {n: ANY_PORT if hasattr(s, "port") else AZ_LINE for n, s in self.stages.items()}
        own = {role: server for role, (_, server) in self._own.items()} | {FORCE_SENSOR: self.force}
        places = {role: ANY_PLACE if hasattr(s, "port") else role for role, s in own.items()}
        return self._endpoints(0, 0, stages, places.pop(FORCE_SENSOR), ROTARY, places)

    def _endpoints(
        self,
        generator: int,
        daq: int,
        stages: dict[str, int | str],
        force: str,
        rotary: str,
        places: dict[str, str],
    ) -> Endpoints:
        by_link = {
            "socket": f"TCPIP::127.0.0.1::{generator}::SOCKET",
            "hislip": f"TCPIP::127.0.0.1::hislip0,{generator}::INSTR",
        }
        own = {
            role: _table(self._options.replace[role], core, places[role], self._skin)
            for role, (core, _) in self._own.items()
        }
        own[FORCE_SENSOR] = _table(self.sensor_driver, self.sensor, force, self._skin)
        return Endpoints(
            daq=f"TCPIP::127.0.0.1::hislip0,{daq}::INSTR",
            stages=stages,
            own=own,
            generator=by_link[self._link],
            rotary=rotary,
        )


def _table(driver: str, core: InstrumentCore, where: str, skin: bool) -> dict[str, Any]:
    """Return the table of a bench file for an instrument that has a core."""
    stage = any(role in STAGES for role in core.roles)
    timeout_s = STAGE_TIMEOUT_S if stage else LINK_TIMEOUT_S
    table = {"driver": driver, **core.bench_settings(where), "timeout_s": timeout_s}
    if DAQ in core.roles:
        wired = STRIPS_WIRED if skin else FILM_WIRED
        table["channels"] = {name: core.channel(one) for name, one in wired.items()}  # type: ignore[attr-defined]
    return table


def _name_of(drive: Any) -> str:
    """Return the role that a simulated drive plays."""
    return str(getattr(drive, "name", None) or drive.settings.name)


def _server_of(
    core: InstrumentCore,
    world: World,
    slaved: bool,
    name: str,
    wire: Callable[[str, WireDialect], WireFaults],
    line: Any = None,
    stream_faults: WireFaults | None = None,
) -> PtyServer | InstrumentTcpServer:
    """Return the server of a core's link; `line` is served in its place where something has to hear
    what it says."""
    from drivers.simulated.transports.serial_server import PtyServer
    from drivers.simulated.transports.serial_tcp import InstrumentTcpServer

    faults, served = wire(name, core.wire_dialect()), core if line is None else line
    if core.link == "tcp":
        return InstrumentTcpServer(served, world, slaved, faults, stream_faults)
    return PtyServer(served, world, slaved, faults, stream_faults, name=name)


def place_of(server: PtyServer | InstrumentTcpServer) -> str:
    """Return where an instrument is served, as its core's `bench_settings` takes it."""
    port = getattr(server, "port", None)
    return server.path if port is None else f"socket://127.0.0.1:{port}"  # type: ignore[union-attr]


def _force_sensor(world: World, driver: str) -> ForceSensorCore:
    """Return the simulator that is registered for a driver, in the World."""
    from drivers.simulated.instruments.gsv8_converter import Sensor
    from drivers.simulated.instruments.me_gsv8 import Gsv8

    make: Any = simulator_of(FORCE_SENSOR, driver)
    made = make(world, world, FORCE_SENSOR)
    if isinstance(made, Gsv8):
        made.sensor = Sensor(zero_mV_V=world.settings.force_sensor_zero_mV_V)
    sensor: ForceSensorCore = made
    return sensor


def _keys_of(fault: ConverterFault) -> dict[str, Any]:
    """Return the keys of a fault beyond its kind and moment, as `disturb` of a core takes them."""
    own = type(fault).model_fields.keys() - Placed.model_fields.keys() - {"kind"}
    return {key: getattr(fault, key) for key in sorted(own)}


def _refuse_impossible(
    core: InstrumentCore, driver: str, role: str, faults: tuple[Any, ...]
) -> None:
    """Raise ConfigurationError for a fault that the simulator of its instrument does not have."""
    for fault in faults:
        if fault.device == role and fault.kind not in core.disturbances:
            can = ", ".join(core.disturbances) or "none"
            raise ConfigurationError(
                f"the fault plan has a fault of kind {fault.kind} for the {role}, which "
                f"the simulator of {driver!r} does not have (it has: {can})",
                "leave that fault out of the plan",
            )


def _drive(
    stages: Stages, world: World, faults: FaultPlan, fine: bool, name: str
) -> CmmtDrive | AzDrive:
    make = _az_drive if drive_kind(stages, name) == "az" else _cmmt_drive
    return make(world, faults, fine, name)


def _cmmt_drive(world: World, faults: FaultPlan, fine: bool, name: str) -> CmmtDrive:
    from drivers.simulated.faults.plan import STAGE_Z, MoveFault
    from drivers.simulated.instruments.cmmt_settings import SimulatedCmmtSettings
    from drivers.simulated.instruments.festo_cmmt import CmmtDrive

    serial = "SIMZ1" if name == STAGE_Z else "SIMX1"
    own = SimulatedCmmtSettings(name, serial=serial, faults=faults.of(MoveFault, name))
    return CmmtDrive(replace(own, position_unit_mm=SKIN_UNIT_MM) if fine else own, world)


def _az_drive(world: World, faults: FaultPlan, fine: bool, name: str) -> AzDrive:
    from drivers.simulated.faults.plan import STAGES, MoveFault
    from drivers.simulated.instruments.oriental_az import AzDrive, SimulatedAzSettings

    unit_id = STAGES.index(name) + 1
    own = SimulatedAzSettings(name, unit_id, AZ_STEPS_PER_MM, faults=faults.of(MoveFault, name))
    return AzDrive(own, world)


def _clamp_drives(world: World, make_drive: Callable[[str], Drive]) -> list[Drive]:
    """Return the z stage, with the vibrator on it above the film."""
    from drivers.simulated.faults.plan import STAGE_Z

    clamp = world.settings.clamp
    z = make_drive(STAGE_Z)
    z.axis.stiffest_load_N_mm = clamp.stiffness_N_mm + clamp.creep_stiffness_N_mm
    world.mount(z.positions_mm)
    return [z]


def _rotary(world: World, faults: FaultPlan) -> SimulatedRotaryStage:
    """Return the rotary stage, which carries the head."""
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
    turned_deg: Where | None, world: World, make_drive: Callable[[str], Drive]
) -> list[Drive]:
    """Return the z and the x stage, with the skin on them above the plate or the head that is
    turned."""
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
