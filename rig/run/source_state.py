"""The source that this program runs from: its commit, and whether files differ from it."""

from __future__ import annotations

import subprocess
from functools import cache
from pathlib import Path


@cache
def source_state() -> str:
    """Return the commit hash, with ``+dirty`` if tracked files differ; empty outside a git
    repository."""
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
