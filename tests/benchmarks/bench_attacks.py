"""Attacks on the wire, and random trials under every kind of fault on every combination of stages:
what each became, what it broke, and how long anything stayed pressed after it; attacks by late
answers, in real time; and attacks on batches of two or three runs.

Run with ``pytest -m benchmark -n 0 -s "tests/benchmarks/bench_attacks.py::NAME[attacks]"``, or
``[wide]``, ``[late]`` or ``[batches]``; NAME is that of the one test. One process, one trial after
the other, for `RIG_SERIES_S` seconds (600) or `RIG_REPEATS` trials (1000), with seeds from
`RIG_FIRST` (1).
With `RIG_REGISTER=FILE` each is appended to that file as soon as it has ended, and those that it
has already are left out: a series is made in pieces (`soak.register`, which also prints the figures
of all pieces). ``RIG_FIRST=SEED RIG_REPEATS=1`` without a file runs one again. What is judged is
what `soak.invariants` judges, by the World's own log: nothing left pressed and unsaid, every
recorded row one that was sent, exit codes, sound files.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest
from measured import heading, repeats
from soak import register
from soak.attacks import attack, left_pressed
from soak.batches import batch_attack, batch_breaches, run_batch
from soak.invariants import breaches, left_unsaid
from soak.late import late_attack, late_breaches, run_late
from soak.running import run, run_series
from soak.trials import draw_wide

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(36_000)]

FIRST = int(os.environ.get("RIG_FIRST", "1"))
TIME_S = float(os.environ.get("RIG_SERIES_S", "600"))
PATIENCE_S = 900.0
"""At the lowest priority beside other work a trial of 20 s takes minutes."""
FILE = os.environ.get("RIG_REGISTER")
SERIES = {
    "attacks": (attack, run, lambda ran: [*breaches(ran), *left_pressed(ran), *left_unsaid(ran)]),
    "wide": (draw_wide, run, breaches),
    "late": (late_attack, run_late, late_breaches),
    "batches": (batch_attack, run_batch, batch_breaches),
}


@pytest.mark.parametrize("series", SERIES)
def test_a_series_of_trials_breaks_nothing(series: str, tmp_path: Path) -> None:
    heading(f"{series}, seeds from {FIRST}")
    draw, take, judge = SERIES[series]
    seeds = range(FIRST, FIRST + repeats(1000))
    file = Path(FILE) if FILE else None
    until_s = time.monotonic() + TIME_S
    entries = run_series(series, seeds, draw, judge, tmp_path, file, until_s, PATIENCE_S, take)
    print("\n" + register.figures(entries))
    assert not [one.seed for one in entries if one.violations]
