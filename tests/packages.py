"""Packages as `pip install` would leave them, in a folder that goes on PYTHONPATH."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def install(
    site: Path, package: str, entry_points: str, modules: Mapping[str, str] | None = None
) -> Path:
    """Put a package with the text of its entry points and its `modules`, source by file name, into
    the folder `site`; the folder."""
    info = site / f"{package.replace('-', '_')}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(entry_points)
    for name, source in (modules or {}).items():
        path = site / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(source)
    return site


def on_path(rig: Any, site: Path) -> None:
    """Let a command line find what is installed in a folder."""
    already = rig.env.get("PYTHONPATH")
    rig.env["PYTHONPATH"] = os.pathsep.join([str(site), *([already] if already else [])])
