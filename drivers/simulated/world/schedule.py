"""When faults of the World begin: at a bench time, or so long after something else began.

It may keep the order and tell whose time has come. What then happens is its owner's affair.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Generic, TypeVar

from drivers.simulated.faults.plan import Placed
from drivers.simulated.task_log import Beginning

F = TypeVar("F", bound=Placed)


class Schedule(Generic[F]):
    """Faults by World time in us, of which each comes once."""

    def __init__(self, faults: Iterable[F]):
        self._faults = tuple(faults)
        self._coming: list[tuple[int, F]] = []
        self.hear(None, 0)

    def hear(self, beginning: Beginning | None, now_us: int) -> None:
        """Something begins now, or with None the World: expect what is placed by it."""
        self._coming += [
            (now_us + round(fault.after_s * 1e6), fault)
            for fault in self._faults
            if fault.beginning == beginning
        ]
        self._coming.sort(key=lambda one: one[0])

    def due(self, now_us: int) -> int | None:
        """When the first of those that are due by now was due; None where none is."""
        return self._coming[0][0] if self._coming and self._coming[0][0] <= now_us else None

    def take(self) -> F:
        """The first one, which then is expected no more."""
        return self._coming.pop(0)[1]
