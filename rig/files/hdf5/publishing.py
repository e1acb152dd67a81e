"""A file gets its name only when it is whole and on the disk; its checksum lies beside it."""

from __future__ import annotations

import os
from pathlib import Path

from rig.files.journal.writer import sync_folder
from rig.files.naming import checksum_path


def publish(part: Path, target: Path, checksum: str) -> None:
    """Give a finished file its name: read-only, in place of an earlier one, SHA-256 beside it.

    The name and its checksum are on the disk when this returns; the content has to be before.
    """
    part.chmod(0o444)
    part.replace(target)
    line = part.with_name(f"{part.name}.sha256")
    try:
        with line.open("w") as file:
            file.write(f"{checksum}  {target.name}\n")
            file.flush()
            os.fsync(file.fileno())
        line.replace(checksum_path(target))
    finally:
        line.unlink(missing_ok=True)
    sync_folder(target.parent)
