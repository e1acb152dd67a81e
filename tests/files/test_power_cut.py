"""The power fails, or the run is killed, while it records: what was acknowledged is there."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import power_cut
import pytest
from power_cut import JournalStates, Sync, Write, hdf5_power_cuts, trace_rig


@pytest.mark.thorough
def test_no_power_cut_loses_or_invents_a_sample_of_a_real_sweep(rig: Any, tmp_path: Path) -> None:
    """HDF5 files of the same samples fail beside it: the cuts are ones that hurt."""
    run = trace_rig(rig, "sweep", "--no-figures", "--frequencies", "5,300")
    assert len(run.kept) == 2
    journal = JournalStates(run, tmp_path / "cut.rigj")
    journal.prefixes()
    journal.power_cuts(9, random.Random(1))

    assert journal.tally.failed == 0, journal.tally
    assert journal.tally.states > 15
    for swmr in (False, True):
        tally = hdf5_power_cuts(run, tmp_path / "cut.h5", 20, random.Random(1), swmr=swmr)
        assert tally.failed > 0, f"swmr {swmr}: {tally}"


def test_a_power_cut_keeps_what_was_synced_and_any_of_the_pages_behind() -> None:
    page = power_cut.PAGE
    calls = [Write(0, b"a" * 100), Sync(), Write(100, b"b" * 5000), Write(5100, b"c" * page)]
    states = {power_cut.power_cut(calls, random.Random(k), 0.5) for k in range(200)}

    assert {state[:100] for state in states} == {b"a" * 100}
    assert {len(state) for state in states} == {100, page, 2 * page, 5100 + page}
    whole = bytes(power_cut.contents(calls))
    assert whole in states
    for state in states:
        for at in range(0, len(state), page):
            piece, before = state[at : at + page], b"a" * 100 if at == 0 else b""
            assert piece in (whole[at : at + len(piece)], before.ljust(len(piece), b"\0"))
