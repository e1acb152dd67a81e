"""The check of a file that a command writes at its end, perhaps after hours."""

from __future__ import annotations

import tempfile
from pathlib import Path

from rig.core.errors import ConfigurationError


def check_new_file(option: str, file: Path) -> None:
    """Raise ConfigurationError for a file that exists, or whose folder cannot be written to."""
    if file.exists():
        raise ConfigurationError(f"{option} {file}: exists already", "choose another file")
    if not file.parent.is_dir():
        raise ConfigurationError(
            f"{option} {file}: {file.parent}: no such folder",
            "create it, or choose another folder",
        )
    try:
        with tempfile.TemporaryFile(dir=file.parent):
            pass
    except OSError as error:
        raise ConfigurationError(
            f"{option} {file}: its folder cannot be written to: {error.strerror or error}",
            "choose another folder",
        ) from error
