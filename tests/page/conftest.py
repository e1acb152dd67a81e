"""Tests of the page use the recorded runs of the tests of files."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "files"))
