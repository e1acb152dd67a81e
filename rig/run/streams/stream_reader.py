"""The reader thread, which owns a streaming instrument's link, buffers its samples and watches
them.

A procedure may be in a blocking call when the force exceeds its limit; the reader is not. It reads
each batch and passes it to the watchers, which may act on the bench by themselves. A failure is
stored and raised in the procedure's thread at its next check.
"""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any, Generic, Protocol, TypeVar

from rig.core.errors import RigError
from rig.core.threads import start_thread

Sample = TypeVar("Sample")
Delivered = TypeVar("Delivered", covariant=True)
Watcher = Callable[[Sequence[Any]], None]


class StreamSource(Protocol[Delivered]):
    """A link that delivers samples; `read` blocks for a few milliseconds at most."""

    @property
    def bytes_consumed(self) -> int:
        """Bytes taken off the link since it was opened."""
        ...

    def read(self) -> Sequence[Delivered]:
        """Return the samples that have arrived, possibly none."""
        ...


class StreamReader(Generic[Sample]):
    """Reads a source in a separate thread until stopped.

    `samples_kept` is the size of the buffer from which the procedure reads. The thread works within
    `around`.
    """

    def __init__(
        self,
        name: str,
        source: StreamSource[Sample],
        watchers: Sequence[Watcher] = (),
        samples_kept: int = 100_000,
        around: Callable[[], AbstractContextManager[None]] = contextlib.nullcontext,
    ):
        self._source = source
        self._around = around
        self._watchers = tuple(watchers)
        self._ring: deque[Sample] = deque(maxlen=samples_kept)
        self._failure: BaseException | None = None
        self._stopping = threading.Event()
        self._lock = threading.Lock()
        self._handled_bytes = source.bytes_consumed
        self._turned = threading.Condition()
        self._turns = 0
        self._running = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Begin reading. Raises RigError if the thread cannot be started."""
        self._running = True
        try:
            start_thread(self._thread)
        except RigError:
            self._running = False  # A thread that was not started must not be waited for.
            raise

    def stop(self) -> None:
        """End the thread and wait for it; does nothing if it was never started."""
        self._stopping.set()
        if self._thread.ident is not None:
            self._thread.join()

    def check(self) -> None:
        """Raise the failure that ended the thread, if any."""
        if self._failure is not None:
            raise self._failure

    def settle(self) -> None:
        """Wait until the read under way has been handled by all watchers and `check` knows the
        result; does nothing if the thread does not run."""
        with self._turned:
            turns = self._turns
            self._turned.wait_for(lambda: self._turns != turns or not self._running)

    def bytes_handled(self) -> int:
        """Return the number of bytes whose samples the watchers have seen; a slaved clock waits for
        it.

        Raises the failure that ended the thread: a dead reader must not be waited for.
        """
        self.check()
        return self._handled_bytes

    def await_bytes(self, count: int, patience_s: float) -> int:
        """Wait for handled bytes; see `rig.core.clock.StreamConsumer`. Raises the failure that
        ended the thread."""
        if self._handled_bytes < count:
            with self._turned:
                self._turned.wait_for(
                    lambda: self._handled_bytes >= count or not self._running, patience_s
                )
        return self.bytes_handled()

    def latest(self, count: int) -> list[Sample]:
        """Return the last `count` samples, oldest first; fewer if fewer have come."""
        with self._lock:
            return list(self._ring)[-count:] if count else []

    def _run(self) -> None:
        with self._around():
            self._read_on()

    def _read_on(self) -> None:
        try:
            while not self._stopping.is_set():
                samples = self._source.read()
                if samples:
                    with self._lock:
                        self._ring.extend(samples)
                    for watcher in self._watchers:
                        watcher(samples)
                self._handled_bytes = self._source.bytes_consumed
                self._turn()
        except BaseException as failure:  # noqa: BLE001 - raised again by check()
            self._failure = failure
        finally:
            self._turn(running=False)

    def _turn(self, running: bool = True) -> None:
        with self._turned:
            self._turns += 1
            self._running = running
            self._turned.notify_all()
