"""The process of a simulated bench: a World, the mounted instruments and the control socket.

``python -m drivers.simulated.bench.process`` is a bench whose time is slaved to whoever started it
and holds its standard input, the first line of which is the bench's options as a JSON object.
`serve` runs one here, in real time.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import json
import os
import signal
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, get_args

from drivers.simulated.bench.bench_file import bench_toml
from drivers.simulated.bench.control import ControlServer
from drivers.simulated.bench.mounted import Instruments
from drivers.simulated.bench.options import (
    Fixture,
    Options,
    Stages,
    check_replaced,
    fault_of_simulator,
    fault_plan,
    world_settings,
)
from drivers.simulated.faults.plan import FORCE_SENSOR, TimedFault
from drivers.simulated.world.world import World
from rig.core.errors import ConfigurationError, InstrumentError, RigError

SETTLE_EVERY_S = 0.02
"""Interval in s at which drives in real time check what has happened to them."""
MOST_REPORTED = 5
"""Faults of simulators that are shown: further ones follow from them, and nothing may fill the pipe
to the owner."""
LATE_S = 0.2
"""Time in s by which a bench in real time is late enough for a message: frames of a force sensor
that are 0.25 s old hold a run."""


class Lateness:
    """Records by how much a bench whose time follows real time has been late.

    While the computer does something else, or computes a contact for longer than that lasts, no
    instrument answers: a program then finds an instrument silent that has nothing to do with it.
    """

    def __init__(self) -> None:
        self._latest_s: float | None = None
        self._reported_s = LATE_S / 2

    def note(self, now_s: float) -> float | None:
        """Note that the bench does its work at this time, which it should every `SETTLE_EVERY_S`.
        Return by how many seconds it is late where that is worth saying: more than `LATE_S`, and
        twice what was said before."""
        before_s, self._latest_s = self._latest_s, now_s
        late_s = 0.0 if before_s is None else now_s - before_s - SETTLE_EVERY_S
        if late_s < 2 * self._reported_s:
            return None
        self._reported_s = late_s
        return late_s


async def serve(
    options: Options,
    ready: Callable[[dict[str, Any]], None],
    show_line: Callable[[str], None] = lambda text: None,
) -> None:
    """Run a bench until it is stopped; `ready` gets ``control_port``, ``bench_toml``,
    ``recorded_toml`` and the ``models`` of its instruments by role. `show_line` shows a line to who
    runs the bench. Raises ConfigurationError for options that the bench does not have,
    and InstrumentError at the end where its contact found no solution."""
    for asked, known in ((options.fixture, Fixture), (options.stages, Stages)):
        if asked not in get_args(known):
            raise ConfigurationError(
                f"the simulated bench has no {asked} to mount",
                f"it has {' and '.join(get_args(known))}",
            )
    check_replaced(options.replace)
    bench = _ServedBench(options, show_line)
    # What has been imported stays until the end: no collection has to examine it, the one at the
    # interpreter's end included, for which a run would wait.
    gc.freeze()
    asyncio.get_running_loop().set_exception_handler(bench.report)
    try:
        ready(await bench.begin())
        await bench.ended.wait()
    finally:
        await bench.close()
    if bench.world.failure is not None:
        raise InstrumentError("simulated bench", "contact", bench.world.failure)


class _ServedBench:
    """A World with its instruments behind their ports, whose time its owner or real time moves."""

    def __init__(self, options: Options, show_line: Callable[[str], None]):
        self._options, self._show_line = options, show_line
        self._reported: set[str] = set()
        """Faults of simulators of other packages that were shown."""
        self._settings = world_settings(options)
        faults = fault_plan(options)
        log = Path(options.world_log) if options.world_log else None
        self.world = World(self._settings, options.seed, options.slaved, log, faults.of(TimedFault))
        self._instruments = bench = Instruments(self.world, options, faults)
        self._monitor = bench.monitor(self._settings.watch)
        self.ended = asyncio.Event()
        """Set when the bench is to end."""
        self._loop = asyncio.get_running_loop()
        self._real_time: asyncio.Task[None] | None = None
        self._control = ControlServer(
            self.world,
            {FORCE_SENSOR: lambda: bench.force.bytes_sent},
            self.ended.set,
            self._orphaned,
            partial(self._release, "handed-over"),
            self._time_has_passed,
        )

    async def begin(self) -> dict[str, Any]:
        """Open every port; return what the owner has to know of the bench (`serve`)."""
        options, bench = self._options, self._instruments
        if not options.slaved:
            self._follow_real_time()
        from_the_terminal = () if options.slaved else (signal.SIGINT, signal.SIGQUIT)
        for number in (signal.SIGTERM, *from_the_terminal):
            self._loop.add_signal_handler(number, self.ended.set)
        for server in bench.servers:
            await server.start()
        port = await self._control.start()
        if options.slaved:  # its end is seen however early it was: what it sets free has started
            await self._loop.connect_read_pipe(lambda: _OwnersPipe(self._orphaned), sys.stdin)
        interlocks = self.world.contacts.tables()
        return {
            "control_port": port,
            "bench_toml": bench_toml(options, self._settings, bench.listening(), interlocks),
            "recorded_toml": bench_toml(options, self._settings, bench.anywhere(), interlocks),
            "models": bench.models,
        }

    async def close(self) -> None:
        """Close every port, and complete the log of the World and the report of the monitor."""
        self._control.close()
        if self._real_time is not None:
            self._real_time.cancel()
        for server in self._instruments.servers:
            await server.close()
        self._settle()
        if self._monitor is not None:
            self._monitor.check(self.world.now_us)
            self._monitor.over()
        self.world.close()

    def _settle(self) -> None:
        """Let everything come to the state that belongs to the present time."""
        bench = self._instruments
        for drive in bench.drives:
            drive.settle(self.world.now_us)
        if bench.rotary is not None:
            bench.rotary.settle(self.world.now_us)
        self.world.settle()
        if bench.converter is not None:
            bench.converter.settle()

    def _time_has_passed(self) -> None:
        """Do what belongs to the time by which the owner has moved the bench."""
        self._settle()
        self._instruments.force.pump()
        if self._monitor is not None:
            self._monitor.check(self.world.now_us)

    def _orphaned(self) -> None:
        """Stay for a while without the owner, in real time, so that a guard can make it safe."""
        self._release("owner-gone")
        self._loop.call_later(self._options.linger_s, self.ended.set)

    def _release(self, why: str) -> None:
        """Let the time follow real time; `why` is for the log."""
        if not self.world.timeline.slaved:
            return
        self.world.timeline.set_free()
        self.world.log("world", why, None, "world")
        for server in self._instruments.serial:
            server.set_free()
        self._follow_real_time()

    def _follow_real_time(self) -> None:
        self._real_time = self._loop.create_task(self._settle_all_the_time())

    async def _settle_all_the_time(self) -> None:
        world, lateness = self.world, Lateness()
        while True:
            if (late_s := lateness.note(self._loop.time())) is not None:
                world.log("world", "late", round(late_s, 3), "world")
                self._show_line(
                    f"warning: the simulated bench was late by {late_s:.2g} s: the computer is too "
                    "busy for it in real time. A run may have found an instrument silent meanwhile"
                )
            self._settle()
            if self._monitor is not None:
                self._monitor.check(world.now_us)
            if world.failure is not None:
                self.ended.set()
            await asyncio.sleep(SETTLE_EVERY_S)

    def report(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Show once what a simulator of another package has raised while it served: its client sees
        only that the connection is closed."""
        error = context.get("exception")
        fault = None
        if isinstance(error, Exception):
            fault = fault_of_simulator(self._options.replace, error, "failed")
        if fault is None:
            loop.default_exception_handler(context)
        elif fault.message not in self._reported and len(self._reported) < MOST_REPORTED:
            self._reported.add(fault.message)
            self._show_line(f"warning: {fault.one_line()}")


