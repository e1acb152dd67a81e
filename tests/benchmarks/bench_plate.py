"""What the skin on its plate costs: the bench's start, cold and warm, and a trial of 4 s.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_plate.py``.
"""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from measured import heading, row, target

from drivers.simulated.bench.start import StartedBench, start
from rig.bench.connect import connect
from rig.bench.plan import parse_bench
from rig.core.clock import ControlLink, SlavedClock
from rig.instruments.roles import Acquisition, InputChannel
from rig.run.holds import Holds
from rig.run.streams.force_monitor import ForceMonitor

pytestmark = [pytest.mark.benchmark, pytest.mark.short, pytest.mark.timeout(1200)]

TICK_S = 0.01
TICKS_PER_S = 100
"""Of the kernel's account of a process's time."""


def processor_s(bench: StartedBench) -> float:
    """Processor time of the bench's process so far."""
    fields = Path(f"/proc/{bench._process.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS_PER_S


def started(fixture: str) -> tuple[float, float]:
    """Wall and processor time until a bench listens; ends it."""
    begin = time.perf_counter()
    bench = start({"fixture": fixture})
    said = bench.ready()
    wall, used = time.perf_counter() - begin, processor_s(bench)
    ControlLink(said["control_port"]).stop()
    bench.wait()
    return wall, used


def test_start(tmp_path, monkeypatch):
    heading("the simulated bench until it listens")
    monkeypatch.setenv("RIG_CACHE", str(tmp_path / "skins"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "numba"))
    wall, used = started("plate")
    row("plate, nothing compiled, no skin: wall", [wall], "s")
    row("plate, nothing compiled, no skin: processor", [used], "s")
    for fixture in ("plate", "film-clamp"):
        times = [started(fixture) for _ in range(5)]
        row(f"{fixture}, warm: wall", [wall for wall, _ in times], "s")
        row(f"{fixture}, warm: processor", [used for _, used in times], "s")


def test_trial():
    heading("4 s of slide at 0.5 mm/s, force at 1 kHz, two strips at 20 kS/s, ticks of 10 ms")
    walls, processors = [], []
    for _ in range(3):
        process = start({"fixture": "plate"})
        said = process.ready()
        clock = SlavedClock(ControlLink(said["control_port"]))
        bench = connect(parse_bench(said["bench_toml"], "the simulated bench"), clock)
        force = ForceMonitor(bench.force_sensor, clock, Holds(), lambda: [])
        force.start(1000.0)
        for stage in (bench.stage_z, bench.stage_x):
            stage.home()
        bench.stage_x.move_to(10.0, 20.0)
        bench.stage_z.move_to(12.3, 20.0)
        begin, used, at = time.perf_counter(), processor_s(process), clock.now()
        strips = (InputChannel("strip_1", 2.5), InputChannel("strip_2", 2.5))
        bench.daq.start(Acquisition(strips, 20e3, 200))
        bench.stage_z.start_move(12.443, 0.5)
        _ticks(clock, bench.daq, 1.0)
        bench.stage_x.start_move(12.0, 0.5)
        _ticks(clock, bench.daq, 4.2)
        bench.stage_z.start_move(11.0, 20.0)
        _ticks(clock, bench.daq, 0.8)
        bench.daq.stop()
        passed = clock.now() - at
        walls.append(time.perf_counter() - begin)
        processors.append(processor_s(process) - used)
        force.stop()
        bench.close()
        process.wait()
    print(f"{passed:.2f} s of bench time")
    row("wall, both processes", walls, "s")
    target("processor time of the bench", row("processor, bench", processors, "s"), 4.0, "s")


def _ticks(clock, daq, seconds):
    for _ in range(round(seconds / TICK_S)):
        clock.sleep(TICK_S)
        while daq.read() is not None:
            pass
