"""Running a trial: the real command line in a process of its own, in a folder of its own."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
from pathlib import Path

from .invariants import Ran
from .trials import Trial

PATIENCE_S = 120.0
FORKED_RIG = Path(__file__).with_name("forked_rig.py")


class Rigs:
    """Runs one trial after the other."""

    def __init__(self) -> None:
        env = {k: v for k, v in os.environ.items() if k not in ("FORCE_COLOR", "TERM")}
        self._server = subprocess.Popen(
            [sys.executable, str(FORKED_RIG)],
            env=env,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
        )

    def run(self, trial: Trial, folder: Path) -> Ran:
        """The trial, ended; one that does not end by itself is killed."""
        folder.mkdir(parents=True)
        (folder / "world.toml").write_text(trial.world)
        (folder / "fault.toml").write_text(trial.plan)
        arguments = [
            *trial.arguments, "--json", "--no-figures", "--world", "world.toml",
            "--fault", "fault.toml", "--world-log", "world.jsonl",
        ]  # fmt: skip
        assert self._server.stdin is not None
        assert self._server.stdout is not None
        job = {"folder": str(folder), "arguments": arguments}
        self._server.stdin.write(json.dumps(job).encode() + b"\n")
        pid = int(self._server.stdout.readline())
        if not select.select([self._server.stdout], [], [], PATIENCE_S)[0]:
            os.kill(pid, signal.SIGKILL)
        code = int(self._server.stdout.readline())
        stdout, stderr = ((folder / name).read_text() for name in ("stdout", "stderr"))
        return Ran(trial, code, stdout, stderr, folder)

    def close(self) -> None:
        """End it."""
        self._server.communicate()
