"""kill -9 of the worker, of the supervisor and of both in turn, at random instants of a batch that
is then resumed: every point id exactly once, and what runs gave against the uninterrupted batch.

    ./run python tests/benchmarks/bench_batch_kills.py      RIG_KILLS=50 RIG_SEED=1

A run that no kill fell into has to be equal to the last bit (its figures that tell of the computer
apart); one that was interrupted, within the errors that it states: film and skin remember.
"""

from __future__ import annotations

import contextlib
import math
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.measured import machine
from nights import SWEEPS, TRIALS, Taken, ask, folder_of, kill, taken, worker_of

KILLS = int(os.environ.get("RIG_KILLS", "50"))
SEED = int(os.environ.get("RIG_SEED", "1"))
BATCH = SWEEPS + TRIALS
RIG = [sys.executable, "-c", "from rig.cli import main; main()"]
STATED = {
    "gain_dB": "gain_standard_error_dB",
    "static_friction": "static_friction_error",
    "kinetic_friction": "kinetic_friction_error",
}
"""Figures by which an interrupted run is compared, with their standard errors."""
SIGMAS = 5.0
OF_THE_COMPUTER = ("largest_lateness_s", "late_ticks", "missed_ticks", "simulated_truth")
"""Figures that depend on how fast it is, or say when."""
WHO = ("worker", "supervisor", "both")


def begun(folder: Path) -> subprocess.Popen[bytes]:
    """The batch in a folder, its queue written."""
    (folder / "night.toml").write_text(BATCH)
    log = (folder / "said.log").open("ab")
    process = subprocess.Popen(
        [*RIG, "batch", "run", "night.toml"], cwd=folder, stderr=log, stdout=log
    )
    while not list((folder / "results").glob("*/queue.sqlite")):
        if process.poll() is not None:
            raise SystemExit((folder / "said.log").read_text())
        time.sleep(0.05)
    return process


def interrupted(folder: Path, who: str, after_s: float) -> Path:
    """A batch killed once and taken to its end; its folder."""
    process = begun(folder)
    batch = folder_of(folder / "results")
    time.sleep(after_s)
    worker = worker_of(batch)
    if who != "worker":
        process.kill()
    if who != "supervisor":
        kill(worker)
    process.wait()
    while _unfinished(batch):
        resumed = subprocess.run(
            [*RIG, "batch", "resume"], cwd=folder, capture_output=True, text=True, check=False
        )
        if resumed.returncode not in (0, 5):
            raise SystemExit(f"resume ended with {resumed.returncode}:\n{resumed.stderr}")
    return batch


def _unfinished(batch: Path) -> bool:
    ((left,),) = ask(batch, "SELECT count(*) FROM run WHERE state IN ('queued', 'running')")
    return bool(left)


def differences(batch: Path, expected: dict[int, Taken]) -> Iterator[str]:
    """What is not as in the uninterrupted batch."""
    again = {n for (n,) in ask(batch, "SELECT run FROM attempt WHERE attempt > 1")}
    found = taken(batch)
    if found.keys() != expected.keys():
        yield f"runs {sorted(found)} instead of {sorted(expected)}"
    for number, run in found.items():
        other = expected[number]
        if run.state != "done":
            yield f"run {number} is {run.state}"
        if sorted(run.points) != sorted(other.points):
            yield f"run {number}: points {run.points} instead of {other.points}"
            continue
        by_point = dict(zip(other.points, other.readings, strict=True))
        for point, reading in zip(run.points, run.readings, strict=True):
            compare = _beyond_errors if number in again else _unequal
            for name in compare(reading, by_point[point]):
                yield f"run {number} {point}: {name} {reading[name]} and {by_point[point][name]}"


def _unequal(reading: dict[str, object], other: dict[str, object]) -> list[str]:
    return [
        name
        for name in reading
        if name not in OF_THE_COMPUTER and not _same(reading[name], other[name])
    ]


def _same(one: object, other: object) -> bool:
    both_nan = one != one and other != other
    return both_nan or one == other


def _beyond_errors(reading: dict[str, float], other: dict[str, float]) -> list[str]:
    return [
        name
        for name, error in STATED.items()
        if name in reading
        and abs(reading[name] - other[name]) > SIGMAS * math.hypot(reading[error], other[error])
    ]


def main() -> None:
    """Kill and compare."""
    print(machine())
    chance = random.Random(SEED)
    with tempfile.TemporaryDirectory(prefix="rig-kills-") as name:
        whole = Path(name) / "whole"
        whole.mkdir()
        process = begun(whole)
        since = time.monotonic()
        assert process.wait() == 0, (whole / "said.log").read_text()
        lasts_s = time.monotonic() - since
        expected = taken(folder_of(whole / "results"))
        print(f"uninterrupted: {len(expected)} runs in {lasts_s:.1f} s")
        wrong = died = 0
        for number in range(KILLS):
            who = WHO[number % len(WHO)]
            folder = Path(name) / f"{number:03d}"
            folder.mkdir()
            after_s = chance.uniform(0, lasts_s)
            batch = interrupted(folder, who, after_s)
            found = list(differences(batch, expected))
            with contextlib.suppress(IndexError):
                died += ask(batch, "SELECT count(*) FROM attempt WHERE ending != 'complete'")[0][0]
            wrong += bool(found)
            print(
                f"{number:3d} {who:10s} after {after_s:5.1f} s: {found or 'as expected'}",
                flush=True,
            )
        print(f"{KILLS} kills, {died} attempts cut short, {wrong} batches not as expected")


if __name__ == "__main__":
    main()
