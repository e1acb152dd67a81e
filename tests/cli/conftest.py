"""Tests of the commands use the recorded runs and trials of the tests of files and of figures."""

from __future__ import annotations

import sys
from pathlib import Path

for folder in ("files", "figures"):
    sys.path.insert(0, str(Path(__file__).parents[1] / folder))
