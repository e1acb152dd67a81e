"""Time from a cause to output off and to standstill, in every state of a run, by the World's log.

In virtual time: what a stop takes of bench time, without the computer's own delays, which
`bench_trip.py` measures. Run with ``pytest -m benchmark -n 0 -s
tests/benchmarks/bench_time_to_stop.py``; `RIG_REPEATS=1` for one instant of each state instead of
three. It prints the table of docs/safety.md.
"""

from __future__ import annotations

import numpy as np
import pytest
from measured import heading, repeats
from stops import CAUSES, STATES, stopped

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(3000)]

LATER_S = (0.0, 0.013, 0.037, 0.061, 0.083)
"""By how much later than the state's instant the cause is."""


def shown(values):
    """Median and worst in s; a dash for what was not on or not in motion."""
    known = [value for value in values if value is not None]
    return f"{np.median(known):.2f}, {max(known):.2f}" if known else "-"


def test_time_to_stop_in_every_state(rig):
    heading("stops in virtual time, festo stages, U2331A; median, worst in s")
    count = min(repeats(3), len(LATER_S))
    print("| state | cause | n | in motion | generator off | standstill | z clear, at rest |")
    print("|---|---|---|---|---|---|---|")
    for name, state in STATES.items():
        for cause in CAUSES:
            folders = [rig.folder / f"{name}-{cause}-{k}" for k in range(count)]
            stops = []
            for folder, later_s in zip(folders, LATER_S, strict=False):
                folder.mkdir()
                stops.append(stopped(type(rig)(folder), state, cause, later_s)[1])
            off, still, clear = (
                shown([getattr(stop, what) for stop in stops])
                for what in ("generator_off_s", "still_s", "clear_s")
            )
            if cause == "force limit":
                clear = "-"  # the point is taken once more
            moving = ", ".join(stops[0].moving) or "nothing"
            print(
                f"| {name} | {cause} | {count} | {moving} | {off} | {still} | {clear} |", flush=True
            )
