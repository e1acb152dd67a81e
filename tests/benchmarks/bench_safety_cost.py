"""What safety costs a tick: keep-alives, heartbeat, stop requests, watchers, guarded calls.

A procedure's tick loop on the simulated bench in real time, through the real runner, and the same
loop on a bare clock. What counts is wall time that is neither waiting nor the tick's own work, and
the processor time of the force reader's thread.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_safety_cost.py``.
"""

from __future__ import annotations

import signal
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from measured import heading, row, target

from rig.bench.limits import GuardedGenerator
from rig.bench.plan import read_bench
from rig.control.tick_loop import tick_loop
from rig.core.clock import WallClock
from rig.core.errors import ExitCode
from rig.core.settings import Settings
from rig.files.journal.layout import Column, Layout, Plot
from rig.instruments.roles import ForceFrames, Reach
from rig.run.execute import execute
from rig.run.force_monitor import ForceMonitor
from rig.run.holds import Holds
from rig.run.job import RunJob
from rig.run.points import Point
from rig.run.procedure import Procedure
from rig.run.stopping import StopFlag

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(900)]

RATE_Hz, FORCE_RATE_S_S = 100.0, 1000.0
SECONDS, REPEATS = 10.0, 5
CALLS = 20_000


class TimedClock(WallClock):
    """Remembers how long the thread that made it, which runs the ticks, has really waited."""

    def __init__(self):
        super().__init__()
        self.waited_s, self._thread = 0.0, threading.get_ident()

    def _pass(self, seconds):
        begun = time.perf_counter()
        super()._pass(seconds)
        if threading.get_ident() == self._thread:
            self.waited_s += time.perf_counter() - begun


def cost_of_ticks(run, clock):
    """Seconds a tick that were not waiting."""
    waited, begun = clock.waited_s, time.perf_counter()
    done = tick_loop(run, RATE_Hz, SECONDS, lambda tick: True)
    wall = time.perf_counter() - begun
    return (wall - (clock.waited_s - waited)) / done.ticks


class Ticking(Procedure):
    """A procedure that ticks and does nothing."""

    name, fixtures = "ticking", ("film-clamp",)
    Settings = Settings
    layout = Layout(
        definition="NXrig_noop",
        version="1",
        columns=(
            Column("x", "us", key="x", long_name="x"),
            Column("y", "us", key="y", long_name="y"),
        ),
        plots=(Plot("data", "y", ("x",)),),
    )

    def __init__(self):
        super().__init__(Settings())
        self.costs, self.reader = [], []

    def points(self):
        return tuple(Point(f"p{k}", k, ()) for k in range(REPEATS))

    def arm(self, run):
        run.stream_force(FORCE_RATE_S_S)
        run.force.watch(1e3)

    def take(self, run, point):
        thread = time.pthread_getcpuclockid(run.force._reader._thread.ident)
        begun = time.clock_gettime(thread)
        self.costs.append(cost_of_ticks(run, run.clock))
        self.reader.append((time.clock_gettime(thread) - begun) / (SECONDS * RATE_Hz))
        return {"x": 0.0, "y": 0.0}


def test_what_safety_costs_a_tick(rig):
    heading(f"tick loop at {RATE_Hz:g} Hz for {SECONDS:g} s, bench in real time")
    path = rig.folder / "served.toml"
    serving = rig.start("simulate", "--write", str(path))
    serving.wait_for("in real time")
    procedure, clock = Ticking(), TimedClock()
    outcome = execute(RunJob(procedure, 0, rig.results), read_bench(path), clock, StopFlag())
    serving.send(signal.SIGINT)
    serving.finish()
    assert outcome.code is ExitCode.DONE, outcome.failures

    bare = TimedClock()
    nothing = SimpleNamespace(clock=bare, check_stop=lambda: None, check_watchers=lambda: None)
    without = [cost_of_ticks(nothing, bare) for _ in range(REPEATS)]
    with_it = row("tick of a run, all watchers on", 1e6 * np.array(procedure.costs), "us", 0)
    row("bare tick", 1e6 * np.array(without), "us", 0)
    row("force reader's thread a tick, link included", 1e6 * np.array(procedure.reader), "us", 0)
    target("safety's share of a tick", 1e-4 * with_it * RATE_Hz, 5.0, "%")


def seconds_a_call(call):
    begun = time.perf_counter()
    for _ in range(CALLS):
        call()
    return (time.perf_counter() - begun) / CALLS


def test_what_watching_and_guarding_cost(rig):
    heading(f"{CALLS} calls each, in this process")
    force = np.tile([[1.0], [1.001]], (5, 3))  # a sensor that measures is never quite still
    frames = ForceFrames(0, force.astype(np.float32), force, np.zeros(10, bool))
    sensor = SimpleNamespace(bytes_consumed=0, frames_behind=0.0, read=lambda: frames)
    monitor = ForceMonitor(sensor, WallClock(), Holds(), lambda: [])
    monitor.watch(10.0)
    reach = {"frequency": Reach(0, 1e4, "Hz", "g"), "amplitude": Reach(0, 10, "V", "g")}
    inner = SimpleNamespace(reach=lambda: reach, sine=lambda f, a: None)
    guarded = GuardedGenerator(inner)
    watched, read, guard, call = [], [], [], []
    for _ in range(REPEATS):
        watched.append(seconds_a_call(monitor.read))
        read.append(seconds_a_call(sensor.read))
        guard.append(seconds_a_call(lambda: guarded.sine(100.0, 1.0)))
        call.append(seconds_a_call(lambda: inner.sine(100.0, 1.0)))
    row("ten frames, watched", 1e6 * np.array(watched), "us", 1)
    row("ten frames, not watched", 1e6 * np.array(read), "us", 1)
    row("a guarded call", 1e6 * np.array(guard), "us", 1)
    row("the same, not guarded", 1e6 * np.array(call), "us", 1)
