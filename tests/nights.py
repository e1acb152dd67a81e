"""Batches through the real command line, and what became of their runs."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sqlite3
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rig.files.errors import JournalError
from rig.files.journal.reader import read_journal
from rig.files.runfile.reader import RunFile

PATIENCE_S = 120.0
NIGHT = """
[batch]
name = "night"
figures = false
detect = false
"""
QUICK_NIGHT = f"""{NIGHT}
[simulation]
world = "world.toml"
"""
"""The same with the World that `write_night` writes: z goes quickly where it has not been."""
SWEEPS = (
    NIGHT
    + """
[[experiment]]
procedure = "sweep"
settings = { frequencies_Hz = [180, 200, 220] }
matrix = { load_N = [0.5, 1.0] }
"""
)
TRIALS = """
[[experiment]]
procedure = "slip-trial"
settings = { speed_mm_s = 2, trials = 2 }
"""


@dataclass(frozen=True)
class Taken:
    """What a run left."""

    number: int
    state: str
    points: tuple[str, ...]
    readings: tuple[dict[str, Any], ...]


def write_night(rig: Any, text: str) -> None:
    """Write ``night.toml``, and the World that a `QUICK_NIGHT` names."""
    rig.world("")
    (rig.folder / "night.toml").write_text(text)


def folder_of(results: Path) -> Path:
    """The one batch below a results folder."""
    (queue,) = results.glob("*/queue.sqlite")
    return queue.parent


def ask(folder: Path, query: str) -> list[tuple[Any, ...]]:
    """A question to a batch's queue."""
    with contextlib.closing(sqlite3.connect(folder / "queue.sqlite", timeout=30)) as queue:
        return queue.execute(query).fetchall()


def await_answer(folder: Path, query: str, answer: object) -> None:
    """Wait until a question has this answer."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        found = ask(folder, query)
        if found and found[0][0] == answer:
            return
        time.sleep(0.05)
    raise AssertionError(f"{query} is {found}, not {answer}")


def taken(folder: Path) -> dict[int, Taken]:
    """Every run of a batch, with what its one file holds; each is in exactly one."""
    states = dict(ask(folder, "SELECT number, state FROM run ORDER BY number"))
    found: dict[int, Taken] = {}
    for number, state in states.items():
        files, journals = (
            [path for path in (folder / "runs").glob(f"r{number:05d}_*.{kind}") if _own(path)]
            for kind in ("h5", "rigj")
        )
        assert len(files) <= 1
        assert len(journals) <= 1
        ids: list[str] = []
        readings: list[dict[str, Any]] = []
        if journals:
            kept = list(read_journal(journals[0]).kept())
            ids, readings = [p.id for p in kept], [p.reading for p in kept]
        elif files:
            with RunFile.open(files[0]) as run:
                readings = list(run.readings())
                ids = list(run.point_ids())
        found[number] = Taken(number, state, tuple(ids), tuple(readings))
    return found


def _own(path: Path) -> bool:
    """Whether it is a run's file; what could not be continued is put away under another name."""
    return path.name.count(".") == 1


def await_point(folder: Path, number: int) -> None:
    """Wait until a run has kept a point, and is not over yet."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        for journal in (folder / "runs").glob(f"r{number:05d}_*.rigj"):
            with contextlib.suppress(JournalError):
                if list(read_journal(journal).kept()):
                    return
        time.sleep(0.02)
    raise AssertionError(f"run {number} never kept a point")


def worker_of(folder: Path) -> int | None:
    """Process number of the worker at work, if there is one."""
    try:
        pid = int((folder / "worker.lock").read_text())
        os.kill(pid, 0)
    except (OSError, ValueError):
        return None
    return pid


def kill(pid: int | None) -> None:
    """kill -9, of who may have ended already."""
    if pid is not None:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def object_of(stdout: str) -> dict[str, Any]:
    """The last object on stdout."""
    found: dict[str, Any] = json.loads(stdout.strip().splitlines()[-1])
    return found
