"""The processes that a command has started, for tests that do something to one of them."""

from __future__ import annotations

import contextlib
from pathlib import Path


def children_named(module: str, parent: int) -> list[int]:
    """Return the processes of one parent whose command line names a module."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            words = (process / "cmdline").read_bytes().split(b"\0")
            own = (process / "stat").read_text().rpartition(")")[2].split()[1]
            if module.encode() in words and int(own) == parent:
                found.append(int(process.name))
    return found
