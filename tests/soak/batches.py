"""Attacks on batches: two or three short runs, and one fault of one link in one of them.

Every run of a batch has a World of its own, as every attempt at it has, so each is judged by the
invariants of a single trial, and the batch by what it made of them: its exit code, its state, that
nothing was begun after a bench that is not safe, and what it says.
"""

from __future__ import annotations

import contextlib
import json
import random
import sqlite3
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from forked_rig import Server

from rig.files.runfile.reader import RunFile
from rig.files.verify import verify

from .attacks import attack_on, left_pressed
from .invariants import (
    DONE,
    DONE_WITH_FAILURES,
    LIMIT,
    UNSAFE,
    Ran,
    at_rest,
    holds_worse,
    left_unsaid,
    reported_about,
)
from .rows import rows_as_recorded
from .running import finished
from .trials import STAGES, Trial, world_of

SETTINGS: dict[str, dict[str, Any]] = {
    "sweep": {"frequencies_Hz": [110, 410], "load_N": 1, "preload_N": 12, "longest_point_s": 3},
    "slip-trial": {"distance_mm": 0.3, "speed_mm_s": 1, "rest_s": 0.1, "normal_force_N": 3},
    "roll-trial": {
        "angle_deg": 2, "start_mm": -3, "rest_s": 0.1, "stay_s": 0.1, "normal_force_N": 3,
    },
}  # fmt: skip
"""What `attacks.OPTIONS` sets, as a batch file has it."""
FOR_EVER = 100
"""Attempts at a run, more than any batch makes."""
ENDS_A_BATCH = {"unsafe": UNSAFE, "interlock": LIMIT}
"""Kinds of failure after which a batch begins nothing, and its exit codes."""
STARTED = "queued", "done", "failed"


@dataclass(frozen=True)
class BatchTrial(Trial):
    """A batch whose run `attacked` has the fault, in its first `attempts` attempts."""

    procedures: tuple[str, ...] = ()
    """Of its runs, in order."""
    attacked: int = 1
    attempts: int = 1
    on_stages: str = STAGES[0]

    @property
    def stages(self) -> str:
        """See `Trial`."""
        return self.on_stages

    @property
    def in_words(self) -> str:
        """See `Trial`."""
        (fault,) = self.faults
        words = " ".join(
            str(v) if k in ("device", "kind") else f"{k}={v}" for k, v in fault.items()
        )
        again = "" if self.attempts == 1 else ", in every attempt"
        return f"{', '.join(self.procedures)} {self.stages}: run {self.attacked}{again}: {words}"

    def run(self, number: int) -> Trial:
        """One of its runs as a trial of its own."""
        procedure = self.procedures[number - 1]
        arguments = (procedure, "--stages", self.stages)
        faults = self.faults if number == self.attacked else ()
        return Trial(self.seed, arguments, world_of(procedure, faults), faults)

    def write(self, folder: Path) -> None:
        """Write the batch file, and what it names, into the folder."""
        lines = [
            '[batch]\nname = "attacked"\nfigures = false\ndetect = false\non_hold = "stop"\n'
            "retries = { rest_s = 1 }\n",
        ]
        lines += [
            f'[[experiment]]\nprocedure = "{procedure}"\nname = "run-{number}"\n'
            f"settings = {_inline(SETTINGS[procedure])}\n"
            for number, procedure in enumerate(self.procedures, 1)
        ]
        lines.append(
            f'[simulation]\nseed = {self.seed % 1000}\nstages = "{self.stages}"\nworld_log = true\n'
        )
        for number in range(1, len(self.procedures) + 1):
            (folder / f"world-{number}.toml").write_text(self.run(number).world)
            lines.append(
                f'[[simulation.change]]\nfrom_run = {number}\nsettings = "world-{number}.toml"\n'
            )
        (folder / "fault.toml").write_text(self.plan)
        lines.append(
            f'[[simulation.fault]]\nruns = [{self.attacked}]\nplan = "fault.toml"\n'
            f"attempts = {self.attempts}\n"
        )
        (folder / "attacked.toml").write_text("\n".join(lines))


