"""The same run twenty times, every second one on a busy machine: one hash.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_determinism.py``; `RIG_REPEATS=4`
for four runs.
"""

from __future__ import annotations

import fnmatch
import hashlib
import os
import subprocess
import sys
import time

import h5py
import numpy as np
import pytest
from measured import heading, repeats, row

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(1800)]

RUNS = repeats(20)
"""Every second one with all cores loaded."""

NOT_COMPARED = (
    "entry/start_time",
    "entry/end_time",
    "entry/identifier_*",  # drawn anew for each run
    "entry/program_name",  # its attributes name the source's state
    "entry/journal_header/data",  # run_uuid, start_time and program
    "entry/blocks/*/host_time",  # when the host stored a block
)
"""Datasets that name the run, the program or the host's time; every other one is hashed."""

NOT_COMPARED_ATTRIBUTES = (
    "file_name",  # names date and time
    "file_time",
    "start",  # of times: the run's start_time
    "host_time",
)
"""Attributes of the same kind; every other one is hashed, too."""


def is_compared(name):
    return not any(fnmatch.fnmatchcase(name, pattern) for pattern in NOT_COMPARED)


def content(file):
    """SHA-256 of every compared dataset with its attributes, and of the groups' attributes."""
    hashes = {}

    def visit(name, item):
        if not is_compared(name):
            return
        digest = hashlib.sha256()
        for key in sorted(set(item.attrs) - set(NOT_COMPARED_ATTRIBUTES)):
            if key not in ("REFERENCE_LIST", "DIMENSION_LIST"):  # addresses inside the file
                digest.update(f"{key}={np.asarray(item.attrs[key]).tolist()!r};".encode())
        if isinstance(item, h5py.Dataset):
            value = item[()]
            digest.update(f"{item.dtype} {item.shape}".encode())
            if item.dtype.kind == "O":  # texts, whose array holds pointers
                digest.update(repr(value.tolist() if item.shape else value).encode())
            else:
                digest.update(np.asarray(value).tobytes())
        hashes[name] = digest.hexdigest()

    with h5py.File(file) as opened:
        opened.visititems(visit)
    return hashes


def all_cores_busy():
    """Processes that do nothing but compute, one a core."""
    cores = len(os.sched_getaffinity(0))
    return [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(cores)]


def test_one_hash(rig):
    heading(f"rig sweep, {RUNS} times, every second one with all cores loaded")
    print("not compared: " + ", ".join((*NOT_COMPARED, *NOT_COMPARED_ATTRIBUTES)))
    walls, found = {False: [], True: []}, []
    for number in range(RUNS):
        loaded = number % 2 == 1
        busy = all_cores_busy() if loaded else []
        try:
            start = time.perf_counter()
            ended = rig.sweep()
            walls[loaded].append(time.perf_counter() - start)
        finally:
            for process in busy:
                process.kill()
                process.wait()
        assert ended.code == 0, ended.stderr
        file = rig.folder / ended.object["file"]
        found.append(content(file))
        file.unlink()
    row("idle", walls[False], "s", 2)
    row("all cores loaded", walls[True], "s", 2)

    first = found[0]
    differing = sorted(
        {name for other in found for name in first if other.get(name) != first[name]}
    )
    whole = {hashlib.sha256(repr(sorted(one.items())).encode()).hexdigest() for one in found}
    print(f"{len(first)} groups and datasets a file; {len(whole)} different hash(es):")
    print("\n".join(sorted(whole)))
    assert all(set(other) == set(first) for other in found)
    assert not differing, differing[:20]
    assert len(whole) == 1
