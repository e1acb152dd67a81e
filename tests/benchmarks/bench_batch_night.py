"""A night on the simulated bench: eight hours of bench time, all three procedures, runs that go
wrong at random, one command. Counts what was lost, doubled or left unsafe.

    ./run python tests/benchmarks/bench_batch_night.py     RIG_RUNS=330 RIG_SEED=1 RIG_SHARE=0.3

`RIG_SHARE` of the runs have a fault; `RIG_FIGURES=0` draws no figures. `RIG_RUNS=60` is the least.

Who looks at the bench when the batch holds is played here: it lets it go on, and starts it again
where the bench could not be made safe. How often is printed.
"""

from __future__ import annotations

import collections
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.measured import machine
from nights import ask, folder_of, taken
from soak.trials import DOOR, as_toml, fault

from drivers.simulated.faults.plan import ROTARY, STAGE_X
from rig.batch.plan.read import parse_batch
from rig.files.runfile.reader import RunFile
from rig.files.verify import verify

RUNS = int(os.environ.get("RIG_RUNS", "330"))
SEED = int(os.environ.get("RIG_SEED", "1"))
SHARE = float(os.environ.get("RIG_SHARE", "0.3"))
FIGURES = os.environ.get("RIG_FIGURES", "1") == "1"
REST_S = 88.0
RIG = [sys.executable, "-c", "from rig.cli import main; main()"]
ABSENT = {
    "sweep": {STAGE_X, ROTARY},
    "slip-trial": {"generator", ROTARY},
    "roll-trial": {"generator"},
}
PRESSED_WORLD = f"{DOOR}[watch]\nforce_limit_N = 15.0\nreaction_s = 0.06\n"
WORLDS = {
    "sweep": f"{DOOR}[watch]\nforce_limit_N = 40.0\nreaction_s = 0.06\n",
    "slip-trial": PRESSED_WORLD,
    "roll-trial": PRESSED_WORLD,
}


