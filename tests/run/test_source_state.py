"""The commit that a run records, and what finding it leaves alone."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from rig.run.source_state import commit_of


def git(folder: Path, *arguments: str) -> str:
    """Run git in a folder, without the settings of a user."""
    settings = ("-c", "user.name=a", "-c", "user.email=a@example.org")
    done = subprocess.run(
        ["git", *settings, *arguments], cwd=folder, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """A repository with one commit of one file."""
    git(tmp_path, "init", "-q")
    assert commit_of(tmp_path) == "", "nothing is committed yet"
    (tmp_path / "a.py").write_text("1\n")
    git(tmp_path, "add", "a.py")
    git(tmp_path, "commit", "-q", "-m", "a")
    return tmp_path


def test_only_a_tracked_file_that_differs_makes_it_dirty(repository: Path) -> None:
    commit = git(repository, "rev-parse", "HEAD")
    (repository / "notes.txt").write_text("untracked\n")
    git(repository, "tag", "-a", "v1", "-m", "v1")
    assert commit_of(repository) == commit
    (repository / "a.py").write_text("2\n")
    assert commit_of(repository) == f"{commit}+dirty"
    git(repository, "add", "a.py")
    assert commit_of(repository) == f"{commit}+dirty"


def test_the_index_of_the_repository_is_left_as_it_is(repository: Path) -> None:
    """A run is made by the program, and `git commit` may be at work in its source meanwhile."""
    os.utime(repository / "a.py", (1e9, 1e9))
    index = repository / ".git" / "index"
    before = index.read_bytes()
    assert commit_of(repository) == git(repository, "rev-parse", "HEAD")
    assert index.read_bytes() == before
