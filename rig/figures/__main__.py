"""``python -m rig.figures FILE`` draws all figures of a file next to it (`rig.figures.drawing`).

One JSON object on stdout: ``files``, the pictures drawn, and ``warnings``, sentences.
"""

from __future__ import annotations

import contextlib
import json
import sys
from pathlib import Path

from rig.core.errors import RigError
from rig.figures.drawing import draw


def main() -> None:
    """Draw the file that the command line names."""
    file = Path(sys.argv[1])
    try:
        # Text that a figure function prints must not mix with the answer.
        with contextlib.redirect_stdout(sys.stderr):
            drawn = draw(file)
        answer = {"files": [str(path) for path in drawn.files], "warnings": list(drawn.warnings)}
    except RigError as error:
        answer = {"files": [], "warnings": [f"no figure was drawn: {error.one_line()}"]}
    sys.stdout.write(json.dumps(answer) + "\n")


if __name__ == "__main__":
    main()
