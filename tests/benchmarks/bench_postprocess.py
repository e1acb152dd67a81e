"""What making the files of an earlier run costs the tick loop: lateness of its ticks.

The loop of `rig.control.tick_loop` on the wall clock, 100 ticks a second with a millisecond's work
in each, in windows that take turns: alone, and with processes of
`rig.batch.execute.postprocess` at work, one after the other. On all processors, and with everything
on one. A batch overlaps with at most one such process a run, and only where a rest is shorter than
the process: the window shows the worst of it.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_postprocess.py``; `RIG_REPEATS=2`
for two windows of each kind instead of four.
"""

from __future__ import annotations

import itertools
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np
import pytest
import recorded_trials as trials
from measured import heading, repeats

from rig.batch.execute.postprocess import PostprocessJob, PostprocessQueue, PostprocessResult
from rig.control.tick_loop import LATE, tick_loop
from rig.core.clock import WallClock

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(1800)]

RATE_Hz, WINDOW_S, ROUNDS = 100.0, 10.0, repeats(4)
ROWS = 20_000


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
def at_work(journals: list[Path], log: IO[bytes]) -> Iterator[list[PostprocessResult]]:
    """Processes that make files, one after the other; gives what they have come to so far."""
    queue = PostprocessQueue(log)
    done: list[PostprocessResult] = []
    ending = threading.Event()

    def keep_at_work() -> None:
        for journal in itertools.cycle(journals):
            queue.add(PostprocessJob(journal))
            while len(queue) and not ending.wait(0.05):
                if (result := queue.poll(start=True)) is not None:
                    done.append(result)
            if ending.is_set():
                return

    thread = threading.Thread(target=keep_at_work)
    thread.start()
    try:
        yield done
    finally:
        ending.set()
        thread.join()
        queue.close(0.0)


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
        with (tmp_path / "log").open("ab") as log:
            found = measured(journals, log)
    finally:
        os.sched_setaffinity(0, everything)
    heading(f"tick loop at {RATE_Hz:g} Hz, {cores} processors, {ROUNDS} windows of {WINDOW_S:g} s")
    alone = summary(found["alone"])
    for name, windows in found.items():
        own = summary(windows)
        reported = "  ".join(
            f"{key} {value:7.3f}" + (f" (x{value / alone[key]:.2f})" if alone[key] else "")
            for key, value in own.items()
        )
        print(f"{name:22s} {reported}")
    assert all(len(windows) == ROUNDS for windows in found.values())


def summary(windows: list[np.ndarray]) -> dict[str, float]:
    """Percentiles in ms and the share of late ticks in %, each the median over the windows."""
    return {
        **{f"p{p}": float(np.median([np.percentile(w, p) for w in windows])) for p in (50, 95, 99)},
        "max": float(np.median([w.max() for w in windows])),
        "late %": float(np.median([100 * (w > 1e3 * LATE / RATE_Hz).mean() for w in windows])),
    }


def measured(journals: list[Path], log: IO[bytes]) -> dict[str, list[np.ndarray]]:
    """Lateness in the windows of each condition, in turns."""
    found: dict[str, list[np.ndarray]] = {"alone": [], "files being made": []}
    done = 0
    for _ in range(ROUNDS):
        found["alone"].append(lateness_ms())
        with at_work(journals, log) as results:
            found["files being made"].append(lateness_ms())
            done += len(results)
    print(f"\nfiles of {done} runs made in {ROUNDS * WINDOW_S:g} s beside the loop")
    assert done, "nothing was made beside the loop"
    return found
