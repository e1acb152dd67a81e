"""Running trials: the real command line in a process of its own, in a folder of its own; and a
series of them, one after the other, each written down as soon as it has been judged."""

from __future__ import annotations

import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from forked_rig import Server

from . import register
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
    return Ran(trial, *finished(server, arguments, folder, patience_s), folder)


def finished(
    server: Server, arguments: Sequence[str], folder: Path, patience_s: float
) -> tuple[int, str, str]:
    """Run a command in the folder to its end, or kill it; its exit code, stdout and stderr."""
    process = server.start(arguments, folder)
    with process.stdout, process.stderr, ThreadPoolExecutor(2) as readers:
        said = [readers.submit(pipe.read) for pipe in (process.stdout, process.stderr)]
        try:
            code = process.wait(patience_s)
        except subprocess.TimeoutExpired:
            process.kill()
            code = process.wait()
        stdout, stderr = (one.result() for one in said)
    return code, stdout, stderr


def run_series(
    series: str,
    seeds: Iterable[int],
    draw: Callable[[int], Trial],
    judge: Callable[[Ran], list[str]],
    folder: Path,
    file: Path | None,
    until_s: float,
    patience_s: float,
    take: Callable[[Server, Trial, Path, float], Ran] = run,
) -> list[register.Entry]:
    """Run the trials of the seeds that the register `file` does not have, until the monotonic clock
    is at `until_s`; return their entries.

    Each is appended to the file and printed. The folder of one that broke an invariant stays.
    """
    server = Server()
    done = {one.seed for one in (register.read(file) if file else ()) if one.series == series}
    entries = []
    for seed in seeds:
        if time.monotonic() > until_s:
            break
        if seed in done:
            continue
        trial = draw(seed)
        before_s = server.processor_time_s() + _own_processor_time_s()
        ran = take(server, trial, folder / str(seed), patience_s)
        found = judge(ran)
        cpu_s = server.processor_time_s() + _own_processor_time_s() - before_s
        entry = register.entry_of(series, ran, found, cpu_s)
        entries.append(entry)
        if file:
            register.append(file, entry)
        print(f"{seed} exit {entry.code} {entry.in_words} {found or 'holds'}", flush=True)
        if not found:
            shutil.rmtree(ran.folder)
    server.close()
    return entries


def _own_processor_time_s() -> float:
    times = os.times()
    return times.user + times.system
