"""A queue of 100 000 runs: writing it, asking how far it is, taking a run: time and memory.

./run python tests/benchmarks/bench_batch_queue.py      RIG_RUNS=100000
"""

from __future__ import annotations

import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.measured import machine

from rig.batch.folder import BatchFolder
from rig.batch.plan.conditions import BatchCondition, BatchPlan, PlannedRun
from rig.batch.queue import Queue
from rig.batch.queue_records import AttemptResult, RunEstimate
from rig.batch.report.status import status_of

RUNS = int(os.environ.get("RIG_RUNS", "100000"))
CONDITIONS = 1000
TAKEN = 2000
META = {"name": "large", "state": "running", "simulated": "yes", "begun": "2026-11-22T00:00:00"}
RIG = [sys.executable, "-c", "from rig.cli import main; main()"]


def plan() -> BatchPlan:
    """As many runs as are asked for, of a thousand conditions."""
    names = [f"sweep-{k:04d}" for k in range(CONDITIONS)]
    made = {
        name: BatchCondition(name, 0, "sweep", {"load_N": float(k)}, {"load_N": float(k)})
        for k, name in enumerate(names)
    }
    runs = (PlannedRun(k + 1, names[k % CONDITIONS], k // CONDITIONS + 1) for k in range(RUNS))
    return BatchPlan(made, tuple(runs))


def times_ms(act: Callable[[], object], count: int) -> str:
    """Median and range of so many calls."""
    found = []
    for _ in range(count):
        since = time.perf_counter()
        act()
        found.append(1e3 * (time.perf_counter() - since))
    return f"median {statistics.median(found):.1f} ms ({min(found):.1f} to {max(found):.1f})"


def memory_MiB() -> float:  # noqa: N802 - the unit keeps its capital
    """Most that this process has had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def take(queue: Queue) -> None:
    """Claim and finish the next run, as a worker does."""
    upcoming = queue.upcoming()
    assert upcoming is not None
    claim = queue.claim(upcoming.number)
    queue.finish(claim, AttemptResult("complete", bench_s=8.0, summary={"points": 3}), "done")


def main() -> None:
    """Measure and tell."""
    print(machine())
    with tempfile.TemporaryDirectory(prefix="rig-queue-") as name:
        folder = BatchFolder(Path(name))
        made = plan()
        since = time.perf_counter()
        estimates = dict.fromkeys(made.conditions, RunEstimate(8.0, 0.3, 300_000))
        queue = Queue.create(folder.queue, made, estimates, META)
        print(f"{RUNS} runs written in {time.perf_counter() - since:.2f} s, ", end="")
        print(f"{folder.queue.stat().st_size / 1e6:.1f} MB")
        del made
        before = memory_MiB()
        print(f"taking a run (two synchronised transactions): {times_ms(lambda: take(queue), 200)}")
        for _ in range(TAKEN):
            take(queue)
        print(f"memory before {before:.0f} MiB, after {TAKEN + 200} runs {memory_MiB():.0f} MiB")
        print(f"status, asked: {times_ms(lambda: status_of(folder), 20)}")
        print(f"all rows: {times_ms(lambda: sum(1 for _ in queue.rows()), 3)}", end="")
        print(f", memory {memory_MiB():.0f} MiB")
        status = [*RIG, "batch", "status", name]
        run = lambda words: subprocess.run(words, check=True, stdout=subprocess.DEVNULL)  # noqa: E731
        print(f"rig batch status, whole process: {times_ms(lambda: run(status), 15)}")
        bare = [sys.executable, "-c", "import typer, sqlite3"]
        print(f"Python with typer and sqlite3 alone: {times_ms(lambda: run(bare), 15)}")


if __name__ == "__main__":
    main()
