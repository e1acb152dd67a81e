"""Power cuts and kills while a run records: files that are unreadable, lost or invented samples.

The journal of a real sweep is replayed: every prefix of its writes, and the files that a disk may
hold after a power cut. HDF5 files of the same samples, flushed and in SWMR mode, are cut beside it,
so that the cuts are known to hurt. Then recorders are killed at random instants.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_power_cut.py``; `RIG_REPEATS=30`
for 30 kills instead of 300 and ten times as many power cuts.
"""

from __future__ import annotations

import multiprocessing
import random
import time
from multiprocessing.connection import Connection

import numpy as np
import pytest
import recorded_run
from measured import heading, repeats
from power_cut import JournalStates, Sync, Tally, hdf5_power_cuts, recovered_samples, trace_rig

from rig.core.errors import RigError
from rig.files.journal.recorder import Recorder
from rig.files.journal.writer import JournalWriter

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(7200)]

KILLS = repeats(300)
POWER_CUTS = 10 * KILLS
BLOCK_ROWS = 100
BLOCKS_A_BARRIER = 5
LONGEST_LIFE_S = 0.4


def test_power_cuts(rig, tmp_path):
    heading("rig sweep --frequencies 2,2.5,3,4,10,100,1000")
    run = trace_rig(rig, "sweep", "--no-figures", "--frequencies", "2,2.5,3,4,10,100,1000")
    size, syncs = run.ends[-1], sum(isinstance(call, Sync) for call in run.calls)
    print(
        f"{len(run.samples)} rows, {size >> 10} KiB, {len(run.calls)} calls, {syncs} of them syncs"
    )
    journal = JournalStates(run, tmp_path / "cut.rigj")
    journal.prefixes()
    print(f"journal, every prefix:      {journal.tally}")
    cuts = JournalStates(run, tmp_path / "cut.rigj")
    cuts.power_cuts(POWER_CUTS, random.Random(0))
    print(f"journal, power cuts:        {cuts.tally}")
    for name, swmr in (("h5py with flush", False), ("h5py in SWMR mode", True)):
        beside = hdf5_power_cuts(run, tmp_path / "cut.h5", POWER_CUTS, random.Random(0), swmr=swmr)
        print(f"{name + ', power cuts:':27s} {beside}")
        assert beside.failed > 0
    assert journal.tally.failed == 0
    assert cuts.tally.failed == 0


def rows_of(block: int) -> np.ndarray:
    """The block's rows, which say where they belong."""
    first = BLOCK_ROWS * block
    count = np.arange(first, first + BLOCK_ROWS, dtype=np.int64)
    return np.stack([count & 0x7FFF, count >> 15], axis=1).astype("<i2")


def record_for_ever(path: str, acknowledged: Connection) -> None:
    """Record blocks until killed; tell the rows of each barrier that has returned."""
    recorder = Recorder(JournalWriter.create(path, recorded_run.header()))
    recorder.put_point_begin("p", {})
    for block in range(10**9):
        recorder.put_block(0, BLOCK_ROWS * block, 1e-3 * block, rows_of(block))
        if block % BLOCKS_A_BARRIER == BLOCKS_A_BARRIER - 1:
            recorder.barrier()
            acknowledged.send(BLOCK_ROWS * (block + 1))


def test_kills(tmp_path):
    chance, tally, written = random.Random(0), Tally(), []
    server = multiprocessing.get_context("forkserver")
    server.set_forkserver_preload(["recorded_run", "rig.files.journal.recorder"])
    true = np.concatenate([rows_of(block) for block in range(20_000)])
    for kill in range(KILLS):
        path = tmp_path / f"{kill}.rigj"
        hears, tells = server.Pipe(duplex=False)
        recording = server.Process(target=record_for_ever, args=(str(path), tells))
        recording.start()
        tells.close()
        acknowledged = hears.recv()
        time.sleep(chance.uniform(0.0, LONGEST_LIFE_S))
        recording.kill()
        recording.join()
        try:
            while True:
                acknowledged = hears.recv()
        except EOFError:
            hears.close()
        try:
            found, _ = recovered_samples(path)
        except RigError as error:
            tally.unread(error.message)
            continue
        tally.judge(found, true, acknowledged)
        written.append(len(found) - acknowledged)
    print(f"\n{KILLS} kills -9: {tally}")
    beyond = f"median {np.median(written):.0f}, at most {max(written)}"
    print(f"rows found beyond the acknowledged: {beyond}")
    assert tally.failed == 0