def batch_attack(seed: int) -> BatchTrial:
    """The attack of a seed on a batch."""
    chance = random.Random(f"batch {seed}")
    procedures = tuple(chance.choice(tuple(SETTINGS)) for _ in range(chance.choice((2, 2, 3))))
    attacked = chance.randint(1, len(procedures))
    stages = chance.choice(STAGES)
    fault = attack_on(chance, procedures[attacked - 1], stages)
    return BatchTrial(
        seed,
        ("batch", "run", "attacked.toml", "--json"),
        "",
        (fault,),
        procedures=procedures,
        attacked=attacked,
        attempts=chance.choice((1, 1, FOR_EVER)),
        on_stages=stages,
    )


def run_batch(server: Server, trial: Trial, folder: Path, patience_s: float) -> BatchRan:
    """Run a batch to its end; one that does not end by itself is killed."""
    assert isinstance(trial, BatchTrial)
    folder.mkdir(parents=True)
    trial.write(folder)
    return BatchRan(trial, *finished(server, trial.arguments, folder, patience_s), folder)


@dataclass(frozen=True)
class Attempt(Ran):
    """One attempt at a run of a batch; `stderr` is the whole batch's, `folder` its folder."""

    entries: tuple[dict[str, Any], ...] = ()
    """Of its World's log."""
    number: int = 1
    kind: str = ""
    """Kind of failure, as the batch has judged it."""
    reason: str = ""

    @property
    def log(self) -> list[dict[str, Any]]:  # type: ignore[override]
        """See `Ran`."""
        return list(self.entries)

    def files(self, pattern: str) -> list[Path]:
        """See `Ran`: of this run."""
        found = (self.folder / "runs").glob(f"r{self.number:05d}_{pattern}")
        return sorted(path for path in found if path.name.count(".") == 1)


@dataclass(frozen=True)
class BatchRan(Ran):
    """A batch that has ended, and what it left."""

    @property
    def batch_folder(self) -> Path:
        """The batch's own folder."""
        (queue,) = (self.folder / "results").glob("*/queue.sqlite")
        return queue.parent

    @property
    def worlds(self) -> list[list[dict[str, Any]]]:
        """See `Ran`: one for each attempt at each run."""
        return [attempt.log for attempt in self.attempts]

    @cached_property
    def log(self) -> list[dict[str, Any]]:
        """See `Ran`: of all Worlds, one after the other."""
        return [entry for world in self.worlds for entry in world]

    def ask(self, query: str) -> list[tuple[Any, ...]]:
        """A question to the batch's queue."""
        path = self.batch_folder / "queue.sqlite"
        with contextlib.closing(sqlite3.connect(path, timeout=30)) as queue:
            return queue.execute(query).fetchall()

    @cached_property
    def attempts(self) -> list[Attempt]:
        """All attempts, in the order in which they were begun."""
        assert isinstance(self.trial, BatchTrial)
        rows = self.ask("SELECT run, code, kind, reason FROM attempt ORDER BY began, run, attempt")
        worlds = {number: iter(self._worlds_of(number)) for number, *_ in rows}
        return [
            Attempt(
                self.trial.run(number), -1 if code is None else code, "", self.stderr,
                self.batch_folder, tuple(next(worlds[number], ())), number, kind, reason,
            )
            for number, code, kind, reason in rows
        ]  # fmt: skip

    def _worlds_of(self, number: int) -> Iterator[list[dict[str, Any]]]:
        path = self.batch_folder / "runs" / f"r{number:05d}.world.jsonl"
        world: list[dict[str, Any]] = []
        for line in path.read_text().splitlines() if path.exists() else ():
            entry = json.loads(line)
            if world and entry["t_us"] < world[-1]["t_us"] and world[-1]["what"] == "end":
                yield world
                world = []
            world.append(entry)
        yield world


