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
LATE_S = 0.2
"""Time in s by which a bench in real time is late enough for a message: frames of a force sensor
that are 0.25 s old hold a run."""


class Lateness:
    """By how much a bench whose time follows real time has been late, for who runs it.

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
    runs a bench in real time."""
    for asked, known in ((options.fixture, Fixture), (options.stages, Stages)):
        if asked not in get_args(known):
            raise ConfigurationError(
                f"the simulated bench has no {asked} to mount",
                f"it has {' and '.join(get_args(known))}",
            )
    check_replaced(options.replace)
    settings = world_settings(options)
    faults = fault_plan(options)
    log = Path(options.world_log) if options.world_log else None
    world = World(settings, options.seed, options.slaved, log, faults.of(TimedFault))
    bench = Instruments(world, options, faults)
    # What has been imported stays until the end: no collection has to examine it, the one at the
    # interpreter's end included, for which a run would wait.
    gc.freeze()
    monitor = bench.monitor(settings.watch)
    ended = asyncio.Event()
    loop = asyncio.get_running_loop()

    def settle() -> None:
        for drive in bench.drives:
            drive.settle(world.now_us)
        if bench.rotary is not None:
            bench.rotary.settle(world.now_us)
        world.settle()
        if bench.converter is not None:
            bench.converter.settle()

    def after_time_passed() -> None:
        settle()
        bench.force.pump()
        if monitor is not None:
            monitor.check(world.now_us)

    async def follow_real_time() -> None:
        lateness = Lateness()
        while True:
            if (late_s := lateness.note(loop.time())) is not None:
                world.log("world", "late", round(late_s, 3), "world")
                show_line(
                    f"warning: the simulated bench was late by {late_s:.2g} s: the computer is too "
                    "busy for it in real time. A run may have found an instrument silent meanwhile"
                )
            settle()
            if monitor is not None:
                monitor.check(world.now_us)
            if world.failure is not None:
                ended.set()
            await asyncio.sleep(SETTLE_EVERY_S)

    free: list[asyncio.Task[None]] = []

    def set_free() -> None:
        free.append(loop.create_task(follow_real_time()))

    def release(why: str) -> None:
        """Let the time follow real time; `why` is for the log."""
        if not world.timeline.slaved:
            return
        world.timeline.set_free()
        world.log("world", why, None, "world")
        for server in bench.serial:
            server.set_free()
        set_free()

    def orphaned() -> None:
        release("owner-gone")
        loop.call_later(options.linger_s, ended.set)

    streams = {FORCE_SENSOR: lambda: bench.force.bytes_sent}
    handed_over = partial(release, "handed-over")
    control = ControlServer(world, streams, ended.set, orphaned, handed_over, after_time_passed)
    if not options.slaved:
        set_free()
    from_the_terminal = () if options.slaved else (signal.SIGINT, signal.SIGQUIT)
    for number in (signal.SIGTERM, *from_the_terminal):
        loop.add_signal_handler(number, ended.set)
    try:
        for server in bench.servers:
            await server.start()
        port = await control.start()
        if options.slaved:  # its end is seen however early it was: what it sets free has started
            await loop.connect_read_pipe(lambda: _OwnersPipe(orphaned), sys.stdin)
        interlocks = world.contacts.tables()
        ready(
            {
                "control_port": port,
                "bench_toml": bench_toml(options, settings, bench.listening(), interlocks),
                "recorded_toml": bench_toml(options, settings, bench.anywhere(), interlocks),
                "models": bench.models,
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
            monitor.check(world.now_us)
            monitor.over()
        world.close()
    if world.failure is not None:
        raise InstrumentError("simulated bench", "contact", world.failure)


class _OwnersPipe(asyncio.Protocol):
    """The owner's end of our stdin: closed when the owner is gone, however early it dies."""

    def __init__(self, gone: Callable[[], None]):
        self._gone = gone

    def connection_lost(self, exc: Exception | None) -> None:
        self._gone()


def main() -> None:
    """Run the process behind `start`: read the options as a line of JSON, and write one when it
    listens.

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
        asyncio.run(serve(Options(**json.loads(options)), say))
    except RigError as error:
        say({"error": error.message, "hint": error.hint})
    except Exception as error:
        fault = fault_of_simulator(json.loads(options).get("replace", {}), error)
        if fault is None:
            raise
        say({"error": fault.message, "hint": fault.hint})


if __name__ == "__main__":
    main()
