"""Many hostile journals and damaged run files: what became of them, and how long the worst took.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_hostile.py``; `RIG_REPEATS=400`
for fewer journals and a quarter as many run files.
"""

from __future__ import annotations

import collections
import time

import pytest
import recorded_run as run
from hostile import damaged, journals
from hypothesis import HealthCheck, given, settings
from measured import heading, repeats

from rig.core.errors import RigError
from rig.files.errors import RunFileError
from rig.files.runfile.compile import compile_run
from rig.files.runfile.recover import recover
from rig.files.verify import verify, verify_in_child

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(7200)]

JOURNALS = repeats(2000)
many = settings(
    deadline=None, database=None, derandomize=True, suppress_health_check=list(HealthCheck)
)


def test_journals(tmp_path):
    outcomes, slowest = collections.Counter(), 0.0
    path = tmp_path / "given.rigj"

    @settings(many, max_examples=JOURNALS)
    @given(journal=journals())
    def one(journal):
        nonlocal slowest
        for left in tmp_path.iterdir():
            left.unlink()
        path.write_bytes(journal)
        begin = time.perf_counter()
        try:
            assert verify(recover(path)) == []
            outcomes["recovered and sound"] += 1
        except RigError as error:
            outcomes[f"refused: {type(error).__name__}"] += 1
        slowest = max(slowest, time.perf_counter() - begin)

    heading("recover of journals with right checksums and wrong contents")
    one()
    print(f"{dict(outcomes)}, the slowest {slowest:.1f} s")


def test_damaged_run_files(tmp_path):
    """In processes of their own: HDF5 hangs on some and may crash on others."""
    whole = compile_run(run.write_run(tmp_path / "whole.rigj", order=(0, 1))).read_bytes()
    outcomes = collections.Counter()
    file = tmp_path / "given.h5"

    @settings(many, max_examples=JOURNALS // 4)
    @given(harmed=damaged(whole))
    def one(harmed):
        file.write_bytes(harmed)
        try:
            findings = verify_in_child(file, patience_s=15.0)
            outcomes["findings" if len(findings) > 1 else "nothing but the missing checksum"] += 1
        except RunFileError as error:
            outcomes["hang" if "hangs on it" in error.reason else error.reason] += 1

    heading("verify of run files whose bytes were changed, cut or copied")
    one()
    print(dict(outcomes))
    assert not any("(error" in outcome for outcome in outcomes), "not HDF5 has died"
