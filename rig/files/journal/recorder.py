"""The recorder thread: the run's threads put, it writes and syncs in groups.

A put costs the encoding of its record and one short lock; it never waits for the disk. Whatever
fails in the thread is the run's failure: every later call raises the first cause. What cannot be
encoded is refused at the put, with nothing queued.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, Self

from rig.core.threads import start_thread
from rig.files.errors import DiskLateError, JournalMovedError, RecordingError
from rig.files.journal.values import End, JournalEvent, Results, StreamState
from rig.files.journal.writer import JournalWriter, encode_or_raise

SYNC_INTERVAL_S = 0.25
"""Longest wall time for which a record is written but not acknowledged."""

MAX_QUEUED_BYTES = 256 << 20
"""Beyond it the disk is too slow for the run: an error, not a wait that makes ticks late."""

_GATHER_S = 0.02
_WRITE_AT_BYTES = 1 << 20


class Recorder:
    """Owns a journal and the thread that writes it. Puts keep their order, from any thread.

    Every method raises the thread's first error: RecordingError for the disk, which names path,
    cause and remedy. That the journal has moved to another path is raised once, and not by a put:
    what is put is recorded all the same.
    """

    def __init__(self, journal: JournalWriter, max_queued_bytes: int = MAX_QUEUED_BYTES) -> None:
        self._journal = journal
        self._max_queued_bytes = max_queued_bytes
        self._lock = threading.Lock()
        self._work = threading.Condition(self._lock)
        self._progress = threading.Condition(self._lock)
        self._queue: list[bytes] = []
        self._queued_bytes = 0
        self._put = 0
        self._acknowledged = 0
        self._sync_wanted = 0
        self._oldest_s: float | None = None
        """Time by the monotonic clock at which the oldest of what is not on the disk was put, or
        shortly before; None if everything is on the disk."""
        self._closing = False
        self._failure: Exception | None = None
        self._due: float | None = None
        """Time by the monotonic clock by which what is written has to be on the disk; None if all
        of it is."""
        self._moved: JournalMovedError | None = None
        """Message that the journal continues at another path, until a thread of the run has
        received it."""
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        start_thread(self._thread)

    @property
    def journal(self) -> JournalWriter:
        """The journal; only its header, path and sizes are for other threads."""
        return self._journal

    @property
    def queued_bytes(self) -> int:
        """Bytes that were put and are not written yet."""
        return self._queued_bytes

    @property
    def unacknowledged_s(self) -> float:
        """Return for how long, in s of wall time, something that was put has not been on the disk:
        0 if everything is."""
        oldest_s = self._oldest_s
        return 0.0 if oldest_s is None else time.monotonic() - oldest_s

    def put_block(self, stream: int, first_index: int, host_time: float, data: object) -> None:
        """Record rows of a stream; the data is copied. `first_index` counts the stream's rows,
        `host_time` is in s since the run's start.
        """
        encoder = self._journal.encoder
        self._put_records(lambda: encoder.block(stream, first_index, host_time, data))

    def put_event(self, fields: Mapping[str, Any] | JournalEvent) -> None:
        """Record an event: time (s since the run's start), level, code, message."""
        self._put_records(lambda: [self._journal.encoder.event(fields)])

    def put_stream(self, fields: Mapping[str, Any] | StreamState) -> None:
        """Record how a stream's counts read from here on (see `StreamState`)."""
        self._put_records(lambda: [self._journal.encoder.stream(fields)])

    def put_point_begin(self, point_id: str, fields: Mapping[str, Any]) -> None:
        """Record that a point begins."""
        self._put_records(lambda: [self._journal.encoder.point_begin(point_id, fields)])

    def put_point_keep(self, point_id: str, reading: Mapping[str, Any]) -> None:
        """Record that the open point is valid, with its reading."""
        self._put_records(lambda: [self._journal.encoder.point_keep(point_id, reading)])

    def put_point_discard(self, point_id: str, reason: str) -> None:
        """Record that the open point is not valid, and why."""
        self._put_records(lambda: [self._journal.encoder.point_discard(point_id, reason)])

    def put_end(self, fields: Mapping[str, Any] | End) -> None:
        """Record how the run, or this attempt at it, ended."""
        self._put_records(lambda: [self._journal.encoder.end(fields)])

    def put_results(self, fields: Mapping[str, Any] | Results) -> None:
        """Record what was computed from all readings, behind the END."""
        self._put_records(lambda: [self._journal.encoder.results(fields)])

    def check(self) -> None:
        """Raise the thread's first error, if there is one; JournalMovedError once only."""
        self._check_failure()
        if self._moved is not None:
            moved, self._moved = self._moved, None
            raise moved

    def _check_failure(self) -> None:
        if self._failure is not None:
            raise self._failure

    def barrier(self, timeout_s: float = 60.0) -> None:
        """Block until everything that was put before is on the disk. Raises DiskLateError if that
        takes longer than `timeout_s`, and the first error of the thread if there is one.
        """
        with self._lock:
            ticket = self._put
            self._sync_wanted = max(self._sync_wanted, ticket)
            self._work.notify()
            done = self._progress.wait_for(
                lambda: self._failure is not None or self._acknowledged >= ticket, timeout_s
            )
            self.check()
        if not done:
            raise DiskLateError(
                self._journal.path,
                f"the disk has not acknowledged anything for {timeout_s:g} s",
                "check the disk; the run can be resumed",
            )

    def close(self) -> None:
        """Write and acknowledge all that was put, end the thread, close the journal.

        Raises the first error. A second close does nothing.
        """
        with self._lock:
            if self._closing:
                return
            self._closing = True
            self._work.notify()
        self._thread.join()
        self._journal.close()
        self.check()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()
            return
        try:
            self.close()
        except Exception as error:
            if self._failure is not error:
                raise

    def _put_records(self, encode: Callable[[], list[bytes]]) -> None:
        with self._lock:
            self._check_failure()
            if self._closing:
                raise RecordingError(self._journal.path, "the recorder is closed")
            records = encode_or_raise(self._journal.path, encode)
            self._queue += records
            self._put += len(records)
            if self._oldest_s is None:
                self._oldest_s = time.monotonic()
            self._queued_bytes += sum(map(len, records))
            if self._queued_bytes > self._max_queued_bytes:
                self._failure = RecordingError(
                    self._journal.path,
                    f"the disk is too slow: {self._queued_bytes >> 20} MiB wait to be written",
                    "put the results on a local disk; the run can be resumed",
                )
                self._progress.notify_all()
                raise self._failure
            if self._queued_bytes >= _WRITE_AT_BYTES:
                self._work.notify()

    def _run(self) -> None:
        try:
            while self._write_group():
                pass
        except Exception as error:  # noqa: BLE001 - the thread's error is the run's
            with self._lock:
                self._failure = self._failure or error
                self._queue.clear()
                self._progress.notify_all()

    def _write_group(self) -> bool:
        """Write what has gathered, sync when it is due; False after the last."""
        records, put, closing = self._gather()
        gathered_s = time.monotonic()
        if records:
            self._journal.append(records)
        unsynced = self._journal.size - self._journal.acknowledged_bytes
        if not unsynced:
            self._due = None
        elif self._due is None:
            self._due = time.monotonic() + SYNC_INTERVAL_S - 2 * _GATHER_S
        if unsynced and (
            closing
            or self._sync_wanted > self._acknowledged
            or (self._due is not None and time.monotonic() >= self._due)
        ):
            self._due = None
            self._sync()
        if self._journal.acknowledged_bytes == self._journal.size:
            with self._lock:
                self._acknowledged = put
                self._oldest_s = None if self._put == put else gathered_s
                self._progress.notify_all()
        return not closing

    def _sync(self) -> None:
        try:
            self._journal.sync()
        except JournalMovedError as moved:
            with self._lock:
                self._moved = moved

    def _gather(self) -> tuple[list[bytes], int, bool]:
        """Wait for work, but not longer than a moment; take all of it."""
        with self._lock:
            self._work.wait_for(self._has_to_write, _GATHER_S)
            if self._failure is not None and not self._queue:
                raise self._failure
            records, self._queue = self._queue, []
            self._queued_bytes = 0
            return records, self._put, self._closing

    def _has_to_write(self) -> bool:
        return (
            self._closing
            or self._failure is not None
            or self._queued_bytes >= _WRITE_AT_BYTES
            or self._sync_wanted > self._acknowledged
        )
