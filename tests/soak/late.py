"""Attacks by late answers, which need time to pass: on a simulated bench in real time.

One link answers some, or all, of its requests later than it would, by 5 ms to 2.5 s, from a moment
in which something is pressed, moves or is recorded. A computer that is busy makes answers late as
well; what it does to a trial is judged like what the attack does.
"""

from __future__ import annotations

import contextlib
import math
import random
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from forked_rig import ForkedProcess, Server

from drivers.simulated.faults.plan import devices_by_fault

from .attacks import LINKS, MOST_REQUESTS, OPTIONS, left_pressed, moment
from .invariants import Ran, at_rest, files_are_sound, left_unsaid, reported_about
from .rows import rows_as_recorded
from .running import finished
from .trials import ON_A_LINE, STAGES, Trial, world_of

FIXTURES = {
    "sweep": "film-clamp",
    "slip-trial": "plate",
    "roll-trial": "semi-spherical-object",
}
SHORTEST_s, LONGEST_s = 0.005, 2.5
BENCH_FILE = "a-bench.toml"
SERVES = "Ctrl-C ends it"
"""What a simulated bench says when it can be used."""
COMES_TO_REST_S = 1.5
"""After the command: a drive that was left to itself stops by its own time-out."""
TOO_BUSY = ("cannot keep", "is silent", "are late", "were late", "came late")
"""What a run says where a busy computer, or the attack, has kept it from its ticks."""


def late_attack(seed: int) -> Trial:
    """The attack of a seed."""
    chance = random.Random(f"late {seed}")
    procedure = chance.choice(("slip-trial", "slip-trial", "sweep", "roll-trial"))
    stages = chance.choice(STAGES)
    able = devices_by_fault(ON_A_LINE[stages])["late"]
    device = chance.choice([one for one in LINKS[procedure] if one in able])
    fault = {"device": device, "kind": "late", **moment(chance, procedure)}
    fault["at"] = chance.randint(1, MOST_REQUESTS)
    by_s = math.exp(chance.uniform(math.log(SHORTEST_s), math.log(LONGEST_s)))
    fault["by_s"] = round(by_s, 3)
    if chance.random() < 0.3:
        fault["jitter_s"] = round(chance.uniform(0, by_s), 3)
    if chance.random() < 0.3:
        fault["for_s"] = round(chance.uniform(0.05, 3), 2)
    else:
        fault["count"] = chance.choice((1, 1, 2, 5, 0))
    arguments = (procedure, *OPTIONS[procedure], "--stages", stages, "--seed", str(seed % 1000))
    return Trial(seed, arguments, world_of(procedure, [fault]), (fault,))


def run_late(server: Server, trial: Trial, folder: Path, patience_s: float) -> Ran:
    """Serve the trial's bench in real time and run the trial on it, both to their ends."""
    folder.mkdir(parents=True)
    (folder / "world.toml").write_text(trial.world)
    (folder / "fault.toml").write_text(trial.plan)
    at = trial.arguments.index("--stages")
    of_the_bench, given = trial.arguments[at:], trial.arguments[:at]
    simulate = [
        "simulate", "--fixture", FIXTURES[trial.procedure], *of_the_bench, "--world", "world.toml",
        "--fault", "fault.toml", "--world-log", "world.jsonl", "--write", BENCH_FILE,
    ]  # fmt: skip
    with _served(server, simulate, folder, patience_s):
        arguments = [*given, "--bench", BENCH_FILE, "--json", "--no-figures"]
        ended = finished(server, arguments, folder, patience_s)
        time.sleep(COMES_TO_REST_S)
    return Ran(trial, *ended, folder)


@contextlib.contextmanager
def _served(
    server: Server, arguments: list[str], folder: Path, patience_s: float
) -> Iterator[None]:
    """A simulated bench that serves within the block."""
    serving: ForkedProcess = server.start(arguments, folder)
    ready = threading.Event()

    def listen() -> None:
        for line in serving.stderr:
            if SERVES in line:
                ready.set()

    with serving.stdout, serving.stderr, ThreadPoolExecutor(2) as readers:
        readers.submit(serving.stdout.read)
        readers.submit(listen)
        try:
            assert ready.wait(patience_s), "the simulated bench does not start"
            yield
        finally:
            serving.send_signal(signal.SIGINT)
            serving.wait(patience_s)


def late_breaches(ran: Ran) -> list[str]:
    """Every invariant that does not hold after the trial."""
    found = []
    if "Traceback" in ran.stderr or "internal error" in ran.stderr.lower():
        found.append("an internal error")
    busy = any(words in ran.stderr for words in TOO_BUSY)
    if ran.code not in (0, 3, 4, 5, 7) or (ran.code and not ran.faults_met and not busy):
        found.append(f"exit code {ran.code}")
    if ran.code in (3, 4, 7) and not busy:
        found += reported_about(ran, ran.errors)
    wrong = [one.reported for one in rows_as_recorded(ran) if not one.declared]
    return [
        *found, *at_rest(ran), *files_are_sound(ran), *left_pressed(ran), *left_unsaid(ran), *wrong,
    ]  # fmt: skip
