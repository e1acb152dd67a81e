"""The schedule of a plan's faults: each begins at a bench time, or some time after a task began.

A schedule returns the faults that are due; its owner applies them.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Generic, TypeVar

from drivers.simulated.faults.plan import Placed
from drivers.simulated.task_log import TaskStart

F = TypeVar("F", bound=Placed)


class Schedule(Generic[F]):
    """The faults of one device, or of the World, in the order in which they are due; each once."""

    def __init__(self, faults: Iterable[F]):
        self._faults = tuple(faults)
        self._coming: list[tuple[int, F]] = []
        self.hear(None, 0)

    def hear(self, task: TaskStart | None, now_us: int) -> None:
        """Schedule the faults that count from `task`, which begins now (None: the World)."""
        self._coming += [
            (now_us + round(fault.after_s * 1e6), fault)
            for fault in self._faults
            if fault.task == task
        ]
        self._coming.sort(key=lambda one: one[0])

    def due(self, now_us: int) -> int | None:
        """Return the World time in us at which the first fault was due; None if none is due by
        `now_us`."""
        return self._coming[0][0] if self._coming and self._coming[0][0] <= now_us else None

    def take(self) -> F:
        """Remove the first fault and return it."""
        return self._coming.pop(0)[1]
