"""Figures drawn by a process of their own (see `rig.figures.beside`).

``python -m rig.figures MODULE:FUNCTION ...`` imports what the parts need, then waits for the run
file's path on its standard input. One line of JSON answers: ``paths``, or ``error`` and ``hint``.
"""

from __future__ import annotations

import json
import os
import sys
from functools import partial
from importlib import import_module
from pathlib import Path

from rig.core.errors import RigError
from rig.figures import draw_part
from rig.figures.forked import side_by_side
from rig.figures.style import get_ready

NICENESS = 5
"""What takes the data, and what keeps them, goes first."""


def main() -> None:
    """Serve one request; an input that ends without one is none."""
    os.nice(NICENESS)
    parts = sys.argv[1:]
    for part in parts:
        import_module(part.partition(":")[0])
    get_ready()
    run_file = sys.stdin.readline().rstrip("\n")
    if not run_file:
        return
    draw = partial(draw_part, run_file=Path(run_file), together=side_by_side)
    try:
        drawn = side_by_side([partial(draw, part) for part in parts])
        answer: dict[str, object] = {"paths": [str(path) for paths in drawn for path in paths]}
    except RigError as error:
        answer = {"error": error.message, "hint": error.hint}
    except (OSError, ValueError) as error:
        answer = {"error": str(error), "hint": ""}
    sys.stdout.write(json.dumps(answer) + "\n")


main()
