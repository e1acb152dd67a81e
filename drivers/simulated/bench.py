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
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rig.errors import ConfigurationError, InstrumentError, RigError

LINGER_S = 10.0
"""How long a bench whose owner died goes on in real time: time for the guard to come and act."""

START_TIMEOUT_S = 30.0


@dataclass(frozen=True)
class Options:
    """How to run the bench."""

    seed: int = 0
    slaved: bool = False
    world: str | None = None
    """TOML file with World settings."""
    fault: str | None = None
    """TOML file with a fault plan."""
    world_log: str | None = None
    """File to which the World's log is appended."""
    linger_s: float = LINGER_S


FORCE_SENSOR = "force_sensor"
FORCE_STREAM = "force_sensor.stream"
"""Name of the force sensor's own frames in fault plans; its answers go by the sensor's name."""

ANY_PORT = 502
"""Stands for the drive's port in a bench file that is only recorded."""

LINK_TIMEOUT_S = 1.5
"""Wall time the bench file gives every link: a loaded machine may let a process wait for long."""

SETTLE_EVERY_S = 0.02
"""How often drives in real time look at what has befallen them."""


@dataclass(frozen=True)
class Endpoints:
    """Where the bench listens."""

    control: int
    generator: str
    daq: str
    stage_z: int
    force_sensor: str


def bench_toml(options: Options, world: dict[str, Any], endpoints: Endpoints) -> str:
    """The bench file that drives this bench."""
    from drivers.simulated.me_gsv8 import Sensor

    simulation = {"seed": options.seed, **world}
    lines = "".join(f"{key} = {_toml(value)}\n" for key, value in simulation.items())
    return f"""# A simulated bench: whatever is measured on it is computed, not measured.
name = "simulated"

[simulation]
{lines}
[fixture]
mounted = "film-clamp"
contact_from_mm = 12.0
contact_to_mm = 13.0

[film]
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

[stage_z]
driver = "festo-cmmt"
axis = "z"
host = "127.0.0.1"
port = {endpoints.stage_z}
timeout_s = {LINK_TIMEOUT_S}
low_limit_mm = 0.0
high_limit_mm = 14.0
max_speed_mm_s = 20.0
communication_timeout_ms = 1000
torque_limit_percent = 45.0

[force_sensor]
driver = "me-gsv8"
port = "{endpoints.force_sensor}"
timeout_s = {LINK_TIMEOUT_S}
nominal_force_N = 50.0
max_force_N = 40.0
matrix_N_mV_V = {json.dumps(Sensor().matrix)}
"""


def _toml(value: Any) -> str:
    """A value of the World's settings in TOML: JSON but for tables."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_toml(own)}" for key, own in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(_toml(own) for own in value) + "]"
    return json.dumps(value)


class StartedBench:
    """A bench that was started as a process of its own, and how to drive it."""

    def __init__(self, options: Options):
        self._process = subprocess.Popen(
            [sys.executable, "-m", "drivers.simulated.bench", json.dumps(asdict(options))],
            stdin=subprocess.PIPE,  # never written: its end tells the bench that we died
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,  # a terminal's Ctrl-C is the run's business, not the bench's
        )

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
        return answer

    def wait(self, timeout_s: float = 5.0) -> None:
        """Wait for the process to end; one that does not is ended."""
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout, self._process.stderr):
            if pipe is not None:
                pipe.close()


def start(options: dict[str, Any]) -> StartedBench:
    """Start a slaved bench; `options` are fields of `Options`."""
    return StartedBench(Options(**{**options, "slaved": True}))


def serve(options: dict[str, Any], ready: Callable[[str], None]) -> None:
    """Run a bench here in real time until SIGINT or SIGTERM; `ready` gets the bench file's text."""
    asyncio.run(_serve(Options(**options), lambda said: ready(said["bench_toml"])))


