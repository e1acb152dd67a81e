"""Figures drawn beside a command that has something else to do.

Importing matplotlib takes as long as drawing. A process that is started before the data are stored
has it ready when the file is there, and draws while the command sums up.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from pathlib import Path

from rig.core.errors import RigError
from rig.figures import FIGURES

PATIENCE_S = 120.0
"""How long a figure may take to be drawn."""


class Drawing:
    """The figures of a run whose file is yet to come."""

    def __init__(self, name: str):
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "rig.figures", *FIGURES[name]],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,  # a terminal's Ctrl-C ends the run, not its picture
        )

    def begin(self, run_file: Path) -> None:
        """The file is there."""
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it died: its answer tells
            self._process.stdin.write(f"{run_file}\n")
            self._process.stdin.flush()

    def paths(self) -> list[Path]:
        """Wait for the figures. RigError where one could not be drawn; the others are there."""
        try:
            said, complaint = self._process.communicate(timeout=PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.abandon()
            raise RigError(f"it was not drawn within {PATIENCE_S:g} s") from None
        try:
            answer = json.loads(said)
        except ValueError:
            code = self._process.returncode
            last = complaint.strip().splitlines()[-1:] or [f"exit code {code}"]
            raise RigError(f"the process that draws it died: {last[0]}") from None
        if "error" in answer:
            raise RigError(answer["error"], answer["hint"])
        return [Path(path) for path in answer["paths"]]

    def abandon(self) -> None:
        """There is nothing to draw."""
        self._process.kill()
        with contextlib.suppress(ValueError):  # its pipes were closed before
            self._process.communicate()
