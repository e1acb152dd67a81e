"""One thread for each instrument's link: it sends keep-alives and makes the calls of control ticks.

A transaction takes as long as a link, an instrument and the computer's scheduler take; a tick that
waited for three of them would be late whenever one of them is, and a drive whose keep-alive is sent
by a thread that also waits for another instrument would stop when that one is slow. In real time
each instrument therefore has a thread of its own, from connecting to closing. In virtual time,
which stops while an instrument answers, there is no such thread: every call is made by the thread
that asks for it, in the order of asking, so that a run is repeatable to the byte.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from types import TracebackType
from typing import Self

from rig.core.clock import WAIT_SLICE_S, Clock
from rig.core.errors import InstrumentTimeoutError
from rig.core.threads import start_thread

FEED_EVERY_S = 0.02
"""Wall time between two calls of a drive's keep-alive; the driver decides how often it then sends a
message."""
OVERDUE_S = 0.1
"""Time after which a busy link calls the keep-alive between two pieces of work."""
SPARE_S = 1.0
"""Time that `settle` waits beyond the longest time that one call may take."""

Work = Callable[[], None]


class LinkWorker:
    """The one user of the link of the instrument `role`: makes calls and sends keep-alives.

    Within ``with``, as long as a tick loop runs, its thread makes the calls that are asked for, one
    after the other. Outside, and in virtual time, `ask` makes the call itself. Leaving ``with``
    waits for the calls, unless an exception leaves it: then calls that have not begun are dropped
    and the one under way is left to end. A stop that follows must take effect despite that call
    (`rig.instruments.roles.LinearStage.stop`).

    `feed` is the instrument's keep-alive, if it has one. The thread calls it for as long as the
    procedure gives signs of life (`Clock.procedure_alive`), whatever the procedure is waiting for.
    `patience_s` is the longest that one call on the instrument may take.
    """

    def __init__(
        self, role: str, clock: Clock, feed: Work | None = None, patience_s: float = SPARE_S
    ):
        self.role = role
        self._clock, self._feed, self._patience_s = clock, feed, patience_s
        self._changed = threading.Condition()
        self._asked: dict[str, Work] = {}
        """Calls that have not begun, in the order in which they will be made."""
        self._working = self._in_loop = self._closing = False
        self._loops = 0
        """Number of tick loops begun so far: a failure of an earlier loop does not concern a later
        one."""
        self._failure: BaseException | None = None
        """Exception raised by a call of the present tick loop."""
        self._feed_failure: Exception | None = None
        """Exception raised by a keep-alive that has not been raised in the procedure's thread
        yet."""
        self._begun_s: float | None = None
        """Wall time at which the present call on the link began."""
        self._fed_s = 0.0
        self._making_safe = self._given_up = False
        self._thread: threading.Thread | None = None

    # --- its life -------------------------------------------------------------------------------

    def start(self) -> None:
        """Start the thread, except in virtual time. Raises RigError if it cannot be started."""
        if self._clock.is_virtual:
            return
        self._thread = threading.Thread(target=self._run, name=f"link {self.role}", daemon=True)
        start_thread(self._thread)

    def close(self) -> None:
        """End the thread, and with it the keep-alives. Waits for a call under way on the link, but
        no longer than one call may take."""
        with self._changed:
            self._closing = True
            self._asked.clear()
            self._changed.notify_all()
        if self._thread is not None and self._thread.ident is not None:
            self._thread.join(self._patience_s + SPARE_S)

    # --- calls of control ticks -------------------------------------------------------------------

    def __enter__(self) -> Self:
        with self._changed:
            self._loops += 1
            self._failure = None
            self._in_loop = self._thread is not None
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        raised: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            if raised is None:
                self.settle()
        finally:
            with self._changed:
                self._in_loop = False
                self._loops += 1
                self._asked.clear()
                self._failure = None

    def ask(self, what: str, work: Work) -> None:
        """Request a call of `work`. It replaces an earlier request of the same name `what` that has
        not begun. Raises the exception of an earlier call."""
        self.check()
        if not self._in_loop:
            work()
            return
        with self._changed:
            self._asked.pop(what, None)
            self._asked[what] = work
            self._changed.notify_all()

    @property
    def idle(self) -> bool:
        """True if every call asked for has been made."""
        with self._changed:
            return not self._asked and not self._working

    @property
    def silent_s(self) -> float:
        """Return for how long the present call on the link has been under way, in s of wall
        time."""
        begun_s = self._begun_s
        return 0.0 if begun_s is None else time.monotonic() - begun_s

    def check(self) -> None:
        """Raise the exception of a call of this tick loop; no further call is made after one."""
        if self._failure is not None:
            raise self._failure

    def settle(self) -> None:
        """Wait until every call asked for has been made; raise the exception of one that failed.

        Stop requests and watchers may end the wait, as any wait of the procedure. Raises
        InstrumentTimeoutError if the instrument takes longer than a call may: a link that hangs
        must not make the procedure hang.
        """
        give_up_s = time.monotonic() + self._patience_s + SPARE_S
        while not self._idle_within(WAIT_SLICE_S):
            self._clock.sleep(0.0)
            if time.monotonic() > give_up_s and self._failure is None:
                raise InstrumentTimeoutError(
                    self.role,
                    "finish the calls of the tick loop",
                    f"not done within {self._patience_s + SPARE_S:g} s",
                    "check the connection to it, and what else the computer is busy with",
                )
        self.check()

    def _idle_within(self, seconds: float) -> bool:
        with self._changed:
            return self._changed.wait_for(lambda: not self._asked and not self._working, seconds)

    # --- keeping the drive alive ----------------------------------------------------------------

    def poll(self) -> None:
        """Raise, once, the exception of a keep-alive. Call it in every slice of a wait.

        In virtual time the keep-alive itself is sent here.
        """
        if self._thread is None:
            self._feed_now()
        if self._feed_failure is not None and not self._making_safe:
            failure, self._feed_failure = self._feed_failure, None
            raise failure

    def begin_making_safe(self) -> None:
        """Let no drive end a wait from now on. A drive that does not answer gets no further
        keep-alive, so that it stops by itself. The other drives continue to get keep-alives,
        whatever the procedure does."""
        self._making_safe = True
        # An answer that was lost before must not stop the keep-alives while the axis is lifted.
        self._feed_failure = None

    def end_making_safe(self) -> None:
        """Continue as before making safe. A failure of the drive meanwhile is dropped: its own
        shutdown action has reported it."""
        self._making_safe = self._given_up = False
        self._feed_failure = None

    def _feed_now(self) -> None:
        if self._feed is None or self._given_up:
            return
        try:
            self._feed()
        except Exception as failure:  # noqa: BLE001 - raised by poll(), a driver's bug as well
            if self._making_safe:
                self._given_up = True
            elif self._feed_failure is None:
                self._feed_failure = failure

    # --- the thread -----------------------------------------------------------------------------

    def _run(self) -> None:
        with self._clock.in_background():
            while not self._closing:
                self._take_turn()

    def _take_turn(self) -> None:
        """Make one call, if any is asked for, and send a keep-alive if it is due."""
        loop, work = self._next()
        if work is not None:
            self._do(loop, work)
        now_s = time.monotonic()
        if self._asked and now_s - self._fed_s < OVERDUE_S:
            return  # The call has just talked to the drive, or is about to: that feeds it as well.
        self._fed_s = now_s
        if self._making_safe or self._clock.procedure_alive:
            self._begun_s = now_s
            self._feed_now()
            self._begun_s = None

    def _next(self) -> tuple[int, Work | None]:
        """Return the next call and the number of its tick loop; None if no call comes for a
        while."""
        with self._changed:
            if not self._asked and not self._closing:
                self._changed.wait(None if self._feed is None else FEED_EVERY_S)
            if not self._asked or self._closing:
                return 0, None
            work = self._asked.pop(next(iter(self._asked)))
            self._working = True
            return self._loops, work

    def _do(self, loop: int, work: Work) -> None:
        self._begun_s = time.monotonic()
        try:
            work()
        except BaseException as failure:  # noqa: BLE001 - raised by check()
            with self._changed:
                if loop == self._loops:
                    self._failure = failure
                    self._asked.clear()
        finally:
            self._begun_s = None
            with self._changed:
                self._working = False
                self._changed.notify_all()


class LinkWorkers(Mapping[str, LinkWorker]):
    """The link workers of a bench, by role, in the order in which the instruments were
    connected."""

    def __init__(self, clock: Clock):
        self._clock = clock
        self._workers: dict[str, LinkWorker] = {}

    def add(self, role: str, feed: Work | None = None, patience_s: float = SPARE_S) -> None:
        """Start a worker for this instrument. Raises RigError if its thread cannot be started."""
        worker = LinkWorker(role, self._clock, feed, patience_s)
        worker.start()
        self._workers[role] = worker

    def __getitem__(self, role: str) -> LinkWorker:
        return self._workers[role]

    def __iter__(self) -> Iterator[str]:
        return iter(self._workers)

    def __len__(self) -> int:
        return len(self._workers)

    def poll(self) -> None:
        """Raise the exception of a keep-alive of any link; see `LinkWorker.poll`."""
        for worker in tuple(self._workers.values()):
            worker.poll()

    @contextlib.contextmanager
    def making_safe(self) -> Iterator[None]:
        """Let no drive end a wait within the block; each drive that answers gets keep-alives."""
        for worker in self._workers.values():
            worker.begin_making_safe()
        try:
            yield
        finally:
            for worker in self._workers.values():
                worker.end_making_safe()

    def close(self) -> None:
        """End all workers; called before the instruments' links are closed."""
        for worker in self._workers.values():
            worker.close()
