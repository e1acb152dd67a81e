"""The simulated bench as a process: one World, its instruments' servers, its control socket.

Entry point ``simulated`` of group ``rig.benches``. `serve` runs the bench here until it is stopped
(``rig simulate``); `start` runs it as a process of its own with its time slaved to the caller,
which is what a run without a bench file does. Both end up in the same few lines: there is no other
way to be a simulated bench.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from rig.documents import toml_value
from rig.errors import ConfigurationError, InstrumentError, RigError
from rig.imports import importing
from rig.processor import Turns, let_run_anywhere

if TYPE_CHECKING:
    from drivers.simulated.disk_faults import FaultyDisk
    from drivers.simulated.fault_plan import FaultPlan
    from drivers.simulated.faults import Dialect, WireFaults
    from drivers.simulated.festo_cmmt import CmmtDrive
    from drivers.simulated.meeting import Where
    from drivers.simulated.monitor import Monitor, WatchSettings
    from drivers.simulated.oriental_az import AzDrive
    from drivers.simulated.serial_server import PtyServer
    from drivers.simulated.servers import HislipServer, ScpiSocketServer
    from drivers.simulated.world import World, WorldSettings
    from drivers.simulated.zaber_rst import RotaryStage

LINGER_S = 10.0
"""How long a bench whose owner died goes on in real time: time for the guard to come and act."""

ABANDONED_S = 0.5
"""How long a bench that nobody has connected to may take to end by itself."""

Fixture = Literal["film-clamp", "plate", "semi-spherical-object"]
HEAD: Fixture = "semi-spherical-object"
Stages = Literal["festo", "az", "festo-az", "az-festo"]
"""Drives on Modbus TCP, on one Modbus RTU line, or z of the first kind and x of the second."""


@dataclass(frozen=True)
class Options:
    """How to run the bench."""

    fixture: Fixture = "film-clamp"
    """What is mounted: the film in its clamp, or the skin above a plate or a head that rolls."""
    stages: Stages = "festo"
    """What moves it."""
    seed: int = 0
    slaved: bool = False
    world: str | None = None
    """TOML file with World settings."""
    fault: str | None = None
    """TOML file with a fault plan."""
    world_log: str | None = None
    """File to which the World's log is appended."""
    linger_s: float = LINGER_S
    results: str | None = None
    """Folder in which the owner records: where the fault plan's disk is."""


FORCE_SENSOR = "force_sensor"

ANY_PORT = 502
"""Stands for the drive's port in a bench file that is only recorded."""

LINK_TIMEOUT_S = 1.5
"""Wall time the bench file gives every link: a loaded machine may let a process wait for long."""

AZ_STEPS_PER_MM = 3000.0
"""9000 steps a revolution at a lead of 3 mm (assumed): 0.33 um, a fine one of the series."""
AZ_LINE = "stages"
"""The serial line of the AZ pair, whose units are z and x in this order."""

SKIN_UNIT_MM = 0.0001
"""A count of the stages that carry the skin: 1 um would be 0.15 N of normal force (assumed)."""

ROTARY_START_deg, ROTARY_REACH_deg = 8.0, 30.0
"""Where the rotary stage stands when it is switched on, and how far it may turn."""

SETTLE_EVERY_S = 0.02
"""How often drives in real time look at what has befallen them."""


@dataclass(frozen=True)
class Endpoints:
    """Where the bench listens."""

    daq: str
    stages: tuple[int | str, ...]
    """Of z and x: ports of drives on TCP, or the serial line that both are on."""
    force_sensor: str
    generator: str = ""
    rotary: str = ""


def bench_toml(options: Options, world: dict[str, Any], endpoints: Endpoints) -> str:
    """The bench file that drives this bench."""
    from drivers.simulated.me_gsv8 import Sensor

    stages = {} if options.stages == "festo" else {"stages": options.stages}
    simulation = {"seed": options.seed, **stages, **world}
    lines = "".join(f"{key} = {toml_value(value)}\n" for key, value in simulation.items())
    own = _film_tables if options.fixture == "film-clamp" else _skin_tables
    return f"""# A simulated bench: whatever is measured on it is computed, not measured.
name = "simulated"

[simulation]
{lines}
[fixture]
mounted = "{options.fixture}"
contact_from_mm = 12.0
contact_to_mm = {13.6 if options.fixture == HEAD else 13.0}
{_head_lines(options)}
{own(options, endpoints)}
[force_sensor]
driver = "me-gsv8"
port = "{endpoints.force_sensor}"
timeout_s = {LINK_TIMEOUT_S}
nominal_force_N = 50.0
max_force_N = 40.0
matrix_N_mV_V = {json.dumps(Sensor().matrix)}
"""


