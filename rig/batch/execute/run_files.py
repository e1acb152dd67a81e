"""The files of a batch's finished runs: which are still to be made, and what became of them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import IO

from rig.batch.execute.postprocess import PostprocessJob, PostprocessQueue, PostprocessResult
from rig.batch.folder import BatchFolder
from rig.batch.plan.settings import BatchSettings
from rig.batch.queue import Queue

Record = Callable[..., None]
"""Calls a method of the queue with values, now or once the disk takes it."""


class RunFiles:
    """Has the files of finished runs made, one run after the other, and records them in the queue.

    `log` gets what the process at work prints; `lock` is the descriptor of the batch's lock, which
    that process keeps. `say` gets warnings for the person.
    """

    def __init__(
        self,
        folder: BatchFolder,
        settings: BatchSettings,
        queue: Queue,
        record: Record,
        say: Callable[[str], None],
        log: IO[bytes],
        lock: int,
    ):
        self._folder, self._settings, self._queue = folder, settings, queue
        self._record, self._say, self._log = record, say, log
        self._jobs = PostprocessQueue(log, (lock,))
        self._numbers: dict[Path, int] = {}
        """The runs that wait, by journal."""

    def __len__(self) -> int:
        """Return the number of runs that wait for their files."""
        return len(self._jobs)

    def add(self, number: int, procedure: str) -> None:
        """Have the files of this run made after those that wait."""
        journal = self._folder.journal(number, procedure)
        if not journal.exists() and not self._folder.run_file(number, procedure).exists():
            if self._folder.queue.exists():  # otherwise the folder is away, and so are its files
                # The run failed before its first record.
                self._record(self._queue.set_processed, number, {})
            return
        self._numbers[journal] = number
        self._jobs.add(PostprocessJob(journal, self._settings.figures, self._settings.detect))

    def add_all(self, unprocessed: Iterable[tuple[int, str]]) -> None:
        """Add those of the runs, by number and procedure, that do not wait already."""
        waiting = set(self._numbers.values())
        for number, procedure in unprocessed:
            if number not in waiting:
                self.add(number, procedure)

    def poll(self, *, start: bool) -> None:
        """Record what has been made, without waiting; begin with another run if `start`."""
        if (result := self._jobs.poll(start=start)) is not None:
            self._save(result)

    def close(self, within_s: float) -> None:
        """Begin nothing more, and wait up to `within_s` for the files under way."""
        if (result := self._jobs.close(within_s)) is not None:
            self._save(result)

    def _save(self, result: PostprocessResult) -> None:
        number = self._numbers.pop(result.journal)
        for text in (*result.warnings, *filter(None, [result.error])):
            self._record(self._queue.add_event, "warning", text)
            self._say(f"warning: {text}")
            with contextlib.suppress(OSError):
                self._log.write(f"warning: {text}\n".encode())
        if result.error:
            return
        made = {
            "file": None if result.file is None else result.file.name,
            "processed": None if result.processed is None else result.processed.name,
            "figures": [figure.name for figure in result.figures],
        }
        self._record(self._queue.set_processed, number, made)
