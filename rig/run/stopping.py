"""Stop requests: a signal sets a flag, the next look at the flag ends the run in order.

Handlers remember and say so, nothing else. What a second signal changes is the text, never the
clean-up. Only while nothing is connected yet does a signal end what is going on there and then.
"""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Self

from rig.core.errors import ExitCode, RigError

STOP_SIGNALS = {
    signal.SIGINT: ExitCode.SIGINT,
    signal.SIGQUIT: ExitCode.SIGQUIT,
    signal.SIGTERM: ExitCode.SIGTERM,
    signal.SIGHUP: ExitCode.SIGHUP,
}


WORDS = {
    signal.SIGINT: "Ctrl-C",
    signal.SIGQUIT: "Ctrl-\\",
    signal.SIGTERM: "SIGTERM",
    signal.SIGHUP: "SIGHUP",
}
"""What a person calls each signal, most of which come from a key."""
NOTICE = "stopping: making the bench safe, then saving the data ..."
NOTICE_AGAIN = "already stopping: first the bench is made safe and the data are saved ..."


class StopRequestedError(RigError):
    """The run was asked to end; the exit code names the signal."""

    def __init__(self, signal_number: signal.Signals, when: str = ""):
        text = f"stopped by {WORDS[signal_number]}{when}"
        super().__init__(text, None, STOP_SIGNALS[signal_number])


class StopFlag:
    """Remembers stop signals while it is entered (main thread only).

    `tell` gets a line for the person who waits, from within the signal's handler: it may interrupt
    anything.
    """

    def __init__(self, tell: Callable[[str], None] = lambda text: None) -> None:
        self.requested: signal.Signals | None = None
        self.after_point = False
        """Whether the run shall end before the next point that it would begin."""
        self._tell = tell
        self._nothing_connected = False
        self._previous: dict[signal.Signals, object] = {}

    def check(self) -> None:
        """Raise StopRequestedError where a stop was asked for."""
        if self.requested is not None:
            raise StopRequestedError(self.requested)

    def check_between_points(self) -> None:
        """Raise StopRequestedError where the run shall not begin another point."""
        if self.after_point:
            raise StopRequestedError(signal.SIGTERM, " after a point")

    @contextlib.contextmanager
    def nothing_connected(self) -> Iterator[None]:
        """Within it a signal raises StopRequestedError wherever the program is."""
        self._nothing_connected = True
        try:
            yield
        finally:
            self._nothing_connected = False

    def __enter__(self) -> Self:
        for number in STOP_SIGNALS:
            self._previous[number] = signal.signal(number, self._remember)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)  # type: ignore[arg-type]

    def _remember(self, number: int, _: FrameType | None) -> None:
        again = self.requested is not None
        if not again:
            self.requested = signal.Signals(number)
        if not self._nothing_connected:
            self._tell(NOTICE_AGAIN if again else NOTICE)
        elif not again:
            when = " before anything was connected; nothing was left running"
            raise StopRequestedError(signal.Signals(number), when)
