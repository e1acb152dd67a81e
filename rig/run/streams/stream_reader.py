"""The thread that reads a streaming instrument, which owns its link meanwhile.

A procedure may be in a blocking call when the force exceeds its limit; the reader is not. Its
source reads and judges what has come, and may act on the bench by itself. A failure is stored and
raised in the procedure's thread at its next check.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Protocol

from rig.core.errors import RigError
from rig.core.threads import start_thread


class StreamSource(Protocol):
    """What a reader reads: a link with samples, and what has to be done with each of them."""

    @property
    def bytes_consumed(self) -> int:
        """Bytes taken off the link since it was opened."""
        ...

    def read(self) -> None:
        """Take in the samples that have arrived, if any; blocks for a few milliseconds at most,
        unless it acts on the bench. An exception ends the reader."""
        ...


class StreamReader:
    """Has a source read in a separate thread until stopped. The thread works within `around`."""

    def __init__(
        self,
        name: str,
        source: StreamSource,
        around: Callable[[], AbstractContextManager[None]] = contextlib.nullcontext,
    ):
        self._source = source
        self._around = around
        self._failure: BaseException | None = None
        self._stopping = threading.Event()
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
        """Wait until the read under way is over and `check` knows the result; does nothing if the
        thread does not run."""
        with self._turned:
            turns = self._turns
            self._turned.wait_for(lambda: self._turns != turns or not self._running)

    def bytes_handled(self) -> int:
        """Return the number of bytes whose samples the source has taken in; a slaved clock waits
        for it.

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

    def _run(self) -> None:
        with self._around():
            self._read_on()

    def _read_on(self) -> None:
        try:
            while not self._stopping.is_set():
                self._source.read()
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
