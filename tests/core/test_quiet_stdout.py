"""What code of another package writes stays out of the data that a command prints."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

PROGRAM = """
import ctypes, os
from rig.core.quiet_stdout import quiet_stdout
with quiet_stdout():
    ctypes.CDLL(None).puts(b"from C")  # which keeps it back where stdout is not a terminal
    os.write(1, b"from below\\n")
    print("from Python")
print("the data")
"""


def test_what_c_has_kept_back_does_not_follow_on_stdout(tmp_path: Path) -> None:
    plain = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], cwd=tmp_path, env=plain, capture_output=True, text=True
    )
    assert done.stdout == "the data\n"
    assert set(done.stderr.splitlines()) == {"from C", "from below", "from Python"}
