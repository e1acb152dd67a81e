"""The World's log: what happened to the simulated physics, when, and who commanded it.

One JSON object per line, flushed at once, so that it outlives the death of a run and of the bench
itself. Tests read it as the bench's own account, which no driver can embellish.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import IO

from drivers.simulated.world.timeline import WorldTimeline


class WorldLog:
    """Writes the log to a file, or nowhere."""

    def __init__(self, path: Path | None, timeline: WorldTimeline):
        self._timeline = timeline
        self._file: IO[str] | None = None
        if path is not None:
            self._file = path.open("a", encoding="utf-8", buffering=1)

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
