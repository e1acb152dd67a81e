"""What a point costs that is not physics: the wire, the fit, the runner and the journal.

The first part sweeps many short points over sockets in real time: overhead is the wall time of a
point less its settling and the length of its record. The second runs a procedure that does nothing
through the real runner, recorder and journal, with bluesky's RunEngine beside it.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_overhead.py``.
"""

from __future__ import annotations

import math
import os
import signal
import time
from collections import defaultdict

import numpy as np
import pytest
from clients import python_with, seen_by
from measured import heading, row, target

from drivers.shared.visa_link import VisaLink
from drivers.simulated.bench import start as simulated
from drivers.simulated.instruments.u2300a_models import codes_of_volts
from drivers.simulated.world.settings import WorldSettings
from drivers.simulated.world.world import World
from procedures.sweep import Sweep
from rig.analysis.response import complex_response as response
from rig.analysis.response import sine_fit
from rig.bench.plan import parse_bench, read_bench
from rig.core.clock import ControlLink, SlavedClock, WallClock
from rig.core.errors import ExitCode
from rig.core.settings import Settings
from rig.files.journal.layout import Column, Layout, Plot
from rig.files.journal.recorder import Recorder
from rig.files.runfile.reader import RunFile
from rig.files.verify import verify
from rig.run.context import Run
from rig.run.execute import execute
from rig.run.job import RunJob
from rig.run.observers import RunObserver
from rig.run.points import Point
from rig.run.procedure import Procedure
from rig.run.stopping import StopFlag

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(900)]

SHORT = {
    "frequencies_Hz": tuple(float(f"{f:.6g}") for f in np.geomspace(2000, 20000, 200)),
    "settling_s": 0.01,
    "shortest_record_s": 0.01,
}
"""200 points of about 20 ms each, every one at a rate of its own."""


class Silent(RunObserver):
    """An observer that only remembers when."""

    def __init__(self):
        self.planned_at = math.nan
        self.kept_at = []
        self.on_kept = lambda: None

    def planned(self, points, recorded, overhead_s):
        self.planned_at = time.perf_counter()

    def point_recorded(self, number, total, point, reading):
        self.kept_at.append(time.perf_counter())
        self.on_kept()


@pytest.fixture
def real_time_bench(rig):
    """A bench file that drives a simulated bench in real time."""
    path = rig.folder / "served.toml"
    running = rig.start("simulate", "--write", str(path))
    running.wait_for("in real time")
    yield path
    running.send(signal.SIGINT)
    running.finish()


def test_over_sockets_in_real_time(rig, real_time_bench):
    settings = Sweep.Settings(**SHORT)
    planned = {point.id: point.duration_s for point in Sweep(settings).points()}
    frequencies = ",".join(f"{f:g}" for f in settings.frequencies_Hz)
    given = ["--frequencies", frequencies, "--settling", "0.01", "--shortest-record", "0.01"]
    heading(f"rig sweep --bench served.toml, {len(planned)} points, settling and record 10 ms each")
    for _ in range(3):
        bench = ["--bench", str(real_time_bench)]
        ended = rig.run("sweep", *bench, *given, "--json", "--no-figures")
        assert ended.code == 0, ended.stderr
        with RunFile.open(rig.folder / ended.object["file"]) as run:
            overheads = 1e3 * (run.column("taken") - run.column("physics"))[1:]
        median = row("overhead a point", overheads, "ms", 2)
    target("overhead a point over sockets", median, 20, "ms")


class Ledger:
    """Wall time by what it was spent on, gathered for each point."""

    def __init__(self):
        self.spent = defaultdict(float)
        self.points = []

    def close_point(self):
        self.points.append(dict(self.spent))
        self.spent.clear()

    def wrap(self, monkeypatch, owner, name, label):
        """Charge the calls of a function to ``label(*args)``, without what they charge inside."""
        inner = getattr(owner, name)

        def timed(*args, **options):
            outside = sum(self.spent.values())
            start = time.perf_counter()
            try:
                return inner(*args, **options)
            finally:
                within = sum(self.spent.values()) - outside
                self.spent[label(*args)] += time.perf_counter() - start - within

        monkeypatch.setattr(owner, name, timed)

    def report(self, name):
        return row(name, [1e3 * point.get(name, 0.0) for point in self.points[1:]], "ms")


