"""One part of a figure, drawn by a process of its own (see `rig.figures.beside`).

``python -m rig.figures MODULE:FUNCTION`` imports what the part needs, then waits for the run file's
path on its standard input. One line of JSON answers: ``paths``, or ``error`` and ``hint``.
"""

from __future__ import annotations

import json
import os
import sys
from importlib import import_module
from pathlib import Path

from rig.errors import RigError
from rig.figures import draw_part
from rig.imports import importing

NICENESS = 5
"""What takes the data, and what keeps them, goes first."""


def main() -> None:
    """Serve one request; an input that ends without one is none."""
    os.nice(NICENESS)
    part = sys.argv[1]
    with importing():
        from rig.figures.style import import_matplotlib

        import_matplotlib()
        import_module(part.partition(":")[0])
    run_file = sys.stdin.readline().rstrip("\n")
    if not run_file:
        return
    try:
        answer: dict[str, object] = {"paths": [str(p) for p in draw_part(part, Path(run_file))]}
    except RigError as error:
        answer = {"error": error.message, "hint": error.hint}
    except (OSError, ValueError) as error:
        answer = {"error": str(error), "hint": ""}
    sys.stdout.write(json.dumps(answer) + "\n")


main()
