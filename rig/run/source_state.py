"""The source that this program runs from: its commit, and whether files differ from it.

The build of a wheel runs this file alone (hatch_build.py), so it imports nothing of this project.
"""

from __future__ import annotations

import subprocess
from functools import cache
from pathlib import Path

BUILT_FROM = Path(__file__).resolve().parents[1] / "commit.txt"
"""File that a build has added to the package: the commit that it was built from."""

STATUS = (
    *("status", "--porcelain=v2", "--branch", "--untracked-files=no"),
    *("--no-ahead-behind", "--no-renames"),
)
"""Not `git describe --dirty`: it rewrites the index of the repository, also with
``--no-optional-locks``, and where it is ended meanwhile (``ulimit -f``, the time limit) it leaves a
lock on it, with which `git commit` refuses to work."""
COMMIT = "# branch.oid "
"""Header of the status with the commit's hash, or "(initial)"."""


@cache
def source_state() -> str:
    """Return the commit hash, with ``+dirty`` if tracked files differ: of the repository that this
    program runs from, else the one it was built from. The text is empty where neither is known."""
    commit = commit_of(Path(__file__).resolve().parents[2])
    if commit:
        return commit
    try:
        return BUILT_FROM.read_text(encoding="utf-8").strip()
    except OSError:
        return ""


def commit_of(folder: Path) -> str:
    """Return the commit of a repository's folder, with ``+dirty`` if tracked files differ; empty
    for any other folder."""
    if not (folder / ".git").exists():
        return ""
    try:
        state = subprocess.run(
            ["git", "--no-optional-locks", *STATUS],
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=5,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    headers = [line for line in state.stdout.splitlines() if line.startswith("# ")]
    commit = next((line.split()[-1] for line in headers if line.startswith(COMMIT)), "")
    if not commit or commit == "(initial)":
        return ""
    return commit if len(headers) == len(state.stdout.splitlines()) else f"{commit}+dirty"
