"""How long a person waits: the whole process, from the shell's line to its end.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_startup.py``; `RIG_REPEATS=2` for
two warm starts of each kind.
"""

from __future__ import annotations

import resource
import subprocess
import time
from pathlib import Path

import pytest
from measured import heading, repeats, row, target

pytestmark = [pytest.mark.benchmark, pytest.mark.short, pytest.mark.timeout(600)]

RUN = str(Path(__file__).parents[2] / "run")


def measured(name, arguments, cwd, often):
    """Print wall and processor time of the warm command; gives the median wall time in s and what
    its last run printed to stdout. The processor time says what a busy machine hides."""
    walls, processor = [], []
    for repeat in range(min(often, repeats(often)) + 1):  # the first warms the caches
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        start = time.perf_counter()
        done = subprocess.run(
            [RUN, *arguments], cwd=cwd, capture_output=True, text=True, check=True
        )
        wall = time.perf_counter() - start
        now = resource.getrusage(resource.RUSAGE_CHILDREN)
        if repeat:
            walls.append(wall)
            processor.append(now.ru_utime - used.ru_utime + now.ru_stime - used.ru_stime)
    median = row(f"{name}, wall", walls, "s", 3)
    row(f"{name}, processor time of all processes", processor, "s", 3)
    return median, done.stdout


def test_a_whole_sweep(tmp_path):
    heading("./run rig sweep (141 points, 52 s of bench time, file and figures; warm)")
    median, printed = measured("whole process", ["rig", "sweep"], tmp_path, 7)
    target("./run rig sweep", median, 10, "s")
    assert (tmp_path / printed.strip()).is_file()

    heading("./run rig sweep --no-figures")
    measured("whole process", ["rig", "sweep", "--no-figures"], tmp_path, 5)
    heading("./run rig sweep --no-figures --frequencies 200.5 (one point)")
    one = ["rig", "sweep", "--no-figures", "--frequencies", "200.5"]
    measured("start to end", one, tmp_path, 7)


def test_help(tmp_path):
    heading("./run rig --help (warm)")
    median, printed = measured("whole process", ["rig", "--help"], tmp_path, 20)
    target("./run rig --help", median, 0.3, "s")
    assert "sweep" in printed

    heading("./run rig sweep --help (warm)")
    _, printed = measured("whole process", ["rig", "sweep", "--help"], tmp_path, 10)
    assert "--load" in printed

    heading("./run true (the script itself)")
    measured("whole process", ["true"], tmp_path, 20)
