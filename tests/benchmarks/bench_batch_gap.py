"""From the last sample of a run to the first motion of the next, over sockets, in real time:
a batch of short runs on a bench that `rig simulate` serves, timed by the World's own log.

    ./run python tests/benchmarks/bench_batch_gap.py      RIG_RUNS=12 RIG_PROCEDURE=slip-trial
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.measured import machine
from nights import ask, folder_of

RUNS = int(os.environ.get("RIG_RUNS", "12"))
PROCEDURE = os.environ.get("RIG_PROCEDURE", "slip-trial")
FIXTURE = {"sweep": "film-clamp", "slip-trial": "plate", "roll-trial": "semi-spherical-object"}
SHORT = {"sweep": "{ frequencies_Hz = [180, 200, 220] }"}
RIG = [sys.executable, "-c", "from rig.cli import main; main()"]


def gaps_s(log: Path) -> Iterator[float]:
    """Last frame of the force sensor to the next motion that somebody commands."""
    ended_us: int | None = None
    begun = False
    for line in log.read_text().splitlines():
        entry = json.loads(line)
        if entry["what"] == "streaming":
            if begun and not entry["value"]:
                ended_us = entry["t_us"]
            begun = begun or entry["value"]
        elif entry["what"] == "move" and ended_us is not None:
            yield (entry["t_us"] - ended_us) * 1e-6
            ended_us = None


def main() -> None:
    """Serve, run, tell."""
    print(machine())
    with tempfile.TemporaryDirectory(prefix="rig-gap-") as name:
        folder = Path(name)
        log = folder / "world.jsonl"
        serve = ["simulate", "--fixture", FIXTURE[PROCEDURE], "--world-log", str(log)]
        bench = subprocess.Popen(
            [*RIG, *serve, "--write", "bench.toml"], cwd=folder, stderr=subprocess.DEVNULL
        )
        try:
            while not (folder / "bench.toml").exists():
                time.sleep(0.1)
            (folder / "night.toml").write_text(
                f'[batch]\nname = "gaps"\n[[experiment]]\nprocedure = "{PROCEDURE}"\n'
                f"settings = {SHORT.get(PROCEDURE, '{}')}\nrepeat = {RUNS}\n"
            )
            since = time.monotonic()
            batch = subprocess.run(
                [*RIG, "batch", "run", "night.toml", "--bench", "bench.toml"],
                cwd=folder,
                capture_output=True,
                text=True,
                check=False,
            )
            wall_s = time.monotonic() - since
        finally:
            bench.terminate()
            bench.wait()
        found = sorted(gaps_s(log))
        queue = folder_of(folder / "results")
        states = ask(queue, "SELECT state, count(*) FROM run GROUP BY state")
        print(f"{PROCEDURE}: exit code {batch.returncode}, runs {states}, {wall_s:.1f} s")
        ((began, ended, planned_s),) = ask(
            queue,
            "SELECT min(began), max(ended), (SELECT estimate_s FROM condition) * count(*) FROM run",
        )
        print(f"first run began {began}, last ended {ended}; planned {planned_s:.1f} s of runs")
        print(
            f"last sample to first motion: median {statistics.median(found):.3f} s, "
            f"{found[0]:.3f} to {found[-1]:.3f} s, {len(found)} gaps"
        )


if __name__ == "__main__":
    main()
