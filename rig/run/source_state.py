"""Which source this program was run from: the commit, and whether it was changed since."""

from __future__ import annotations

import subprocess
from functools import cache
from pathlib import Path


@cache
def source_state() -> str:
    """The commit hash, with ``+dirty`` where tracked files differ; empty where there is no git."""
    folder = Path(__file__).resolve().parents[2]
    if not (folder / ".git").exists():
        return ""
    try:
        described = subprocess.run(
            ["git", "describe", "--always", "--dirty=+dirty", "--abbrev=40", "--exclude=*"],
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=5,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return described.stdout.strip()