def night_toml(simulation: str = "") -> str:
    """The batch file: three quarters sweeps, the rest slides and rolls, and references."""
    each = max(1, RUNS // 60)
    return f"""
[batch]
name = "night"
order = "shuffled"
seed = {SEED}
set_aside_after = 100
figures = {"true" if FIGURES else "false"}
hold_when = {{ consecutive_failures = 3 }}

[[experiment]]
procedure = "sweep"
settings = {{ frequencies_Hz = [160, 200, 250], preload_N = 20 }}
matrix = {{ load_N = [0.5, 0.8, 1.0, 1.5] }}
repeat = {11 * each}
rest_s = {REST_S}

[[experiment]]
procedure = "slip-trial"
settings = {{ distance_mm = 0.6 }}
matrix = {{ speed_mm_s = [0.5, 1.0], normal_force_N = [3, 4] }}
repeat = {2 * each}
rest_s = {REST_S}

[[experiment]]
procedure = "roll-trial"
repeat = {7 * each}
rest_s = {REST_S}

[[experiment]]
procedure = "sweep"
name = "reference"
settings = {{ frequencies_Hz = [190, 200, 210] }}
every = 40
rest_s = {REST_S}
{simulation}"""


def simulation(folder: Path) -> str:
    """What every run is simulated on, and what happens to some: files beside the batch file."""
    _, plan, _ = parse_batch(night_toml(), "night.toml")
    chance = random.Random(SEED)
    (folder / "faults").mkdir()
    for name, world in WORLDS.items():
        (folder / f"{name}.toml").write_text(world)
    lines = ["[simulation]", "world_log = true"]
    for run in plan.runs:
        procedure = plan.conditions[run.condition].procedure
        lines += ["[[simulation.change]]", f"from_run = {run.number}"]
        lines += [f'settings = "{procedure}.toml"']
        if chance.random() < SHARE:
            path = f"faults/{run.number:05d}.toml"
            plans = [fault(chance, ABSENT[procedure]) for _ in range(chance.choice((1, 1, 2)))]
            (folder / path).write_text(as_toml(plans))
            lines += ["[[simulation.fault]]", f"runs = [{run.number}]", f'plan = "{path}"']
    return "\n".join(lines) + "\n"


def take(folder: Path) -> tuple[float, int, int, list[int]]:
    """The one command, and the person; wall time, holds, restarts, exit codes."""
    begun, holds, codes, attempts = time.monotonic(), 0, [], 0
    arguments = ["batch", "run", "night.toml"]
    while True:
        process = subprocess.Popen(
            [*RIG, *arguments], cwd=folder, stderr=subprocess.PIPE, text=True
        )
        assert process.stderr is not None
        for line in process.stderr:
            print(line, end="", flush=True)
            if "the bench is safe and the batch waits" in line:
                holds += 1
                subprocess.run([*RIG, "batch", "resume"], cwd=folder, check=True)
        codes.append(process.wait())
        batch, before = folder_of(folder / "results"), attempts
        if not ask(batch, "SELECT 1 FROM run WHERE state = 'queued'"):
            return time.monotonic() - begun, holds, len(codes) - 1, codes
        ((attempts,),) = ask(batch, "SELECT count(*) FROM attempt")
        if attempts == before:
            raise SystemExit(f"the batch does not continue: exit code {codes[-1]}")
        arguments = ["batch", "resume"]


def wrong(batch: Path) -> Iterator[str]:
    """Everything that a night may not leave."""
    for number, run in taken(batch).items():
        if run.state not in ("done", "failed"):
            yield f"run {number} is {run.state}"
        if len(set(run.points)) != len(run.points):
            yield f"run {number} has a point twice: {run.points}"
        if run.state == "done" and not run.points:
            yield f"run {number} is done and has no point"
        log = batch / "runs" / f"r{number:05d}.world.jsonl"
        for line in log.read_text().splitlines() if log.exists() else ():
            entry = json.loads(line)
            if entry["what"] == "violation":
                yield f"run {number}: the World: {entry['value']}"
    for path in sorted((batch / "runs").glob("*.h5")):
        yield from (f"{path.name}: {finding}" for finding in verify(path))
        with RunFile.open(path) as run_file:
            if run_file.header.run_number != int(path.name[1:6]):
                yield f"{path.name} says it is run {run_file.header.run_number}"
    for (number,) in ask(batch, "SELECT number FROM run WHERE processed IS NULL"):
        yield f"nothing was made of run {number}"


def injected(batch: Path) -> collections.Counter[str]:
    """What really befell runs, by device and kind."""
    found: collections.Counter[str] = collections.Counter()
    for log in (batch / "runs").glob("*.world.jsonl"):
        for line in log.read_text().splitlines():
            entry = json.loads(line)
            if entry["what"] == "injected":
                found[f"{entry['device']} {entry['value']}"] += 1
    return found


def main() -> None:
    """Take a night and tell what came of it."""
    print(machine())
    folder = Path(tempfile.mkdtemp(prefix="rig-night-"))  # it stays, to be looked at
    print(f"folder {folder}")
    (folder / "night.toml").write_text(night_toml(simulation(folder)))
    wall_s, holds, restarts, codes = take(folder)
    batch = folder_of(folder / "results")
    ((night_s,),) = ask(batch, "SELECT value FROM meta WHERE key = 'night_s'")
    states = dict(ask(batch, "SELECT state, count(*) FROM run GROUP BY state"))
    kinds = dict(ask(batch, "SELECT kind, count(*) FROM attempt GROUP BY kind"))
    faults_met = injected(batch)
    print(f"runs {states}, attempts by kind of failure {kinds}")
    print(f"bench time {float(night_s) / 3600:.2f} h, wall time {wall_s / 60:.1f} min")
    print(f"holds let go {holds}, started again {restarts}, exit codes {codes}")
    print(f"faults injected {faults_met.total()}: {dict(faults_met.most_common())}")
    breaches = list(wrong(batch))
    print(f"lost, doubled, unsafe or unsound: {len(breaches)}")
    for breach in breaches:
        print(f"  {breach}")


if __name__ == "__main__":
    main()
