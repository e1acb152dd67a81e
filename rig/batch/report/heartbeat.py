"""The heartbeat of a batch: a small file from which an outside monitor sees that it lives.

One JSON object, replaced as a whole, so that a reader never sees half of it:

    {"time": "2026-11-22T23:14:05+01:00", "pid": 4711, "state": "running", "run": 12, "of": 240,
     "point": "trial-003", "simulated": false, "holds": 0, "presses": 14,
     "message": "slip-trial-002, repeat 3"}

A monitor that cannot read JSON goes by the file's own time. On a full disk the file is
overwritten in place, so that it says so. A disk that was removed stops nothing: the file grows old,
which the monitor sees.
"""

from __future__ import annotations

import errno
import json
import logging
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Literal

from rig.core.atomic import write_text

EVERY_S = 5.0
"""Between two beats where nothing has changed but the point."""

HeartbeatState = Literal["waiting", "running", "resting", "holding", "finishing", "ended"]
"""waiting: for its window or the bench. running, resting: a run, or the rest before one. holding:
a person is needed. finishing: the bench is no longer needed. ended: nothing follows."""

BLOCK_B = 4096
"""Size of one block of a file system: so much of a heartbeat can be written on a full disk."""

log = logging.getLogger("rig")


@dataclass(frozen=True)
class HeartbeatRecord:
    """Progress of a batch."""

    state: HeartbeatState
    run: int = 0
    """Number of the run under way, or of the latest; 0 before the first."""
    of: int = 0
    """Number of runs in the queue."""
    point: str = ""
    """Id of the point being taken."""
    simulated: bool = False
    holds: int = 0
    """Holds of all runs so far that no one has asked for."""
    presses: int = 0
    """Number of presses of the object in all runs so far."""
    message: str = ""
    """The present activity, or the reason why the batch is held or has ended; for people."""
    time: str = ""
    """Time at which it was written, ISO 8601 with time zone."""
    pid: int = 0
    """Id of the process that writes."""


class Heartbeat:
    """Writes a batch's heartbeat, as often as is needed."""

    def __init__(self, path: Path, monotonic_s: Callable[[], float] = time.monotonic):
        self._path, self._monotonic_s = path, monotonic_s
        self._written: tuple[object, ...] = ()
        self._due_s = 0.0
        self._failed = False

    def write(self, beat: HeartbeatRecord) -> None:
        """Write the record: immediately if more than the point has changed, else every `EVERY_S`.
        Fills in time and pid. Never raises."""
        now_s = self._monotonic_s()
        shown = (beat.state, beat.run, beat.of, beat.simulated, beat.holds, beat.message)
        if shown == self._written and now_s < self._due_s:
            return
        self._written, self._due_s = shown, now_s + EVERY_S
        now = datetime.now().astimezone().isoformat(timespec="seconds")
        text = json.dumps({**asdict(beat), "time": now, "pid": os.getpid()}) + "\n"
        try:
            self._replace(text)
            self._failed = False
        except OSError as error:
            if not self._failed:  # once, not every few seconds
                log.warning("the heartbeat %s cannot be written: %s", self._path, error)
            self._failed = True

    def _replace(self, text: str) -> None:
        """Replace the file as a whole, or where the disk is full write over it: a block that it has
        already is enough. Raises OSError where neither is possible."""
        try:
            write_text(self._path, text, durable=False)
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT):
                raise
            content = text.encode()[:BLOCK_B]
            with self._path.open("r+b", buffering=0) as file:
                file.write(content)
                file.truncate(len(content))


def read_heartbeat(path: Path) -> HeartbeatRecord | None:
    """Return the latest heartbeat of a batch, or None if none can be read."""
    try:
        return HeartbeatRecord(**json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None
