"""Log of the tasks that have begun on the bench: motions of its axes, and the DAQ's acquisitions.

Fault plans name a moment by them ("during the third move of stage_z"). The log counts tasks, keeps
their times and calls whoever listens; it does not know what a listener does.
"""

from __future__ import annotations

from collections.abc import Callable

TaskStart = tuple[str, int]
"""A device and the number of its task or acquisition, from 1."""


class TaskLog:
    """Every task that has begun, with its World time in us."""

    def __init__(self) -> None:
        self._began_us: dict[TaskStart, int] = {}
        self._count: dict[str, int] = {}
        self._listeners: list[Callable[[TaskStart, int], None]] = []

    def listen(self, hear: Callable[[TaskStart, int], None]) -> None:
        """Call `hear` with every task that begins from now on, and its World time in us."""
        self._listeners.append(hear)

    def begin(self, device: str, now_us: int) -> int:
        """Record that the device's next task begins now; returns its number, from 1."""
        number = self._count[device] = self._count.get(device, 0) + 1
        self._began_us[device, number] = now_us
        for hear in self._listeners:
            hear((device, number), now_us)
        return number

    def is_past(self, task: TaskStart | None, after_s: float, now_us: int) -> bool:
        """Return whether `task` began at least `after_s` ago; None stands for the World's
        beginning."""
        began_us = 0 if task is None else self._began_us.get(task)
        return began_us is not None and now_us >= began_us + round(after_s * 1e6)
