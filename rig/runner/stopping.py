"""Stop requests: a signal sets a flag, the next look at the flag ends the run in order.

Handlers do nothing but remember. What a second signal changes is the text, never the clean-up.
"""

from __future__ import annotations

import signal
from types import FrameType
from typing import Self

from rig.errors import ExitCode, RigError

STOP_SIGNALS = {
    signal.SIGINT: ExitCode.SIGINT,
    signal.SIGTERM: ExitCode.SIGTERM,
    signal.SIGHUP: ExitCode.SIGHUP,
}


class StopRequestedError(RigError):
    """Somebody asked the run to end; its code names the signal."""

    def __init__(self, signal_number: signal.Signals):
        super().__init__(f"stopped by {signal_number.name}", None, STOP_SIGNALS[signal_number])
        self.signal = signal_number


class StopFlag:
    """Remembers stop signals while it is entered (main thread only)."""

    def __init__(self) -> None:
        self.requested: signal.Signals | None = None
        self.times = 0
        self._previous: dict[signal.Signals, object] = {}

    def check(self) -> None:
        """Raise StopRequestedError where a stop was asked for."""
        if self.requested is not None:
            raise StopRequestedError(self.requested)

    def __enter__(self) -> Self:
        for number in STOP_SIGNALS:
            self._previous[number] = signal.signal(number, self._remember)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)  # type: ignore[arg-type]

    def _remember(self, number: int, _: FrameType | None) -> None:
        self.times += 1
        if self.requested is None:
            self.requested = signal.Signals(number)