def _head_lines(options: Options) -> str:
    """Where the head is, in the table of the fixture."""
    if options.fixture != HEAD:
        return ""
    from drivers.simulated.meeting import HeadSettings

    head = HeadSettings()
    return f"centre_mm = {head.centre_mm}\nupright_deg = {head.upright_deg}\n"


def _film_tables(options: Options, endpoints: Endpoints) -> str:
    return f"""[film]
name = "simulated film {options.seed}"
amplifier_gain = 1.0
area_mm2 = 8.0

[load_cell]
name = "simulated cell {options.seed}"
sensitivity_V_N = 0.1
max_load_N = 20.0

[generator]
driver = "keysight-33500b"
resource = "{endpoints.generator}"
timeout_s = {LINK_TIMEOUT_S}
max_amplitude_V = 10.0

[daq]
driver = "keysight-u2300a"
resource = "{endpoints.daq}"
timeout_s = {LINK_TIMEOUT_S}
channels = {{ load_cell = 101, film = 102 }}

{_stage_table(options, endpoints, "z", 14.0, 45.0)}"""


def _skin_tables(options: Options, endpoints: Endpoints) -> str:
    return f"""[skin]
name = "simulated skin {options.seed}"
amplifier_gain = 1000.0
ridge = 3

[daq]
driver = "keysight-u2300a"
resource = "{endpoints.daq}"
timeout_s = {LINK_TIMEOUT_S}
channels = {{ strip_1 = 101, strip_2 = 102 }}

{_stage_table(options, endpoints, "z", 14.0, 45.0)}
{_stage_table(options, endpoints, "x", 40.0, 30.0)}{_rotary_table(options, endpoints)}"""


def _rotary_table(options: Options, endpoints: Endpoints) -> str:
    if options.fixture != HEAD:
        return ""
    from drivers.simulated.zaber_rst import StageSettings

    return f"""
[rotary]
driver = "zaber-rst"
port = "{endpoints.rotary}"
timeout_s = {LINK_TIMEOUT_S}
microstep_deg = {StageSettings().microstep_deg}
low_limit_deg = 0.0
high_limit_deg = {ROTARY_REACH_deg}
max_speed_deg_s = 20.0
max_acceleration_deg_s2 = 500.0
"""


def _stage_table(
    options: Options, endpoints: Endpoints, axis: str, high_limit_mm: float, torque_percent: float
) -> str:
    number = "zx".index(axis)
    where = endpoints.stages[number]
    if _kind(options.stages, f"stage_{axis}") == "az":
        link = f"""driver = "oriental-az"
axis = "{axis}"
port = "{where}"
parity = "N"
unit_id = {number + 1}
steps_per_mm = {AZ_STEPS_PER_MM}
"""
    else:
        link = f"""driver = "festo-cmmt"
axis = "{axis}"
host = "127.0.0.1"
port = {where}
"""
        if options.fixture != "film-clamp":
            link += f"position_unit_mm = {SKIN_UNIT_MM}\n"
    return f"""[stage_{axis}]
{link}timeout_s = {LINK_TIMEOUT_S}
low_limit_mm = 0.0
high_limit_mm = {high_limit_mm}
max_speed_mm_s = 20.0
communication_timeout_ms = 1000
torque_limit_percent = {torque_percent}
"""


def _kind(stages: Stages, name: str) -> str:
    """Of the drive of one stage."""
    z, _, x = stages.partition("-")
    return z if name == "stage_z" or not x else x


