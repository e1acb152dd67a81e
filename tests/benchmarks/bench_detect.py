"""What `rig detect` gains from processes: the whole command over an archive of recordings.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_detect.py``.
"""

from __future__ import annotations

import subprocess
import time
from pathlib import Path

import pytest
import recorded_trials as trials
from measured import heading, row

pytestmark = [pytest.mark.benchmark, pytest.mark.short, pytest.mark.timeout(900)]

RUN = str(Path(__file__).parents[2] / "run")
FILES, ROWS, REPEATS = 24, 60_000, 3


def test_files_side_by_side(tmp_path):
    names = []
    for number in range(FILES):
        run_file = trials.write_trials(
            tmp_path / f"r{number}.rigj", {"trial-001": trials.slipping(ROWS, seed=number)}
        )
        names.append(run_file.name)
    heading(f"rig detect --detector rig ({FILES} recordings of {ROWS / 1000:.0f} s, warm)")
    walls: dict[int, list[float]] = {1: [], 2: []}
    for repeat in range(REPEATS + 1):  # the first compiles the detector
        for jobs in walls:
            to = f"by-{jobs}-{repeat}"
            options = ("--detector", "rig", "--jobs", str(jobs), "--to", to)
            command = [RUN, "rig", "detect", *options, *names]
            start = time.perf_counter()
            subprocess.run(command, cwd=tmp_path, capture_output=True, check=True)
            if repeat:
                walls[jobs].append(time.perf_counter() - start)
    one = row("one after the other", walls[1], "s", 2)
    two = row("two processes", walls[2], "s", 2)
    print(f"gain {one / two:.2f}")
    assert len(list((tmp_path / "by-2-1").glob("*.h5"))) == FILES
