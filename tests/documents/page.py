"""A page of docs/ as a reader follows it: its files are made, its package built, its commands run.

A block of code under a line that is nothing but a file's name in backquotes is that file; blocks of
`sh` are commands, `./run` in front.
"""

from __future__ import annotations

import glob
import os
import re
import shlex
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from conftest import Finished

ROOT = Path(__file__).parents[2]
FILE = re.compile(r"^`([^`\n]+)`\n\n```\w+\n(.*?)^```$", re.MULTILINE | re.DOTALL)
COMMANDS = re.compile(r"^```sh\n(.*?)^```$", re.MULTILINE | re.DOTALL)
INSTALL = re.compile(r'echo "-e \.\./([\w-]+)" >> extensions\.txt')
"""What the pages say, with the package's folder; here the package is built with the same backend
and unpacked into a folder on PYTHONPATH, so that no environment is changed."""
PYTEST = "./run pytest -p no:cacheprovider ../"


class Page:
    """A page, the folder of its package, and the command line that finds the package."""

    def __init__(self, name: str, rig: Any):
        self.text = (ROOT / "docs" / name).read_text("utf-8")
        self.files = dict(FILE.findall(self.text))
        self.commands = [
            line for block in COMMANDS.findall(self.text) for line in block.strip().splitlines()
        ]
        self._rig = rig
        self._site = rig.folder / "site"
        (named,) = (found[1] for line in self.commands if (found := INSTALL.fullmatch(line)))
        self.package = rig.folder / "beside" / named

    def make(self, *instead: tuple[str, str]) -> None:
        """Write the page's files and install its package; each of `instead` replaces a text of the
        modules by another."""
        for name, text in self.files.items():
            for old, new in instead:
                if name.endswith(".py"):
                    text = text.replace(old, new)
            # What is not the package's is given to a command, in the folder where it runs.
            base = self.package if name.endswith(".py") or name == "pyproject.toml" else None
            path = (base or self._rig.folder) / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, "utf-8")
        build = "import hatchling.build, sys; print(hatchling.build.build_wheel(sys.argv[1]))"
        subprocess.run(
            [sys.executable, "-c", build, str(self.package.parent)], cwd=self.package, check=True
        )
        (wheel,) = self.package.parent.glob("*.whl")
        with zipfile.ZipFile(wheel) as packed:
            packed.extractall(self._site)
        wheel.unlink()
        self._rig.env["PYTHONPATH"] = str(self._site)
        self._rig.env["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"

    def run_rig(self) -> dict[str, Finished]:
        """Run every `rig` command of the page, in its order; what each came to."""
        ended = {}
        for line in self.commands:
            if line.startswith("./run rig "):
                words = shlex.split(line.removeprefix("./run rig "))
                ended[line] = self._rig.run(*(one for word in words for one in self._expand(word)))
        return ended

    def run_test(self) -> subprocess.CompletedProcess[str]:
        """Run the page's test, as its `pytest` command says."""
        (command,) = (line for line in self.commands if line.startswith(PYTEST))
        test = command.removeprefix(PYTEST + self.package.name + "/")
        return subprocess.run(
            [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-p", "no:xdist", test],
            cwd=self.package,
            env=self._rig.env,
            capture_output=True,
            text=True,
            check=False,
        )

    def strange_commands(self) -> list[str]:
        """The commands that the page names and no test runs."""
        known = ("./run rig ", PYTEST + self.package.name + "/")
        return [
            line
            for line in self.commands
            if not line.startswith(known) and not INSTALL.fullmatch(line)
        ]

    def _expand(self, word: str) -> list[str]:
        if "*" not in word:
            return [word]
        folder = str(self._rig.folder)
        return sorted(glob.glob(word, root_dir=folder))  # noqa: PTH207 - relative, as a shell's