def conversation(link, message, *_):
    if message.startswith("ACQ:SRAT"):
        return "daq: configure"
    if message.startswith("SOUR"):
        return "generator: frequency"
    if message.startswith("DIG"):
        return "daq: digitise"
    return "daq: complete?" if message.startswith("WAV:COMP") else f"{link.device}: other"


def test_where_the_overhead_goes(rig, real_time_bench, monkeypatch):
    ledger, reporter = Ledger(), Silent()
    reporter.on_kept = ledger.close_point
    ledger.wrap(monkeypatch, VisaLink, "query", conversation)
    ledger.wrap(monkeypatch, VisaLink, "query_block", lambda *_: "daq: block")
    ledger.wrap(monkeypatch, sine_fit, "fit_sine", lambda *_: "two fits")
    ledger.wrap(monkeypatch, response, "complex_response", lambda *_: "response")
    ledger.wrap(monkeypatch, Recorder, "_put_records", lambda *_: "recorder: put")
    ledger.wrap(monkeypatch, WallClock, "sleep", lambda *_: "clock")
    heading("the same in this process, by what the wall time went to (each without the others)")
    settings = Sweep.Settings(**SHORT)
    job = RunJob(Sweep(settings), 0, rig.results)
    outcome = execute(job, read_bench(real_time_bench), WallClock(), StopFlag(), reporter)
    assert outcome.code == ExitCode.DONE, outcome.failures

    points = Sweep(settings).points()
    walls = np.diff(reporter.kept_at)
    with RunFile.open(outcome.file) as run:
        physics = run.column("physics")[1:]
    for name in sorted({name for point in ledger.points for name in point} - {"clock"}):
        ledger.report(name)
    clocks = np.array([point["clock"] for point in ledger.points[1:]])
    row("clock: longer than asked for, polls included", 1e3 * (clocks - physics), "ms")
    known = np.array([sum(point.values()) for point in ledger.points[1:]])
    row("everything else", 1e3 * (walls - known), "ms")
    row("overhead a point", 1e3 * (walls - physics), "ms")
    simulation = [record_cost(point) for point in points[1:]]
    row("(of the block: the World computing it)", 1e3 * np.array(simulation), "ms")


def record_cost(point):
    """Wall time in s that the simulated bench needs to compute a point's record."""
    world = World(WorldSettings(), 0, slaved=True)
    acquisition = point.acquisitions[0]
    start = time.perf_counter()
    number = world.begin_acquisition()
    rate, n = acquisition.rate_S_s, acquisition.samples
    volts = world.volts(number, (101, 102), 0, rate, 0, n, (0.0, 1e-6))
    for column in (0, 1):
        codes_of_volts(volts[:, column], 1.25, "BIP", 12)
    return time.perf_counter() - start


COUNT = 20_000
BLUESKY_COUNT = 2_000
QUANTITIES = tuple(f"quantity_{k}" for k in range(20))


class NoOp(Procedure):
    """A procedure whose points do nothing and read twenty numbers."""

    name = "no-op"
    fixtures = ("film-clamp",)
    Settings = Settings
    layout = Layout(
        definition="NXrig_noop",
        version="1",
        columns=tuple(Column(name, "V", key=name, long_name=name) for name in QUANTITIES),
        plots=(Plot("data", QUANTITIES[1], (QUANTITIES[0],)),),
    )

    def __init__(self, count):
        super().__init__(Settings())
        self.count = count

    def points(self):
        return tuple(Point(f"p{k}", k, ()) for k in range(self.count))

    def arm(self, run):
        pass

    def take(self, run, point):
        return {name: point.condition + 1 / (k + 3) for k, name in enumerate(QUANTITIES)}


def points_per_second(plan, clock, results, count, monkeypatch):
    """Points a second from the first to the last one acknowledged by the disk."""
    reporter, closed, syncs = Silent(), [], []
    with monkeypatch.context() as patch:
        close, fdatasync = Recorder.close, os.fdatasync

        def noting_close(recorder):
            close(recorder)
            closed.append(time.perf_counter())

        def noting_sync(descriptor):
            start = time.perf_counter()
            fdatasync(descriptor)
            syncs.append(time.perf_counter() - start)

        patch.setattr(Recorder, "close", noting_close)
        patch.setattr(os, "fdatasync", noting_sync)
        outcome = execute(RunJob(NoOp(count), 0, results), plan, clock, StopFlag(), reporter)
    assert outcome.code == ExitCode.DONE, outcome.failures
    assert outcome.points_done == count
    assert verify(outcome.file) == []
    assert syncs
    return count / (closed[0] - reporter.planned_at), len(syncs), 1e3 * float(np.median(syncs))


