"""Stop requests: a signal sets a flag, and the next check of the flag ends the run in order.

Handlers set the flag and show a line, nothing else. A second signal changes the line, never the
shutdown. Only while nothing is connected yet does a signal end the program at once. A time limit
ends a run in the same way, early enough to make the bench safe by then.
"""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass
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
"""Name of each signal as a person knows it; most come from a key."""
MAKING_SAFE_S = 10.0
"""Bench time kept before a time limit for making the bench safe, which takes 2 to 3 s where nothing
fails."""
NOTICE = "stopping: making the bench safe, then saving the data ..."
NOTICE_WITHOUT_DATA = "stopping: making the bench safe ..."
NOTHING_CONNECTED = " before anything was connected; nothing was left running"
NOTICE_AGAIN = "already stopping: first the bench is made safe and the data are saved ..."


class StopRequestedError(RigError):
    """Raised when a stop was requested; the exit code names the signal."""

    def __init__(self, signal_number: signal.Signals, when: str = ""):
        text = f"stopped by {WORDS[signal_number]}{when}"
        super().__init__(text, None, STOP_SIGNALS[signal_number])


class TimeOverError(StopRequestedError):
    """Raised when the time of a run is over; the exit code is that of a stop condition."""

    def __init__(self, text: str):
        RigError.__init__(self, text, None, ExitCode.STOPPED_BY_CONDITION)


@dataclass(frozen=True)
class TimeLimit:
    """The time by which the bench has to be safe."""

    name: str
    """The setting that sets it, for people: ``stop_by = 07:00:00``."""
    left_s: Callable[[], float]
    """Return the bench time that is left, in s."""

    def check(self) -> None:
        """Raise TimeOverError once no more time is left than making safe needs."""
        if self.left_s() <= MAKING_SAFE_S:
            raise TimeOverError(f"stopped: {self.name} was reached")

    def check_before(self, duration_s: float) -> None:
        """Raise TimeOverError where a point of this duration would not be over in time."""
        left_s = self.left_s() - MAKING_SAFE_S
        if left_s < duration_s:
            raise TimeOverError(
                f"stopped: the next point takes about {duration_s:.0f} s and would not be over by "
                f"{self.name}"
            )


class StopFlag:
    """Catches stop signals while it is entered (main thread only). An ignored SIGHUP stays ignored,
    as ``nohup`` has it for what shall outlast its terminal.

    `say` shows a line to the person who waits. It is called from the signal's handler, at any point
    of the program: `notice` for the first signal, `NOTICE_AGAIN` for a further one that follows the
    usual notice.
    """

    def __init__(
        self, say: Callable[[str], None] = lambda text: None, notice: str = NOTICE
    ) -> None:
        self.requested: signal.Signals | None = None
        self.after_point = False
        """True if the run shall end before it begins another point."""
        self.time_limit: TimeLimit | None = None
        """Time by which the run under way has to end, if there is one."""
        self._say = say
        self._notice = notice
        self._nothing_connected = False
        self._previous: dict[signal.Signals, object] = {}

    def check(self) -> None:
        """Raise StopRequestedError if a stop was requested, or the time is over."""
        if self.requested is not None:
            raise StopRequestedError(self.requested)
        if self.time_limit is not None:
            self.time_limit.check()

    def check_between_points(self, duration_s: float) -> None:
        """Raise StopRequestedError if the run shall not begin another point, which is expected to
        take `duration_s` of bench time."""
        if self.after_point:
            raise StopRequestedError(signal.SIGTERM, " after a point")
        if self.time_limit is not None:
            self.time_limit.check_before(duration_s)

    @contextlib.contextmanager
    def nothing_connected(self) -> Iterator[None]:
        """Raise StopRequestedError from a signal at any point of the block, in which nothing is
        connected.

        The block also ends with it where the interrupted code took it for a failure of its own: a
        library that tries one import after the other catches whatever comes out of them.
        """
        self._nothing_connected = True
        try:
            self._check_nothing_connected()  # a signal that came before the block
            yield
        except StopRequestedError:
            raise
        except Exception:
            self._check_nothing_connected()
            raise
        finally:
            self._nothing_connected = False
        self._check_nothing_connected()

    def _check_nothing_connected(self) -> None:
        if self.requested is not None:
            raise StopRequestedError(self.requested, NOTHING_CONNECTED) from None

    def __enter__(self) -> Self:
        for number in STOP_SIGNALS:
            if number == signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN:
                continue
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
            self._say(NOTICE_AGAIN if again and self._notice == NOTICE else self._notice)
        elif not again:
            raise StopRequestedError(signal.Signals(number), NOTHING_CONNECTED)
