"""Running a trial: the real command line in a process of its own, in a folder of its own."""

from __future__ import annotations

import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from forked_rig import Server

from .invariants import Ran
from .trials import Trial

PATIENCE_S = 120.0


def run(server: Server, trial: Trial, folder: Path, patience_s: float = PATIENCE_S) -> Ran:
    """Run a trial to its end; one that does not end by itself is killed."""
    folder.mkdir(parents=True)
    (folder / "world.toml").write_text(trial.world)
    (folder / "fault.toml").write_text(trial.plan)
    arguments = [
        *trial.arguments, "--json", "--no-figures", "--world", "world.toml",
        "--fault", "fault.toml", "--world-log", "world.jsonl",
    ]  # fmt: skip
    process = server.start(arguments, folder)
    with process.stdout, process.stderr, ThreadPoolExecutor(2) as readers:
        said = [readers.submit(pipe.read) for pipe in (process.stdout, process.stderr)]
        try:
            code = process.wait(patience_s)
        except subprocess.TimeoutExpired:
            process.kill()
            code = process.wait()
        stdout, stderr = (one.result() for one in said)
    return Ran(trial, code, stdout, stderr, folder)
