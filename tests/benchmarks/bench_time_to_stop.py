"""Time from a cause to output off and to standstill, in every state of a run, by the World's log.

In virtual time: what a stop takes of bench time, without the computer's own delays, which
`bench_trip.py` measures. Run with ``pytest -m benchmark -n 0 -s
tests/benchmarks/bench_time_to_stop.py``; `RIG_REPEATS=1` for one instant of each state instead of
five. It prints the tables of docs/safety.md. A batch is measured in real time, since signals pass
between processes: there the computer's own delays are included.
"""

from __future__ import annotations

import numpy as np
import pytest
from measured import heading, repeats
from stops import (
    CAUSES,
    NOTHING_FOLLOWS,
    REAL_STATES,
    SIGNALS,
    STATES,
    stopped,
    stopped_in_real_time,
)

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(3000)]

LATER_S = (0.0, 0.013, 0.037, 0.061, 0.083)
"""By how much later than the state's instant the cause is."""


def shown(values):
    """Median and worst in s; a dash for what was not on or not in motion."""
    known = [value for value in values if value is not None]
    return f"{np.median(known):.2f}, {max(known):.2f}" if known else "-"


@pytest.mark.parametrize("name", STATES)
def test_time_to_stop_in_every_state(rig, name):
    heading("stops in virtual time, festo stages, U2331A; median, worst in s")
    count = min(repeats(5), len(LATER_S))
    print("| state | cause | n | in motion | generator off | standstill | z clear, at rest |")
    print("|---|---|---|---|---|---|---|")
    for cause in CAUSES:
        if (name, cause) == NOTHING_FOLLOWS:
            continue
        folders = [rig.folder / f"{name}-{cause}-{k}" for k in range(count)]
        stops = []
        for folder, later_s in zip(folders, LATER_S, strict=False):
            folder.mkdir()
            stops.append(stopped(type(rig)(folder), STATES[name], cause, later_s)[1])
        off, still, clear = (
            shown([getattr(stop, what) for stop in stops])
            for what in ("generator_off_s", "still_s", "clear_s")
        )
        if cause == "force limit":
            clear = "-"  # the point is taken once more
        moving = ", ".join(stops[0].moving) or "nothing"
        print(f"| {name} | {cause} | {count} | {moving} | {off} | {still} | {clear} |", flush=True)


@pytest.mark.parametrize("cause", [*SIGNALS, "interlock"])
@pytest.mark.parametrize("name", REAL_STATES)
def test_time_to_stop_of_a_batch(rig, name, cause):
    heading("stops in real time, festo stages, U2331A; median, worst in s")
    found = []
    for k, later_s in enumerate(LATER_S[: repeats(5)]):
        folder = rig.folder / str(k)
        folder.mkdir()
        one = type(rig)(folder)
        found.append(stopped_in_real_time(one, REAL_STATES[name], cause, later_s))
        one.close()
    off, clear = (
        shown([getattr(one.stop, what) for one in found]) for what in ("generator_off_s", "clear_s")
    )
    begun, ended = max(one.driven for one in found), shown([one.ended_s for one in found])
    print("| state | cause | n | begun after it | generator off | z clear | command ended |")
    print("|---|---|---|---|---|---|---|")
    print(f"| {name} | {cause} | {len(found)} | {begun} | {off} | {clear} | {ended} |", flush=True)
    if name.startswith("between"):
        assert begun == 0, "the cause fell into a run, or something was begun after it"
    code = 128 + SIGNALS[cause] if cause in SIGNALS else 4
    assert {one.code for one in found} == {code}
