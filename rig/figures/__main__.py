"""``python -m rig.figures`` draws the figures of a file, whose path it reads from stdin.

They are written next to the file (`rig.figures.drawing`). The path is a JSON
string on a line of its own. A line of JSON on stdout before each figure, and one at the end:
``files``, the pictures drawn so far, ``warnings``, sentences, ``tracebacks``, and ``drawing``, the
figure that is drawn next, "" at the end. Where the input ends without a path nothing is drawn.
"""

from __future__ import annotations

import faulthandler
import json
import os
import sys
from pathlib import Path

from rig.core.errors import RigError
from rig.figures.drawing import GRACE_S, TIMEOUT_S, Drawn, draw

NICENESS = 5
"""Taking data and recording them have priority over drawing."""


def main() -> None:
    """Import what drawing needs, then draw the file that the standard input names."""
    os.nice(NICENESS)
    import rig.figures.style
    import rig.files.runfile.reader

    rig.figures.style.import_ahead()
    asked = sys.stdin.readline()
    if not asked:
        return
    # The run that waits ends it as well, unless it was killed meanwhile.
    faulthandler.dump_traceback_later(TIMEOUT_S + GRACE_S, exit=True)
    try:
        drawn = draw(Path(json.loads(asked)), begins=_answer)
    except RigError as error:
        drawn = Drawn(warnings=(f"no figure was drawn: {error.one_line()}",))
    _answer(drawn)


def _answer(drawn: Drawn, figure: str = "") -> None:
    assert sys.__stdout__ is not None
    sys.__stdout__.write(drawn.as_line(figure))
    sys.__stdout__.flush()


if __name__ == "__main__":
    main()
    os._exit(0)  # without the threads that a figure's function has left
