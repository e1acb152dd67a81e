"""`extensions.txt`, as the pages have it: `./run` installs what it names, in a checkout of its own.

Needs the registry of Python packages, as `./run` itself does.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from page import INSTALL, ROOT, Page


def copy_of_this_project(folder: Path) -> Path:
    """Copy the files of this project that git has, as they are now."""
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    for name in filter(None, listed.stdout.split("\0")):
        if not name.startswith("tests/") and (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name)
    return folder


def in_a_shell(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a line of a page in the folder of the project."""
    env = {k: v for k, v in os.environ.items() if k not in ("VIRTUAL_ENV", "PYTHONPATH")}
    ours = str(Path(sys.executable).parent)  # where `./run pytest` finds its python3
    folders = [one for one in env["PATH"].split(os.pathsep) if one != ours]
    env["PATH"] = os.pathsep.join(folders)
    return subprocess.run(
        command, shell=True, cwd=folder, env=env, capture_output=True, text=True, check=False
    )


@pytest.mark.thorough
def test_run_installs_what_is_named_and_works_without_what_cannot_be_installed(
    rig: Any, tmp_path: Path
) -> None:
    page = Page("add-a-procedure.md", rig)
    project = copy_of_this_project(tmp_path / "tactile-rig")
    for name, text in page.files.items():
        path = tmp_path / page.package.name / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, "utf-8")
    (install,) = filter(INSTALL.fullmatch, page.commands)
    show_help = next(line for line in page.commands if line.startswith("./run rig "))

    assert in_a_shell(install, project).returncode == 0
    helped = in_a_shell(show_help, project)
    assert helped.returncode == 0, helped.stderr
    assert "Hold a force and watch the skin creep." in helped.stdout

    good = (project / "extensions.txt").read_text()
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "pyproject.toml").write_text("[oops")
    (project / "extensions.txt").write_text(f"-e ../not-there\n# ours\n{good}../broken\n")
    for _ in range(2):  # at every start, not at the first alone
        safe = in_a_shell("./run rig make-safe --help", project)
        assert safe.returncode == 0, safe.stderr
        for line in ("-e ../not-there", "../broken"):
            assert f"run: '{line}' of extensions.txt could not be installed" in safe.stderr
        assert "make-safe" in safe.stdout
    helped = in_a_shell(show_help, project)
    assert "Hold a force and watch the skin creep." in helped.stdout, helped.stderr
    assert helped.stderr.count("could not be installed") == 2

    (project / "extensions.txt").write_text(good)
    mended = in_a_shell(show_help, project)
    assert "could not be installed" not in mended.stderr
