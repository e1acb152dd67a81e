"""The person who started a batch, and those whom its file wants to be notified."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

from rig.batch.folder import BatchFolder
from rig.batch.plan.settings import BatchSettings, Occasion
from rig.batch.queue import Queue
from rig.batch.queue_file import QueueDamagedError
from rig.batch.report.notify import Notifier


class People:
    """Shows lines to the person who started a batch, and notifies people of its occasions. Nothing
    but `close` waits; warnings about notifications are shown as lines."""

    def __init__(
        self,
        folder: BatchFolder,
        settings: BatchSettings,
        queue: Queue,
        say: Callable[[str], None],
        simulated: bool,
    ):
        """Show lines by `say`, which returns at once. Notifications name the batch, its folder and
        how many runs of `queue` are in which state, and say if the bench is simulated."""
        self._folder, self._queue = folder, queue
        self._of = f"{'SIMULATED ' if simulated else ''}batch {settings.name}"
        self._notifier = Notifier(settings.notify)
        self.say = say

    def notify(self, occasion: Occasion, text: str) -> None:
        """Notify people of an occasion, with a text that says what has happened."""
        details: dict[str, Any] = {"folder": str(self._folder.path)}
        with contextlib.suppress(QueueDamagedError):
            details["runs"] = self._queue.counts()
        self._notifier.notify(occasion, f"{self._of}: {occasion}", text, details)

    def poll(self) -> None:
        """Look after the notifications under way; to be called often."""
        self._warn(self._notifier.poll())

    def close(self) -> None:
        """End the notifications under way, after the time that they may take."""
        self._warn(self._notifier.close())

    def _warn(self, warnings: list[str]) -> None:
        for warning in warnings:
            self.say(f"warning: {warning}")