class StartedBench:
    """A bench that was started as a process of its own, and how to drive it."""

    def __init__(self, options: Options):
        self._disk = _faulty_disk(options)
        if self._disk is not None:
            self._disk.install()
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "drivers.simulated.bench", json.dumps(asdict(options))],
            stdin=subprocess.PIPE,  # never written: its end tells the bench that we died
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,  # a terminal's Ctrl-C is the run's business, not the bench's
        )
        let_run_anywhere(self._process.pid)
        self._turns: Turns | None = None

    def ready(self) -> dict[str, Any]:
        """Wait until the bench listens: ``control_port``, ``bench_toml``, ``recorded_toml``."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        answer: dict[str, Any] = json.loads(line) if line else {}
        if "error" in answer:
            raise ConfigurationError(answer["error"], answer["hint"])
        if "control_port" not in answer:
            assert self._process.stderr is not None
            words = self._process.stderr.read().decode(errors="replace").strip().splitlines()
            raise InstrumentError(
                "simulated bench", "start", words[-1] if words else "the process ended at once"
            )
        self._turns = Turns(self._process.pid)
        return answer

    def wait(self, timeout_s: float = 5.0) -> None:
        """Wait for the process to end; one that does not is ended. With it end the faults of the
        disk."""
        if self._turns is not None:
            self._turns.close()
        if self._disk is not None:
            self._disk.remove()
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout, self._process.stderr):
            if pipe is not None:
                pipe.close()

    def abandon(self) -> None:
        """End the process, which nobody needs: it may still be making its skin."""
        self._process.terminate()
        self.wait(ABANDONED_S)


def start(options: dict[str, Any]) -> StartedBench:
    """Start a slaved bench; `options` are fields of `Options`. A fault plan's disk is this
    process's, until the bench has been waited for."""
    return StartedBench(Options(**{**options, "slaved": True}))


def serve(options: dict[str, Any], ready: Callable[[str], None]) -> None:
    """Run a bench here in real time until SIGINT or SIGTERM; `ready` gets the bench file's text."""
    asyncio.run(_serve(Options(**options), lambda said: ready(said["bench_toml"])))


async def _serve(options: Options, ready: Callable[[dict[str, Any]], None]) -> None:
    for asked, known in ((options.fixture, Fixture), (options.stages, Stages)):
        if asked not in get_args(known):
            raise ConfigurationError(
                f"the simulated bench has no {asked} to mount",
                f"it has {' and '.join(get_args(known))}",
            )
    with importing():
        from drivers.simulated.control import ControlServer
        from drivers.simulated.fault_plan import TimedFault
        from drivers.simulated.world import World

        settings = _read_world(options)
        faults = _read_faults(options)
        log = Path(options.world_log) if options.world_log else None
        world = World(settings, options.seed, options.slaved, log, faults.of(TimedFault))
        bench = _Instruments(world, options, faults)
    monitor = bench.monitor(settings.watch)
    ended = asyncio.Event()
    loop = asyncio.get_running_loop()

    def settle() -> None:
        for drive in bench.drives:
            drive.settle(world.now_us)
        if bench.rotary is not None:
            bench.rotary.settle(world.now_us)
        world.settle()

    def after_time_passed() -> None:
        settle()
        bench.force.pump()
        if monitor is not None:
            monitor.look(world.now_us)

    async def follow_real_time() -> None:
        while True:
            settle()
            if world.failure is not None:
                ended.set()
            await asyncio.sleep(SETTLE_EVERY_S)

    free: list[asyncio.Task[None]] = []

    def set_free() -> None:
        free.append(loop.create_task(follow_real_time()))

    def orphaned() -> None:
        if not world.timeline.slaved:
            return
        world.timeline.set_free()
        world.log("world", "owner-gone", None, "world")
        for server in bench.serial:
            server.set_free()
        set_free()
        loop.call_later(options.linger_s, ended.set)

    streams = {FORCE_SENSOR: lambda: bench.force.bytes_sent}
    control = ControlServer(world, streams, ended.set, orphaned, after_time_passed)
    if not options.slaved:
        set_free()
    for number in (signal.SIGTERM,) if options.slaved else (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, ended.set)
    try:
        for server in bench.servers:
            await server.start()
        port = await control.start()
        if options.slaved:  # its end is seen however early it was: what it sets free has started
            await loop.connect_read_pipe(lambda: _OwnersPipe(orphaned), sys.stdin)
        overrides = settings.model_dump(mode="json", exclude_unset=True)
        ready(
            {
                "control_port": port,
                "bench_toml": bench_toml(options, overrides, bench.listening()),
                "recorded_toml": bench_toml(options, overrides, bench.anywhere()),
            }
        )
        await ended.wait()
    finally:
        control.close()
        for task in free:
            task.cancel()
        for server in bench.servers:
            await server.close()
        settle()
        if monitor is not None:
            monitor.over()
        world.close()
    if world.failure is not None:
        raise InstrumentError("simulated bench", "contact", world.failure)


def _read_world(options: Options) -> WorldSettings:
    from drivers.simulated.world import read_world

    if options.fixture == "film-clamp":
        return read_world(options.world)
    from drivers.simulated.plate_world import HeadWorldSettings, PlateWorldSettings

    kind = HeadWorldSettings if options.fixture == HEAD else PlateWorldSettings
    return read_world(options.world, kind)


