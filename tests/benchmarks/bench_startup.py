"""How long a person waits: the whole process, from the shell's line to its end.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_startup.py``.
"""

from __future__ import annotations

import subprocess
import time
from pathlib import Path

import pytest
from measured import heading, row, target

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(600)]

RUN = str(Path(__file__).parents[2] / "run")


def walls(arguments, cwd, repeats):
    """Wall times in s of the warm command, and what its last run printed to stdout."""
    times = []
    for repeat in range(repeats + 1):  # the first warms the caches
        start = time.perf_counter()
        done = subprocess.run(
            [RUN, *arguments], cwd=cwd, capture_output=True, text=True, check=True
        )
        if repeat:
            times.append(time.perf_counter() - start)
    return times, done.stdout


def test_a_whole_sweep(tmp_path):
    heading("./run rig sweep (141 points, 52 s of bench time, file and figures; warm)")
    times, printed = walls(["rig", "sweep"], tmp_path, 7)
    median = row("whole process", times, "s", 2)
    target("./run rig sweep", median, 10, "s")
    assert (tmp_path / printed.strip()).is_file()

    heading("./run rig sweep --no-figures")
    row("whole process", walls(["rig", "sweep", "--no-figures"], tmp_path, 5)[0], "s", 2)
    heading("./run rig sweep --no-figures --frequencies 200.5 (one point)")
    one = ["rig", "sweep", "--no-figures", "--frequencies", "200.5"]
    row("start, connect, one point, compile", walls(one, tmp_path, 7)[0], "s", 2)


def test_help(tmp_path):
    heading("./run rig --help (warm)")
    times, printed = walls(["rig", "--help"], tmp_path, 20)
    target("./run rig --help", row("whole process", times, "s"), 0.3, "s")
    assert "sweep" in printed

    heading("./run rig sweep --help (warm)")
    times, printed = walls(["rig", "sweep", "--help"], tmp_path, 10)
    row("whole process", times, "s")
    assert "--amplitude" in printed

    heading("./run true (the script itself)")
    row("whole process", walls(["true"], tmp_path, 20)[0], "s")