async def _serve(options: Options, ready: Callable[[dict[str, Any]], None]) -> None:
    from drivers.simulated.control import ControlServer
    from drivers.simulated.faults import FaultPlan, WireFaults
    from drivers.simulated.festo_cmmt import CmmtDrive, DriveSettings
    from drivers.simulated.keysight_33500b import Keysight33500B
    from drivers.simulated.keysight_u2300a import KeysightU2300A
    from drivers.simulated.me_gsv8 import Gsv8, Sensor
    from drivers.simulated.modbus_tcp import ModbusTcpServer
    from drivers.simulated.serial_server import PtyServer
    from drivers.simulated.servers import HislipServer, ScpiSocketServer
    from drivers.simulated.world import STAGE_Z, World, read_world

    settings = read_world(options.world)
    devices = ("generator", "daq", STAGE_Z, FORCE_SENSOR, FORCE_STREAM)
    faults = FaultPlan.read(Path(options.fault), devices) if options.fault else FaultPlan()
    log = Path(options.world_log) if options.world_log else None
    world = World(settings, options.seed, options.slaved, log)
    ended = asyncio.Event()
    loop = asyncio.get_running_loop()

    server_class = HislipServer if settings.generator_link == "hislip" else ScpiSocketServer
    generator = server_class(Keysight33500B(world, world), faults=WireFaults(faults, "generator"))
    daq = HislipServer(
        KeysightU2300A(settings.daq_model, world, world), faults=WireFaults(faults, "daq")
    )
    drive = CmmtDrive(DriveSettings(name=STAGE_Z, troubles=settings.stage_z_troubles), world)
    world.mount(drive.position_mm)
    stage = ModbusTcpServer(drive, faults=WireFaults(faults, STAGE_Z))
    force = PtyServer(
        Gsv8(world, world, FORCE_SENSOR, Sensor(zero_mV_V=settings.force_sensor_zero_mV_V)),
        world,
        slaved=options.slaved,
        faults=WireFaults(faults, FORCE_SENSOR),
        stream_faults=WireFaults(faults, FORCE_STREAM),
        name=FORCE_SENSOR,
    )

    def after_time_passed() -> None:
        drive.settle(world.now_us)
        force.pump()

    async def follow_real_time() -> None:
        while True:
            drive.settle(world.now_us)
            await asyncio.sleep(SETTLE_EVERY_S)

    free: list[asyncio.Task[None]] = []

    def set_free() -> None:
        free.append(loop.create_task(follow_real_time()))

    def orphaned() -> None:
        if not world.timeline.slaved:
            return
        world.timeline.set_free()
        world.log("world", "owner-gone", None, "world")
        force.set_free()
        set_free()
        loop.call_later(options.linger_s, ended.set)

    control = ControlServer(
        world, {FORCE_SENSOR: lambda: force.bytes_sent}, ended.set, orphaned, after_time_passed
    )
    if not options.slaved:
        set_free()
    for number in (signal.SIGTERM,) if options.slaved else (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, ended.set)
    servers = (generator, daq, stage, force)
    try:
        for server in servers:
            await server.start()
        port = await control.start()
        if options.slaved:  # its end is seen however early it was: what it sets free has started
            await loop.connect_read_pipe(lambda: _OwnersPipe(orphaned), sys.stdin)
        overrides = settings.model_dump(mode="json", exclude_defaults=True)
        listening = _endpoints(settings, port, generator.port, daq.port, stage.port, force.path)
        anywhere = _endpoints(settings, 0, 0, 0, ANY_PORT, FORCE_SENSOR)
        ready(
            {
                "control_port": port,
                "bench_toml": bench_toml(options, overrides, listening),
                "recorded_toml": bench_toml(options, overrides, anywhere),
            }
        )
        await ended.wait()
    finally:
        control.close()
        for task in free:
            task.cancel()
        for server in servers:
            await server.close()
        drive.settle(world.now_us)
        world.close()


class _OwnersPipe(asyncio.Protocol):
    """The owner's end of our stdin: closed when the owner is gone, however early it dies."""

    def __init__(self, gone: Callable[[], None]):
        self._gone = gone

    def connection_lost(self, exc: Exception | None) -> None:
        self._gone()


def _endpoints(
    settings: Any, control: int, generator: int, daq: int, stage_z: int, force_sensor: str
) -> Endpoints:
    """Where each instrument is; port 0 stands for "any" in a text that is only recorded."""
    by_link = {
        "socket": f"TCPIP::127.0.0.1::{generator}::SOCKET",
        "hislip": f"TCPIP::127.0.0.1::hislip0,{generator}::INSTR",
    }
    return Endpoints(
        control,
        by_link[settings.generator_link],
        f"TCPIP::127.0.0.1::hislip0,{daq}::INSTR",
        stage_z,
        force_sensor,
    )


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
