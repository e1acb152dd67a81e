"""Figures drawn beside a command that has something else to do.

Importing matplotlib takes as long as drawing. Processes that are started before the data are stored
have it ready when the file is there, and draw while the command sums up.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from pathlib import Path

from rig.errors import RigError
from rig.figures import FIGURES
from rig.processor import let_run_anywhere

PATIENCE_S = 120.0
"""How long a figure may take to be drawn."""


class Drawing:
    """The figures of a run whose file is yet to come: one process a part."""

    def __init__(self, name: str):
        self._processes = [
            subprocess.Popen(
                [sys.executable, "-P", "-m", "rig.figures", part],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                start_new_session=True,  # a terminal's Ctrl-C ends the run, not its picture
            )
            for part in FIGURES.get(name, ())
        ]
        for process in self._processes:
            let_run_anywhere(process.pid)

    def begin(self, run_file: Path) -> None:
        """The file is there."""
        for process in self._processes:
            assert process.stdin is not None
            with contextlib.suppress(BrokenPipeError):  # it died: its answer tells
                process.stdin.write(f"{run_file}\n")
                process.stdin.flush()

    def paths(self) -> list[Path]:
        """Wait for the figures. RigError where one could not be drawn; the others are there."""
        drawn: list[Path] = []
        failed: RigError | None = None
        for process in self._processes:
            try:
                drawn += _answer(process)
            except RigError as error:
                failed = failed or error
        if failed:
            raise failed
        return drawn

    def abandon(self) -> None:
        """There is nothing to draw."""
        for process in self._processes:
            _end(process)


def _answer(process: subprocess.Popen[str]) -> list[Path]:
    try:
        said, complaint = process.communicate(timeout=PATIENCE_S)
    except subprocess.TimeoutExpired:
        _end(process)
        raise RigError(f"it was not drawn within {PATIENCE_S:g} s") from None
    try:
        answer = json.loads(said)
    except ValueError:
        last = complaint.strip().splitlines()[-1:] or [f"exit code {process.returncode}"]
        raise RigError(f"the process that draws it died: {last[0]}") from None
    if "error" in answer:
        raise RigError(answer["error"], answer["hint"])
    return [Path(path) for path in answer["paths"]]


def _end(process: subprocess.Popen[str]) -> None:
    process.kill()
    with contextlib.suppress(ValueError):  # its pipes were closed before
        process.communicate()