class _OwnersPipe(asyncio.Protocol):
    """The owner's end of our stdin: closed when the owner has ended, however early it dies."""

    def __init__(self, gone: Callable[[], None]):
        self._gone = gone

    def connection_lost(self, exc: Exception | None) -> None:
        self._gone()


def main() -> None:
    """Run the process behind `start`: read the options as a line of JSON, and write one when it
    listens, and one with ``line`` for each line to be shown to who runs the command.

    Where the input ends without options, the owner has died: nothing is started.
    """
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT):
        signal.signal(number, signal.SIG_IGN)

    def say(what: dict[str, Any]) -> None:
        # Where the owner has died first, the bench sees that at the end of its own pipe.
        with contextlib.suppress(BrokenPipeError):
            os.write(sys.stdout.fileno(), json.dumps(what).encode() + b"\n")

    options = sys.stdin.readline()
    if not options:
        return
    try:
        asyncio.run(serve(Options(**json.loads(options)), say, lambda text: say({"line": text})))
    except RigError as error:
        say({"error": error.message, "hint": error.hint})
    except Exception as error:
        fault = fault_of_simulator(json.loads(options).get("replace", {}), error)
        if fault is None:
            raise
        say({"error": fault.message, "hint": fault.hint})


if __name__ == "__main__":
    main()