def _read_faults(options: Options) -> FaultPlan:
    from drivers.simulated.fault_plan import (
        DEVICES,
        DISK,
        GENERATOR,
        ROTARY,
        STAGE_X,
        STAGES,
        FaultPlan,
        befallen_with,
    )

    if options.fault is None:
        return FaultPlan()
    missing = {GENERATOR} if options.fixture == HEAD else {ROTARY}
    missing |= {"film-clamp": {STAGE_X}, "plate": {GENERATOR}}.get(options.fixture, set())
    if not options.slaved:
        missing.add(DISK)  # whoever records is another process
    on_a_line = [name for name in STAGES if _kind(options.stages, name) == "az"]
    befallen = befallen_with(on_a_line)
    there = [name for name in DEVICES if name not in missing]
    return FaultPlan.read(Path(options.fault), there, befallen)


def _faulty_disk(options: Options) -> FaultyDisk | None:
    """The disk of the owner's results, where the fault plan has something for it."""
    if options.fault is None or options.results is None:
        return None
    from drivers.simulated.disk_faults import FaultyDisk
    from drivers.simulated.fault_plan import FileFault

    faults: tuple[FileFault, ...] = _read_faults(options).of(FileFault)
    return FaultyDisk(faults, Path(options.results)) if faults else None


class _Instruments:
    """What stands on the bench, wired to its World and served, not yet listening."""

    def __init__(self, world: World, options: Options, faults: FaultPlan):
        from drivers.simulated.fault_plan import (
            DAQ,
            FORCE_STREAM,
            GENERATOR,
            ROTARY,
            SensorFault,
            TimedFault,
        )
        from drivers.simulated.faults import WireFaults
        from drivers.simulated.keysight_u2300a import KeysightU2300A
        from drivers.simulated.me_gsv8 import GSV_DIALECT, Gsv8, Sensor
        from drivers.simulated.monitor import WatchedLine
        from drivers.simulated.serial_server import PtyServer
        from drivers.simulated.servers import SCPI_DIALECT, HislipServer
        from drivers.simulated.zaber_rst import ZABER_DIALECT

        def wire(device: str, dialect: Dialect) -> WireFaults:
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
        world.befall(DAQ, lambda fault, t_us: daq.overrun())
        self.serial: list[PtyServer] = []
        """Servers that need be told when nobody owns the time any more."""
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
        sensor = Sensor(zero_mV_V=settings.force_sensor_zero_mV_V)
        amplifier = Gsv8(world, world, FORCE_SENSOR, sensor)
        tell = partial(world.log, FORCE_SENSOR, by="monitor")
        self.force = PtyServer(
            amplifier if settings.watch is None else WatchedLine(amplifier, tell),
            world,
            slaved=options.slaved,
            faults=wire(FORCE_SENSOR, GSV_DIALECT),
            stream_faults=wire(FORCE_STREAM, GSV_DIALECT),
            name=FORCE_SENSOR,
        )

        def disturb(fault: TimedFault, t_us: int) -> None:
            assert isinstance(fault, SensorFault), "the World keeps the others to itself"
            amplifier.disturb(fault.kind, t_us * 1e-6, fault.for_s)

        world.befall(FORCE_SENSOR, disturb)
        self.serial.append(self.force)

    def _serve_stages(
        self, options: Options, wire: Callable[[str, Dialect], WireFaults]
    ) -> list[Any]:
        """In front of z and x: a server each, or their common line."""
        from drivers.simulated.modbus_rtu import RTU_DIALECT, RtuLine
        from drivers.simulated.modbus_tcp import MODBUS_DIALECT, ModbusTcpServer
        from drivers.simulated.oriental_az import AzDrive
        from drivers.simulated.serial_server import PtyServer

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
        """Who watches over the bench, where that is asked for."""
        from drivers.simulated.monitor import Monitor

        if settings is None:
            return None
        tell = partial(self._world.log, "world", by="monitor")
        return Monitor(settings, self._world.pressed_N, self._active, tell)

    def _active(self) -> Iterator[str]:
        """What moves or is driven now."""
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

    def listening(self) -> Endpoints:
        """Where each listens."""
        generator = 0 if self.generator is None else self.generator.port
        stages = [getattr(stage, "port", None) or stage.path for stage in self.stages]
        rotary = "" if self.turning is None else self.turning.path
        return self._endpoints(generator, self.daq.port, stages, self.force.path, rotary)

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
            force_sensor=force,
            generator=by_link[self._link],
            rotary=rotary,
        )


