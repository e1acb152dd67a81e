"""Run files of the simulated bench, as the program wrote them: a sweep of 10 frequencies under two
loads, which are too few for a fit, a slide at 1 mm/s, two slides at 0.7 mm/s and a roll by 2 deg
(2026-11-25), and a sweep of 12 frequencies under two loads, which is fitted poorly (2026-11-30)."""

from __future__ import annotations

import shutil
from pathlib import Path

ARCHIVE = Path(__file__).parent / "data" / "runs.tar.xz"
SWEEP, FAST_SLIDE, TWO_SLIDES, ROLL, FITTED_SWEEP = (
    "2026-11-25T19-23-50_sweep_r001.h5",
    "2026-11-25T19-24-07_slip-trial_r002.h5",
    "2026-11-25T19-24-23_slip-trial_r003.h5",
    "2026-11-25T19-24-40_roll-trial_r004.h5",
    "2026-11-30T20-45-47_sweep_r004.h5",
)


def unpack(folder: Path) -> Path:
    """Unpack the files into a folder, and return it."""
    shutil.unpack_archive(ARCHIVE, folder)
    return folder
