"""What the work on earlier runs costs the tick loop: lateness of its ticks with and without.

The loop of `rig.control.tick_loop` on the wall clock, 100 ticks a second with a millisecond's work
in each, in windows that take turns: alone; with `rig.batch.execute.postprocess` at work; with it
held; and, to compare, with the same worker at ordinary priority. On all processors, and with
everything on one.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_afterwards.py``.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from measured import heading

sys.path.insert(0, str(Path(__file__).parents[1] / "files"))

import recorded_trials as trials

from rig.batch.execute.postprocess import Afterwards, Job
from rig.control.tick_loop import LATE, tick_loop
from rig.core.clock import WallClock

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(1800)]

RATE_Hz, WINDOW_S, ROUNDS = 100.0, 10.0, 4
ROWS, JOBS = 20_000, 400
WARM_S = 240.0
"""For the first job, which imports everything."""


class Run:
    """What the loop needs of a run."""

    def __init__(self) -> None:
        self.clock = WallClock()

    def check_stop(self) -> None:
        pass

    def check_watchers(self) -> None:
        pass


def lateness_ms() -> np.ndarray:
    """Of every tick of a window."""
    late: list[float] = []
    block = np.random.default_rng(1).normal(size=20_000)

    def on_tick(tick) -> bool:
        late.append(1e3 * tick.late_s)
        np.sort(block)
        return True

    tick_loop(Run(), RATE_Hz, WINDOW_S, on_tick)
    return np.array(late)


@contextmanager
def at_ordinary_priority(journals: list[Path]) -> Iterator[None]:
    """The worker itself, given the same."""
    worker = subprocess.Popen(
        [sys.executable, "-m", "rig.batch.execute.postprocess_worker"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    lines = [json.dumps({"journal": str(journals[k % len(journals)])}) for k in range(JOBS)]
    worker.stdin.write("\n".join(lines) + "\n")
    worker.stdin.flush()
    worker.stdout.readline()
    yield
    worker.kill()
    worker.communicate()


@pytest.mark.parametrize("cores", [len(os.sched_getaffinity(0)), 1])
def test_lateness_of_the_tick_loop(tmp_path, cores):
    everything = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(everything)[:cores])
    try:
        journals = []
        for number in range(3):
            journal = tmp_path / f"r{number}.rigj"
            volts = {"trial-001": trials.slipping(ROWS, seed=number)}
            trials.write_trials(journal, volts, complete=False, procedure="import")
            journals.append(journal)
        found = measured(journals)
    finally:
        os.sched_setaffinity(0, everything)
    heading(f"tick loop at {RATE_Hz:g} Hz, {cores} processors, {ROUNDS} windows of {WINDOW_S:g} s")
    alone = summary(found["alone"])
    for name, windows in found.items():
        own = summary(windows)
        told = "  ".join(
            f"{key} {value:7.3f}" + (f" (x{value / alone[key]:.2f})" if alone[key] else "")
            for key, value in own.items()
        )
        print(f"{name:22s} {told}")
    assert all(len(windows) == ROUNDS for windows in found.values())


def summary(windows: list[np.ndarray]) -> dict[str, float]:
    """Percentiles in ms and the share of late ticks in %, each the median over the windows."""
    return {
        **{f"p{p}": float(np.median([np.percentile(w, p) for w in windows])) for p in (50, 95, 99)},
        "max": float(np.median([w.max() for w in windows])),
        "late %": float(np.median([100 * (w > 1e3 * LATE / RATE_Hz).mean() for w in windows])),
    }


def measured(journals: list[Path]) -> dict[str, list[np.ndarray]]:
    """Lateness in the windows of each condition. They take turns, but for those alone, of which
    half come before and half after: to begin takes the worker a while."""
    alone = [lateness_ms() for _ in range(ROUNDS // 2)]
    steward = Afterwards()
    for k in range(JOBS):
        steward.give(Job(journals[k % len(journals)]))
    begun = time.monotonic()
    while not steward.answers():
        assert time.monotonic() - begun < WARM_S, "the worker is at work"
        time.sleep(0.1)
    done = 0
    found: dict[str, list[np.ndarray]] = {"held": [], "at work": [], "at ordinary priority": []}
    for _ in range(ROUNDS):
        steward.hold()
        time.sleep(0.5)
        found["held"].append(lateness_ms())
        steward.answers()
        steward.go()
        found["at work"].append(lateness_ms())
        done += len(steward.answers())
        steward.hold()
        with at_ordinary_priority(journals):
            found["at ordinary priority"].append(lateness_ms())
    steward.close(0.1)
    alone += [lateness_ms() for _ in range(ROUNDS - len(alone))]
    print(f"\n{done} runs worked on in {ROUNDS * WINDOW_S:g} s beside the loop")
    return {"alone": alone, **found}
