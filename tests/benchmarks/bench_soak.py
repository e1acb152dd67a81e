"""The soak at length: what was injected, what became of it, and every invariant that was broken.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_soak.py``. A line ``seed ...`` for
every trial that broke an invariant; its plan is what `soak.trials.draw` makes of the seed. With
`RIG_SEEDS=1169,1200-1209` it runs those alone, with `RIG_REPEATS=100` a hundred instead of a
thousand. Then, by kind and procedure, the largest true force and the longest time over the force
limit: of all trials that it befell, other faults included, and of those that it befell alone.
"""

from __future__ import annotations

import os
import shutil
from collections import Counter, defaultdict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

import pytest
from forked_rig import Server
from measured import heading, repeats
from soak.invariants import Ran, breaches
from soak.running import run
from soak.trials import KINDS, ROTARY_KINDS, TALLER, Trial, draw

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(36_000)]

FIRST_SEED = 1000
"""Beyond those of the tests."""
CHOSEN = os.environ.get("RIG_SEEDS", "")
DRAWN = range(FIRST_SEED, FIRST_SEED + repeats(1000))
SEEDS = (
    [
        seed
        for part in CHOSEN.split(",")
        for first, _, last in [part.partition("-")]
        for seed in range(int(first), int(last or first) + 1)
    ]
    if CHOSEN
    else DRAWN
)
LEAST_OF_EACH = len(SEEDS) // 50
ROLLS = max(1, len(SEEDS) // 5)


@dataclass(frozen=True)
class Pressed:
    """The true force of one trial."""

    largest_N: float
    over_limit_s: float
    """Longest time without a break over the force limit."""
    alone: bool
    """Whether one kind of fault befell it alone."""


def soaked(free: SimpleQueue[Server], trial: Trial, folder: Path) -> tuple[Ran, list[str]]:
    """A trial and what it broke; its files are removed where that is nothing."""
    server = free.get()
    try:
        ran = run(server, trial, folder / str(trial.seed))
    finally:
        free.put(server)
    found = breaches(ran)
    if not found:
        shutil.rmtree(ran.folder)
    return ran, found


def test_random_trials_break_nothing(tmp_path: Path) -> None:
    faults_met = soak([draw(seed, roll_share=0.0) for seed in SEEDS], tmp_path)
    common = [kind for kind in KINDS if kind not in ROTARY_KINDS]
    assert CHOSEN or min(faults_met[kind] for kind in common) >= LEAST_OF_EACH


def test_roll_trials_break_nothing(tmp_path: Path) -> None:
    faults_met = soak([draw(seed, 0.0, 1.0) for seed in SEEDS[:ROLLS]], tmp_path)
    assert CHOSEN or min(faults_met[kind] for kind in ROTARY_KINDS) >= ROLLS // 200


def soak(trials: Sequence[Trial], tmp_path: Path) -> Counter[str]:
    """How many of them each kind befell; fails where one broke an invariant."""
    heading(f"{len(trials)} random trials under random fault plans, seeds from {SEEDS[0]}")
    faults_met: Counter[str] = Counter()
    pressed: dict[tuple[str, str], list[Pressed]] = defaultdict(list)
    became: dict[str, Counter[int]] = defaultdict(Counter)
    codes: Counter[tuple[str, int]] = Counter()
    broken: dict[int, list[str]] = {}
    free: SimpleQueue[Server] = SimpleQueue()
    servers = [Server() for _ in os.sched_getaffinity(0)]
    for server in servers:
        free.put(server)
    with ThreadPoolExecutor(len(servers)) as pool:
        for ran, found in pool.map(lambda trial: soaked(free, trial, tmp_path), trials):
            codes[ran.trial.procedure, ran.code] += 1
            kinds = {kind for _, kind in ran.faults_met}
            for kind in kinds:
                faults_met[kind] += 1
                became[kind][ran.code] += 1
                pressed[kind, ran.trial.procedure].append(
                    Pressed(ran.largest_N, ran.over_limit_s, kinds == {kind})
                )
            if found:
                broken[ran.trial.seed] = found
                print(f"seed {ran.trial.seed}: {'; '.join(found)}", flush=True)
    for server in servers:
        server.close()
    shown = sorted({code for _, code in codes})
    print(f"\n{'kind':16s} {'trials':>6s}  " + " ".join(f"exit {code:<4d}" for code in shown))
    for kind in (*KINDS, TALLER):
        row = " ".join(f"{became[kind][code]:<9d}" for code in shown)
        print(f"{kind:16s} {faults_met[kind]:6d}  {row}")
    for procedure in sorted({name for name, _ in codes}):
        row = " ".join(f"{codes[procedure, code]:<9d}" for code in shown)
        print(f"{procedure:16s} {sum(codes[procedure, c] for c in shown):6d}  {row}")
    print_forces(pressed)
    print(f"violations: {len(broken)} of {len(trials)} trials")
    assert not broken
    return faults_met


def print_forces(pressed: dict[tuple[str, str], list[Pressed]]) -> None:
    """Print the largest true force and the longest time over the limit, by kind and procedure."""
    columns = f"{'n':>5s} {'largest/N':>9s} {'over/s':>7s}"
    print(f"\n{'kind':16s} {'procedure':12s} {columns}   alone: {columns}")
    for (kind, procedure), trials in sorted(pressed.items()):
        row = "          ".join(
            f"{len(some):5d} {max((one.largest_N for one in some), default=0.0):9.2f} "
            f"{max((one.over_limit_s for one in some), default=0.0):7.3f}"
            for some in (trials, [one for one in trials if one.alone])
        )
        print(f"{kind:16s} {procedure:12s} {row}")
