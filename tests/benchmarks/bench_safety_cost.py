"""What safety costs a tick: keep-alives, heartbeat, stop requests, watchers, guarded calls.

A procedure's tick loop on the simulated bench in real time, through the real runner, and the same
loop on a bare clock. What is measured is processor time, thread by thread: a wait takes none, and
neither does another program. The thread of the ticks looks for stop requests, sends heartbeats and
checks the watchers; the link workers keep the drives alive. The force reader is shown beside them:
most of what it does is reading the frames that are recorded; what watching them adds is in the
second table. How often each of these happened is printed, so that a figure cannot be small because
nothing was done.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_safety_cost.py``; `RIG_REPEATS=3` for
three loops at each rate instead of five.
"""

from __future__ import annotations

import signal
import threading
import time
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
from measured import heading, repeats, row, target

from drivers.festo_cmmt.watch import CmmtWatch
from rig.bench.limits import GuardedGenerator
from rig.bench.plan import read_bench
from rig.control.tick_loop import tick_loop
from rig.core.clock import WallClock
from rig.core.errors import ExitCode
from rig.core.settings import Settings
from rig.files.journal.layout import Column, Layout, Plot
from rig.instruments.roles import ForceFrames, Limits
from rig.run.execute import execute
from rig.run.holds import Holds
from rig.run.job import RunJob
from rig.run.making_safe.guard_link import GuardLink
from rig.run.points import Point
from rig.run.procedure import Procedure
from rig.run.stopping import StopFlag
from rig.run.streams.force_monitor import ForceMonitor

pytestmark = [pytest.mark.benchmark, pytest.mark.short, pytest.mark.timeout(900)]

RATES_Hz = (100.0, 500.0)
FORCE_RATE_S_S = 1000.0
SECONDS, REPEATS = 5.0, repeats(5)
CALLS = 20_000
US, LEAST_US = "us a tick", 0.1
TICKS = "the ticks"
"""Name of the thread that runs the loop, in the table."""


def processor_s():
    """Processor time in s that each thread of this process has used, by its name."""
    here = threading.current_thread()
    return {
        TICKS if thread is here else thread.name: time.clock_gettime(
            time.pthread_getcpuclockid(thread.ident)
        )
        for thread in threading.enumerate()
        if thread.ident is not None
    }


def cost_of_ticks(run, rate_Hz):
    """Processor time in us that each thread used for each tick of a loop that does nothing."""
    before = processor_s()
    done = tick_loop(run, rate_Hz, SECONDS, lambda tick: True)
    after = processor_s()
    assert done.ticks == SECONDS * rate_Hz
    return {name: 1e6 * (after[name] - used) / done.ticks for name, used in before.items()}


class Ticking(Procedure):
    """A procedure that ticks and does nothing, under a watched force, with both drives alive."""

    name, fixtures = "ticking", ("plate",)
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

    def __init__(self, done):
        super().__init__(Settings())
        self.costs = {rate_Hz: [] for rate_Hz in RATES_Hz}
        self.often = {rate_Hz: Counter() for rate_Hz in RATES_Hz}
        self._done = done

    def points(self):
        rates = [rate_Hz for _ in range(REPEATS) for rate_Hz in RATES_Hz]
        return tuple(Point(f"p{k}", rate_Hz, ()) for k, rate_Hz in enumerate(rates))

    def arm(self, run):
        run.stream_force(FORCE_RATE_S_S)
        run.force.watch(1e3)

    def take(self, run, point):
        before, frames = Counter(self._done), run.force.frames_seen
        self.costs[point.condition].append(cost_of_ticks(run, point.condition))
        self.often[point.condition] += Counter(self._done) - before
        self.often[point.condition]["frames watched"] += run.force.frames_seen - frames
        return {"x": 0.0, "y": 0.0}


def counted(monkeypatch, done, owner, name, what):
    """Count the calls of a method."""
    inner = getattr(owner, name)

    def counting(self, *args, **options):
        done[what] += 1
        return inner(self, *args, **options)

    monkeypatch.setattr(owner, name, counting)


def test_what_safety_costs_a_tick(rig, monkeypatch):
    path = rig.folder / "served.toml"
    serving = rig.start("simulate", "--fixture", "plate", "--write", str(path))
    serving.wait_for("in real time")
    plan, clock, done = read_bench(path), WallClock(), Counter()
    counted(monkeypatch, done, CmmtWatch, "read", "drives read")
    counted(monkeypatch, done, GuardLink, "beat", "heartbeats")
    counted(monkeypatch, done, StopFlag, "check", "looks for a stop request")
    procedure = Ticking(done)
    outcome = execute(RunJob(procedure, 0, rig.results), plan, clock, StopFlag())
    serving.send(signal.SIGINT)
    serving.finish()
    assert outcome.code is ExitCode.DONE, outcome.failures

    bare = WallClock()
    nothing = SimpleNamespace(clock=bare, check_stop=lambda: None, check_watchers=lambda: None)
    for rate_Hz in RATES_Hz:
        heading(f"tick loop at {rate_Hz:g} Hz for {SECONDS:g} s, {REPEATS} times, in real time")
        spent_s = SECONDS * REPEATS
        often = procedure.often[rate_Hz]
        print(", ".join(f"{what} {count / spent_s:.3g} a second" for what, count in often.items()))
        assert min(often[what] for what in ("drives read", "heartbeats", "frames watched")) > 0
        without = [cost_of_ticks(nothing, rate_Hz)[TICKS] for _ in range(REPEATS)]
        costs = procedure.costs[rate_Hz]
        safety_us = -float(np.median(without))
        for name in sorted(costs[0]):
            found = [cost[name] for cost in costs]
            if max(found) < LEAST_US:
                continue
            median_us = row(
                f"thread of {name}" if name == TICKS else f"thread {name}", found, US, 1
            )
            safety_us += median_us if name == TICKS or name.startswith("link ") else 0.0
        row("bare loop", without, US, 1)
        share = 1e-4 * safety_us * rate_Hz
        print(f"thread of the ticks and links, less the bare loop: {safety_us:.1f} {US}")
        target("share of one processor for safety", share, 5.0, "%")


def seconds_a_call(call):
    begun = time.thread_time()
    for _ in range(CALLS):
        call()
    return (time.thread_time() - begun) / CALLS


def test_what_watching_and_guarding_cost(rig):
    heading(f"{CALLS} calls each, in this process; processor time")
    force = np.tile([[1.0], [1.001]], (5, 3))  # a sensor that measures is never quite still
    frames = ForceFrames(0, force.astype(np.float32), force, np.zeros(10, bool))
    sensor = SimpleNamespace(bytes_consumed=0, frames_behind=0.0, read=lambda: frames)
    monitor = ForceMonitor(sensor, WallClock(), Holds(), lambda: [])
    monitor.watch(10.0)
    limits = {"frequency": Limits(0, 1e4, "Hz", "g"), "amplitude": Limits(0, 10, "V", "g")}
    inner = SimpleNamespace(limits=lambda: limits, sine=lambda f, a: None)
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
