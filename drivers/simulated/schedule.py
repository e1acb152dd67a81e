"""When the World's faults begin: at a bench time, or so long after an acquisition began.

It may keep the order and tell whose time has come. What then happens is its owner's affair.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from drivers.simulated.fault_plan import TimedFault


class Schedule:
    """Faults by World time in us; `begin` hears of each once, with the instant when it was due."""

    def __init__(self, faults: Iterable[TimedFault], begin: Callable[[TimedFault, int], None]):
        faults = tuple(faults)
        self._begin = begin
        self._waiting = [fault for fault in faults if fault.acquisition is not None]
        self._coming: list[tuple[int, TimedFault]] = []
        for fault in faults:
            if fault.acquisition is None:
                self._expect(fault, 0)

    def acquisition_begins(self, number: int, now_us: int) -> None:
        """The World's n-th acquisition, from 1, begins now."""
        for fault in self._waiting:
            if fault.acquisition == number:
                self._expect(fault, now_us)

    def catch_up(self, now_us: int) -> None:
        """Begin what is due by now, in its order."""
        while self._coming and self._coming[0][0] <= now_us:
            due_us, fault = self._coming.pop(0)
            self._begin(fault, due_us)

    def _expect(self, fault: TimedFault, from_us: int) -> None:
        self._coming.append((from_us + round(fault.after_s * 1e6), fault))
        self._coming.sort(key=lambda one: one[0])
