"""The latest frames of a force sensor, by number, for the procedure's thread."""

from __future__ import annotations

import threading
from collections import deque

import numpy as np

from rig.core.errors import InstrumentError
from rig.instruments.roles import ForceFrames

BATCHES_KEPT = 20_000


class FrameBuffer:
    """Keeps the latest batches of frames. One thread adds them, others read."""

    def __init__(self, batches: int = BATCHES_KEPT):
        self._recent: deque[ForceFrames] = deque(maxlen=batches)
        self._lock = threading.Lock()
        self._before = 0
        """Number of the first frame after those that were forgotten on purpose."""

    def add(self, frames: ForceFrames) -> None:
        """Take a batch, which may push out the oldest one."""
        with self._lock:
            self._recent.append(frames)

    def forget(self) -> None:
        """Drop all frames and continue to count."""
        with self._lock:
            if self._recent:
                self._before = self._recent[-1].first_index + len(self._recent[-1])
            self._recent.clear()

    @property
    def seen(self) -> int:
        """Number of frames so far, which is the number of the next one."""
        with self._lock:
            latest = self._recent[-1] if self._recent else None
        return latest.first_index + len(latest) if latest is not None else self._before

    def since(self, index: int) -> ForceFrames | None:
        """Return every frame from number `index` on as one batch, or None if none has come yet.

        Raises InstrumentError if some of them have left the buffer: a record must not have a gap.
        """
        found: list[ForceFrames] = []
        with self._lock:
            for frames in reversed(self._recent):
                if frames.first_index + len(frames) <= index:
                    break
                found.append(frames)
        if not found:
            return None
        oldest = found[-1]
        skip = index - oldest.first_index
        if skip < 0:
            raise InstrumentError(
                "force_sensor",
                "stream",
                f"{-skip} frames from number {index} on are no longer in the buffer",
                "read them more often",
            )
        parts = found[::-1]
        return ForceFrames(
            index,
            np.concatenate([batch.raw for batch in parts])[skip:],
            np.concatenate([batch.force_N for batch in parts])[skip:],
            np.concatenate([batch.saturated for batch in parts])[skip:],
            oldest.raw_unit,
        )

    def latest(self, wanted: int) -> list[tuple[ForceFrames, int]]:
        """Return the batches, oldest first, that have the latest `wanted` frames, and how many of
        each these are; fewer where there are no more."""
        batches: list[tuple[ForceFrames, int]] = []
        with self._lock:
            for frames in reversed(self._recent):
                batches.append((frames, min(wanted, len(frames))))
                wanted -= len(frames)
                if wanted <= 0:
                    break
        return batches[::-1]