def batch_breaches(ran: Ran) -> list[str]:
    """Every invariant that does not hold after the batch."""
    assert isinstance(ran, BatchRan)
    found = [*_ending(ran)]
    for attempt in ran.attempts:
        of = f"run {attempt.number}: "
        found += [of + one for one in _attempt(attempt)]
    for number in range(1, len(_batch(ran).procedures) + 1):
        found += [f"run {number}: {one}" for one in _kept(ran, number)]
    return found


def _batch(ran: Ran) -> BatchTrial:
    assert isinstance(ran.trial, BatchTrial)
    return ran.trial


def _ending(ran: BatchRan) -> Iterator[str]:
    """Exit code and state follow from the runs, and an unsafe bench ends the batch at once."""
    if "Traceback" in ran.stderr or "internal error" in ran.stderr.lower():
        yield "an internal error"
    states = dict(ran.ask("SELECT number, state FROM run"))
    ends = [n for n, one in enumerate(ran.attempts) if one.kind in ENDS_A_BATCH]
    if ends:
        expected = ENDS_A_BATCH[ran.attempts[ends[0]].kind]
    else:
        expected = DONE_WITH_FAILURES if "failed" in states.values() else DONE
        if "queued" in states.values():
            yield f"runs are left although every bench was safe: {states}"
    if ran.code != expected:
        yield f"exit code {ran.code} instead of {expected}"
    if ends and ends[0] != len(ran.attempts) - 1:
        yield f"an attempt was begun after one that was {ran.attempts[ends[0]].kind}"
    if strange := {*states.values()} - {*STARTED}:
        yield f"runs are {', '.join(sorted(strange))}"
    lines = ran.stdout.strip().splitlines()
    reported = json.loads(lines[-1])["runs"] if lines else {}
    counted = {state: n for state, n in reported.items() if n}
    if counted != {state: list(states.values()).count(state) for state in states.values()}:
        yield f"reported {counted} of the runs {states}"
    codes = dict(ran.ask("SELECT number, code FROM run"))
    for number, state in states.items():
        met_a_fault = number == _batch(ran).attacked and ran.faults_met
        if met_a_fault or ends or (state, codes[number]) == ("done", DONE):
            continue
        latest = [one for one in ran.attempts if one.number == number][-1]
        if state != "done" or not holds_worse(latest):
            yield f"run {number} is {state} with {codes[number]} although nothing befell it"


def _attempt(attempt: Attempt) -> Iterator[str]:
    """What has to be true of any trial."""
    if not attempt.entries or attempt.entries[-1]["what"] != "end":
        yield "its World did not end by itself"
    yield from at_rest(attempt)
    yield from left_unsaid(attempt)
    if attempt.trial.faults:
        yield from left_pressed(attempt)
    if attempt.code not in (DONE, DONE_WITH_FAILURES):
        errors = [f"error: {attempt.reason}"]
        yield from reported_about(attempt, errors)


def _kept(ran: BatchRan, number: int) -> Iterator[str]:
    """The run's file is sound, has what its queue says, and only rows that were sent."""
    attempts = [one for one in ran.attempts if one.number == number]
    if not attempts:
        return
    together = replace(
        attempts[-1], entries=tuple(entry for one in attempts for entry in one.entries)
    )
    kept = 0
    for path in together.files("*.h5"):
        yield from (f"{path.name}: {finding}" for finding in verify(path))
        with RunFile.open(path) as run:
            kept += len(run.point_ids())
    ((done,),) = ran.ask(f"SELECT points_done FROM run WHERE number = {number}")
    if together.files("*.h5") and kept != done:
        yield f"{done} points done, {kept} kept"
    yield from (one.reported for one in rows_as_recorded(together) if not one.declared)


def _inline(settings: dict[str, Any]) -> str:
    return (
        "{ " + ", ".join(f"{key} = {json.dumps(value)}" for key, value in settings.items()) + " }"
    )
