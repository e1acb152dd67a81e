"""Tests of the procedures use the recorded trials of the tests of files."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "files"))
