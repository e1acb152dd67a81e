"""Build hook: wheels and source archives get the commit that they were built from.

Run files state the commit of the program that made them. A checkout asks git; an installed wheel
has no repository to ask, so the build writes what git says into the package. A wheel that is built
from a source archive has the archive's.
"""

from __future__ import annotations

import runpy
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

PLACE = "rig/commit.txt"


class CommitHook(BuildHookInterface[Any]):
    """Adds the file with the commit to what is built."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Write the file and have it included; not for an editable installation, which asks git."""
        if version == "editable" or (Path(self.root) / PLACE).exists():
            return
        # The module needs nothing that a build's own environment has not.
        own = runpy.run_path(str(Path(self.root) / "rig" / "run" / "source_state.py"))
        with tempfile.NamedTemporaryFile("w", suffix=".txt", delete=False) as file:
            file.write(own["commit_of"](Path(self.root)) + "\n")
        self._written = Path(file.name)
        self._written.chmod(0o644)
        build_data["force_include"][file.name] = PLACE

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove the file, which is in the archive now."""
        written: Path | None = getattr(self, "_written", None)
        if written is not None:
            written.unlink(missing_ok=True)