BLUESKY = """
import json, sys, time
from bluesky import RunEngine, plan_stubs as bps, __version__

count, path = int(sys.argv[1]), sys.argv[2]
names = [f"quantity_{k}" for k in range(20)]

class NoOp:
    name, parent, hints = "no_op", None, {}
    point = 0
    def read(self):
        values = [self.point + 1 / (k + 3) for k in range(len(names))]
        now = time.time()
        return {n: {"value": v, "timestamp": now} for n, v in zip(names, values)}
    def describe(self):
        return {n: {"source": "none", "dtype": "number", "shape": []} for n in names}
    def read_configuration(self):
        return {}
    describe_configuration = read_configuration

device = NoOp()
def plan():
    yield from bps.open_run()
    for k in range(count):
        device.point = k
        yield from bps.checkpoint()
        yield from bps.create()
        yield from bps.read(device)
        yield from bps.save()
    yield from bps.close_run()

engine = RunEngine({})
with open(path, "w") as file:
    engine.subscribe(lambda name, doc: file.write(json.dumps([name, doc]) + chr(10)))
    engine(plan())  # warm
    start = time.perf_counter()
    engine(plan())
    file.flush()
    wall = time.perf_counter() - start
print(json.dumps({"rate": count / wall, "version": __version__}))
"""


def test_runner_and_journal_on_a_point_that_does_nothing(rig, real_time_bench, monkeypatch):
    heading(f"rig.run.context.execute, {COUNT} no-op points of 20 numbers, fdatasync'd journal")
    rates = {}
    for name in ("real time", "slaved"):
        found = []
        for _ in range(5):
            if name == "real time":
                plan, clock, started = read_bench(real_time_bench), WallClock(), None
            else:
                started = simulated.start({})
                ready = started.ready()
                plan = parse_bench(ready["bench_toml"], "the simulated bench")
                clock = SlavedClock(ControlLink(ready["control_port"]))
            rate, syncs, sync_ms = points_per_second(plan, clock, rig.results, COUNT, monkeypatch)
            found.append(rate)
            if started is not None:
                started.wait()
        rates[name] = row(f"runner and journal, bench in {name}", found, "points/s", 0)
        print(f"    {syncs} fdatasync of {sync_ms:.2f} ms (median) in the last")

    python = python_with("bluesky", ["bluesky"])
    path = str(rig.folder / "bluesky.jsonl")
    seen = [seen_by(python, BLUESKY, str(BLUESKY_COUNT), path) for _ in range(3)]
    median = row(
        f"bluesky {seen[0]['version']} RunEngine, JSON, no sync", [s["rate"] for s in seen],
        "points/s", 0,
    )  # fmt: skip
    same = [
        points_per_second(
            read_bench(real_time_bench), WallClock(), rig.results, BLUESKY_COUNT, monkeypatch
        )[0]
        for _ in range(3)
    ]
    own = row(f"this runner, {BLUESKY_COUNT} points", same, "points/s", 0)
    print(f"ratio {own / median:.1f}")
    target("runner and journal", rates["real time"], 4000, "points/s", at_least=True)


def test_where_a_point_that_does_nothing_goes(rig, real_time_bench, monkeypatch):
    heading(f"the same {BLUESKY_COUNT} points in real time, by part (with the cost of measuring)")
    ledger, reporter = Ledger(), Silent()
    reporter.on_kept = ledger.close_point
    ledger.wrap(monkeypatch, Recorder, "_put_records", lambda *_: "recorder: two puts")
    ledger.wrap(monkeypatch, Run, "check_stop", lambda *_: "check_stop")
    job = RunJob(NoOp(BLUESKY_COUNT), 0, rig.results)
    outcome = execute(job, read_bench(real_time_bench), WallClock(), StopFlag(), reporter)
    assert outcome.code == ExitCode.DONE, outcome.failures
    walls = np.diff(reporter.kept_at)
    for name in ("recorder: two puts", "check_stop"):
        ledger.report(name)
    row("a point", 1e3 * walls, "ms")
