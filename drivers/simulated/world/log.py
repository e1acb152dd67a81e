"""The World's log: what happened to the simulated physics, when, and who commanded it.

One JSON object per line, flushed at once, so that it outlives the death of a run and of the bench
itself. Tests read it as the bench's own account, which no driver can embellish.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import IO

from drivers.simulated.world.timeline import WorldTimeline
from rig.core.errors import ConfigurationError


class WorldLog:
    """Writes the log to a file, or nowhere."""

    def __init__(self, path: Path | None, timeline: WorldTimeline):
        """Open the file to append to it. Raises ConfigurationError if that cannot be done."""
        self._timeline = timeline
        self._file: IO[str] | None = None
        if path is not None:
            try:
                self._file = path.open("a", encoding="utf-8", buffering=1)
            except OSError as error:
                raise ConfigurationError(
                    f"the log of the simulated bench cannot be written to {path}: {error.strerror}",
                    "give another file with --world-log, in a folder that exists",
                ) from error

    def log(self, device: str, what: str, value: object, by: str) -> None:
        """Record that `device`'s `what` became `value`, commanded by connection `by`."""
        if self._file is not None:
            entry = {
                "t_us": self._timeline.now_us,
                "device": device,
                "what": what,
                "value": value,
                "by": by,
            }
            self._file.write(json.dumps(entry) + "\n")

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None