def _drive(
    stages: Stages, world: World, faults: FaultPlan, fine: bool, name: str
) -> CmmtDrive | AzDrive:
    make = _az_drive if _kind(stages, name) == "az" else _cmmt_drive
    return make(world, faults, fine, name)


def _cmmt_drive(world: World, faults: FaultPlan, fine: bool, name: str) -> CmmtDrive:
    from drivers.simulated.fault_plan import STAGE_Z, MoveFault
    from drivers.simulated.festo_cmmt import CmmtDrive, DriveSettings

    serial = "SIMZ1" if name == STAGE_Z else "SIMX1"
    own = DriveSettings(name, serial=serial, faults=faults.of(MoveFault, name))
    return CmmtDrive(replace(own, position_unit_mm=SKIN_UNIT_MM) if fine else own, world)


def _az_drive(world: World, faults: FaultPlan, fine: bool, name: str) -> AzDrive:
    from drivers.simulated.fault_plan import STAGES, MoveFault
    from drivers.simulated.oriental_az import AzDrive, DriveSettings

    unit_id = STAGES.index(name) + 1
    own = DriveSettings(name, unit_id, AZ_STEPS_PER_MM, faults=faults.of(MoveFault, name))
    return AzDrive(own, world)


def _clamp_drives(
    world: World, make_drive: Callable[[str], CmmtDrive | AzDrive]
) -> list[CmmtDrive | AzDrive]:
    """The z stage, with the vibrator on it above the film."""
    from drivers.simulated.fault_plan import STAGE_Z

    clamp = world.settings.clamp
    z = make_drive(STAGE_Z)
    z.axis.stiffest_load_N_mm = clamp.stiffness_N_mm + clamp.creep_stiffness_N_mm
    world.mount(z.positions_mm)
    return [z]


def _rotary(world: World, faults: FaultPlan) -> RotaryStage:
    """The rotary stage, which carries the head."""
    from drivers.simulated.fault_plan import ROTARY, RotaryFault
    from drivers.simulated.zaber_rst import RotaryStage, StageSettings

    own = StageSettings(ROTARY, start_deg=ROTARY_START_deg, faults=faults.of(RotaryFault, ROTARY))
    return RotaryStage(own, world)


def _skin_drives(
    turned_deg: Where | None, world: World, make_drive: Callable[[str], CmmtDrive | AzDrive]
) -> list[CmmtDrive | AzDrive]:
    """The z and the x stage, with the skin on them above the plate or the head that is turned."""
    from drivers.simulated.fault_plan import STAGES
    from drivers.simulated.plate_world import PlateWorldSettings, hang_skin

    settings = world.settings
    assert isinstance(settings, PlateWorldSettings)
    drives = [make_drive(name) for name in STAGES]
    z, x = drives
    stiffness = hang_skin(world, settings, z.positions_mm, x.positions_mm, turned_deg)
    for drive in drives:
        drive.axis.stiffest_load_N_mm = stiffness
    return drives


def _generator(world: World, faults: WireFaults) -> HislipServer | ScpiSocketServer:
    from drivers.simulated.keysight_33500b import Keysight33500B
    from drivers.simulated.servers import HislipServer, ScpiSocketServer

    hislip = world.settings.generator_link == "hislip"
    server_class = HislipServer if hislip else ScpiSocketServer
    return server_class(Keysight33500B(world, world), faults=faults)


class _OwnersPipe(asyncio.Protocol):
    """The owner's end of our stdin: closed when the owner is gone, however early it dies."""

    def __init__(self, gone: Callable[[], None]):
        self._gone = gone

    def connection_lost(self, exc: Exception | None) -> None:
        self._gone()


def main() -> None:
    """The process behind `start`: options as JSON in, one line of JSON out when it listens."""
    for number in (signal.SIGHUP, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN)

    def say(what: dict[str, Any]) -> None:
        with contextlib.suppress(BrokenPipeError):  # the owner died first: its pipe will tell
            os.write(sys.stdout.fileno(), json.dumps(what).encode() + b"\n")

    try:
        asyncio.run(_serve(Options(**json.loads(sys.argv[1])), say))
    except RigError as error:
        say({"error": error.message, "hint": error.hint})


if __name__ == "__main__":
    main()
