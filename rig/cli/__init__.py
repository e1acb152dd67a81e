"""The command line: parses, calls, prints; no logic of its own."""

from __future__ import annotations

import sys


def main() -> None:
    """Entry point of the command ``rig``."""
    from rig.cli.app import build

    build(sys.argv[1:])()
