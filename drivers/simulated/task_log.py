"""What has begun on the bench: the tasks of its axes, and the DAQ's acquisitions.

Faults are placed by them. It may count, keep the times and tell whoever listens; what then happens
is theirs.
"""

from __future__ import annotations

from collections.abc import Callable

Beginning = tuple[str, int]
"""A device and which of its tasks or acquisitions, from 1."""


class Beginnings:
    """Everything that has begun, by World time in us."""

    def __init__(self) -> None:
        self._began_us: dict[Beginning, int] = {}
        self._count: dict[str, int] = {}
        self._listeners: list[Callable[[Beginning, int], None]] = []

    def listen(self, hear: Callable[[Beginning, int], None]) -> None:
        """Have `hear` told of everything that begins from now on, and when."""
        self._listeners.append(hear)

    def begin(self, device: str, now_us: int) -> int:
        """The device's next task or acquisition begins; its number, from 1."""
        number = self._count[device] = self._count.get(device, 0) + 1
        self._began_us[device, number] = now_us
        for hear in self._listeners:
            hear((device, number), now_us)
        return number

    def is_past(self, beginning: Beginning | None, after_s: float, now_us: int) -> bool:
        """Whether it began so long ago; None: the World did."""
        began_us = 0 if beginning is None else self._began_us.get(beginning)
        return began_us is not None and now_us >= began_us + round(after_s * 1e6)
