"""The folder of ``--results``, checked before minutes of computing are spent on it."""

from __future__ import annotations

import tempfile
from pathlib import Path

from rig.core.errors import ConfigurationError


def require_results_folder(results: Path) -> None:
    """Make the folder if needed. Raises ConfigurationError where nothing can be written to it."""
    try:
        results.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=results):
            pass
    except OSError as error:
        raise ConfigurationError(
            f"--results {results}: nothing can be written to it: {error.strerror or error}",
            "choose another folder",
        ) from error
