"""Attacks on the wire at length: what each became, what it broke, and how long anything stayed
pressed after it.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_attacks.py``. One process, one attack
after the other, for `RIG_ATTACKS_S` seconds (600) or `RIG_REPEATS` attacks (1000), with seeds from
`RIG_FIRST` (1). Each is a line in the file `RIG_ATTACKS_FILE`, appended: seed, exit code, seconds
from the fault until nothing was pressed, what was broken, and the attack; with
`RIG_FIRST=SEED RIG_REPEATS=1` it is run again. What is judged is what `soak.invariants` judges, by
the World's own log: nothing left pressed and unsaid, every recorded row one that was sent, exit
codes, sound files.
"""

from __future__ import annotations

import os
import shutil
import time
from collections import defaultdict
from pathlib import Path

import pytest
from forked_rig import server
from measured import heading, repeats
from soak.attacks import KINDS, attack, left_pressed, pressed_after_s
from soak.invariants import breaches
from soak.running import run

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(36_000)]

FIRST = int(os.environ.get("RIG_FIRST", "1"))
TIME_S = float(os.environ.get("RIG_ATTACKS_S", "600"))
PATIENCE_S = 900.0
"""At the lowest priority beside other work a trial of 20 s takes minutes."""
FILE = os.environ.get("RIG_ATTACKS_FILE")


def test_attacks_on_the_wire_break_nothing(tmp_path: Path) -> None:
    heading(f"attacks on the wire, seeds from {FIRST}")
    give_up_s = time.monotonic() + TIME_S
    pressed: dict[str, list[float]] = defaultdict(list)
    codes: dict[str, list[int]] = defaultdict(list)
    broken = {}
    for seed in range(FIRST, FIRST + repeats(1000)):
        if time.monotonic() > give_up_s:
            break
        drawn = attack(seed)
        ran = run(server(), drawn.trial, tmp_path / str(seed), PATIENCE_S)
        kind = drawn.trial.faults[0]["kind"]
        met = bool(ran.befallen)
        after_s = pressed_after_s(ran)
        if met:
            codes[kind].append(ran.code)
        if after_s is not None:
            pressed[kind].append(after_s)
        found = [*breaches(ran), *left_pressed(ran)]
        if found:
            broken[seed] = found
        else:
            shutil.rmtree(ran.folder)
        shown = "-" if after_s is None else f"{after_s:.2f}"
        line = f"{seed} {ran.code if met else 'not met'} {shown} {found or 'holds'} {drawn.told}"
        print(line, flush=True)
        if FILE:
            with Path(FILE).open("a") as lines:
                lines.write(line + "\n")
    print(f"\n{'kind':12s} {'met':>5s} {'pressed':>7s} {'longest/s':>9s}  exit codes")
    for kind in KINDS:
        counts = {code: codes[kind].count(code) for code in sorted(set(codes[kind]))}
        longest = f"{max(pressed[kind]):9.2f}" if pressed[kind] else f"{'-':>9s}"
        print(f"{kind:12s} {len(codes[kind]):5d} {len(pressed[kind]):7d} {longest}  {counts}")
    print(f"violations: {len(broken)} of {sum(map(len, codes.values()))} attacks that were met")
    assert not broken
