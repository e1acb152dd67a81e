"""From the death of a run, and from its hanging, to generator off and stage at rest, in real time.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_guard.py``; `RIG_REPEATS=6` for a
look, every second one while the stage moves.
"""

from __future__ import annotations

import json
import random
import signal
import time
import tomllib

import pytest
from measured import heading, repeats, row

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(3000)]

REPEATS = repeats(20)
PATIENCE_S = 60.0
POLL_S = 0.002
LATEST_S = 0.5
"""After the stage has begun to move, or the generator to drive, the run is struck so late."""
SIXTY_POINTS = ("--frequencies", ",".join(str(f) for f in range(300, 6300, 100)))
IN_MOTION = {"move", "jog", "homing"}
AT_REST = {"at-rest", "fixed-stop", "fault"}


class LiveLog:
    """The World's log as it grows; when each line was seen, on this computer's clock."""

    def __init__(self, path):
        self._path = path
        self.entries = []

    def look(self):
        """Take what is new."""
        now = time.monotonic()
        lines = self._path.read_text().splitlines() if self._path.exists() else []
        self.entries += [(now, json.loads(line)) for line in lines[len(self.entries) :]]

    def wait(self, fits):
        """Look until an entry that is yet to come fits."""
        self.look()
        seen = len(self.entries)
        deadline = time.monotonic() + PATIENCE_S
        while not any(fits(entry) for _, entry in self.entries[seen:]):
            assert time.monotonic() < deadline, "the World's log says nothing of it"
            time.sleep(POLL_S)
            self.look()

    def state(self):
        """Whether the generator drives and whether the stage moves, by the last word on each."""
        drives = moves = False
        for _, entry in self.entries:
            if entry["what"] == "ch1.on":
                drives = entry["value"]
            moves = (moves or entry["what"] in IN_MOTION) and entry["what"] not in AT_REST
        return drives, moves

    def last(self, fits):
        """When the last entry that fits was seen."""
        return max(seen for seen, entry in self.entries if fits(entry))


def is_off(entry):
    return entry["what"] == "ch1.on" and entry["value"] is False


def strike(rig, bench_file, log, number, moving, wait_s):
    """Start a sweep, strike it with a signal while the stage moves or the generator drives.

    Gives seconds from the signal to generator off and to stage at rest, None where that was so.
    """
    here = type(rig)(rig.folder / f"{number.name}-{moving}-{wait_s:.6f}")
    here.folder.mkdir()
    running = here.start("sweep", "--bench", str(bench_file), "--no-figures", *SIXTY_POINTS)
    log.wait(lambda e: e["what"] in IN_MOTION if moving else e["what"] == "ch1.on" and e["value"])
    time.sleep(wait_s)
    log.look()
    drives, moves = log.state()
    running.send(number)
    struck = time.monotonic()
    report = here.results / "guard-simulated.json"
    while not report.exists() or "file" not in json.loads(report.read_text()):
        assert time.monotonic() < struck + PATIENCE_S, "the guard never reported"
        time.sleep(POLL_S)
        log.look()
    running.process.wait(PATIENCE_S)
    assert json.loads(report.read_text())["safe"] is True
    assert log.state() == (False, False)
    here.close()
    return (
        log.last(is_off) - struck if drives else None,
        log.last(lambda e: e["what"] in AT_REST) - struck if moves else None,
    )


@pytest.mark.parametrize(("number", "name"), [(signal.SIGKILL, "killed"), (signal.SIGSTOP, "hung")])
def test_from_the_end_of_a_run_to_a_bench_at_rest(rig, number, name):
    chance = random.Random(0)
    bench_file = rig.folder / "bench.toml"
    serving = rig.start("simulate", "--write", str(bench_file), "--world-log", str(rig.world_log))
    serving.wait_for("Ctrl-C ends it")
    heartbeat_s = tomllib.loads(bench_file.read_text()).get("heartbeat_timeout_s", 5.0)
    heading(f"rig sweep in real time, {name}; heartbeat_timeout_s {heartbeat_s:g}")
    log = LiveLog(rig.world_log)
    struck = [
        strike(rig, bench_file, log, number, k % 2 == 0, chance.uniform(0.0, LATEST_S))
        for k in range(REPEATS)
    ]
    for k, what in enumerate(("generator off", "stage at rest")):
        found = [delays[k] for delays in struck if delays[k] is not None]
        if found:
            row(f"{name} to {what}", found, "s")
    serving.send(signal.SIGINT)
    assert serving.finish().code == 0
