"""What recording and compiling cost: prints figures, judges no times.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_recording.py``.
"""

import time

import numpy as np
import pytest
import recorded_run as run
from measured import heading

from rig.files.journal.reader import read_journal
from rig.files.journal.recorder import Recorder
from rig.files.journal.writer import JournalWriter
from rig.files.runfile.compile import compile_run, journal_equals_file
from rig.files.verify import verify

pytestmark = [pytest.mark.benchmark, pytest.mark.short]

READING = {f"quantity_{k}": 1.0 / (k + 3) for k in range(20)}


def sine_counts(rows):
    """Two channels of a noisy sine, int16: what a sweep records."""
    rng = np.random.default_rng(0)
    wave = 8000 * np.sin(np.arange(rows) * 0.01)[:, None] + rng.normal(0, 20, (rows, 2))
    return wave.astype("<i2")


def test_points_per_second(tmp_path):
    count = 20_000
    heading(f"{count} points of {len(READING)} numbers")
    ids = [f"p{n}" for n in range(count)]
    recorder = Recorder(JournalWriter.create(tmp_path / "a.rigj", run.header(points=ids)))
    costs = np.empty(count)
    start = time.perf_counter()
    for n, point in enumerate(ids):
        before = time.perf_counter()
        recorder.put_point_begin(point, {"time": 0.1 * n})
        recorder.put_point_keep(point, READING)
        costs[n] = time.perf_counter() - before
    recorder.close()
    wall = time.perf_counter() - start
    median, slow = 1e6 * np.quantile(costs, [0.5, 0.99])
    print(f"\n{count / wall:.0f} points/s, put {median:.1f} us median, {slow:.1f} us at 99 %")


def test_journal_and_compile_megabytes_per_second(tmp_path):
    block, blocks = sine_counts(25_000), 1000
    heading(f"one point of {blocks} blocks of 25000 samples of two channels")
    path = tmp_path / "a.rigj"
    start = time.perf_counter()
    with Recorder(JournalWriter.create(path, run.header())) as recorder:
        recorder.put_point_begin("p", {})
        recorder.put_stream(run.state())
        for n in range(blocks):
            recorder.put_block(0, n * len(block), 0.1 * n, block)
        recorder.put_point_keep("p", READING)
        recorder.put_end(run.end())
    megabytes = block.nbytes * blocks / 1e6
    print(f"\njournal of {megabytes:.0f} MB: {megabytes / (time.perf_counter() - start):.0f} MB/s")
    for what, act in (
        ("read_journal", lambda: read_journal(path)),
        ("compile_run with its check", lambda: compile_run(path)),
        ("the check alone", lambda: journal_equals_file(path, path.with_suffix(".h5"))),
        ("verify", lambda: verify(path.with_suffix(".h5"))),
    ):
        start = time.perf_counter()
        act()
        print(f"{what}: {megabytes / (time.perf_counter() - start):.0f} MB/s")


def test_compile_of_a_long_sweep(tmp_path):
    heading("compile 2000 points of 4000 samples of two channels")
    ids = [f"p{n}" for n in range(2000)]
    data = sine_counts(4000)
    path = tmp_path / "a.rigj"
    with Recorder(JournalWriter.create(path, run.header(points=ids))) as recorder:
        for n, point in enumerate(ids):
            recorder.put_point_begin(point, {"time": float(n)})
            recorder.put_stream(run.state())
            recorder.put_block(0, 0, float(n), data)
            recorder.put_point_keep(point, READING | {"frequency_Hz": float(n)})
        recorder.put_end(run.end())
    start = time.perf_counter()
    file = compile_run(path)
    wall = time.perf_counter() - start
    size, raw = file.stat().st_size / 1e6, path.stat().st_size / 1e6
    print(f"\n2000 points of 2 x 4000 samples: {wall:.1f} s, {raw:.0f} MB to {size:.0f} MB")
