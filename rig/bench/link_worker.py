"""One thread for each instrument's link: it feeds the drive, and does what a tick asks for.

A transaction takes as long as a link, an instrument and the computer's scheduler take; a tick
that waited for three of them would be late whenever one of them is, and a drive that is fed by
whoever waits for another instrument starves when that one is slow. In real time each instrument
therefore has a thread of its own, from connecting to closing. Where a simulated bench's time stops
while an instrument answers there is no such thread: everything is done where it is asked for, in
the order in which it is asked for, and a run is repeatable to the byte.
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
"""Wall time between two looks of a thread whether its drive has to be fed; how often it then is,
the driver decides."""
OVERDUE_S = 0.1
"""A link with so much to do that it has not looked for longer looks between two pieces of work."""
SPARE_S = 1.0
"""What `settle` waits beyond the longest that one call may take."""

Work = Callable[[], None]


class LinkWorker:
    """Talks on the link of one instrument, `role`.

    Within ``with``, as long as a tick loop runs, it alone does: what is asked for is done by its
    thread, one thing after the other. Outside, and in virtual time, `ask` does it itself. Leaving
    ``with`` waits for what was asked, unless something is raised there: then what has not begun is
    dropped and what is under way is left to end. A stop that follows has to hold against it
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
        """What has not begun, in the order in which it will be done."""
        self._working = self._in_loop = self._closing = False
        self._loops = 0
        """How many loops have begun: what an earlier one left behind concerns no later one."""
        self._failure: BaseException | None = None
        """What work asked for by the loop under way has met."""
        self._feed_failure: Exception | None = None
        """What a keep-alive has met and the procedure has not yet been shown."""
        self._begun_s: float | None = None
        """When what is under way on the link began, in wall time."""
        self._fed_s = 0.0
        self._making_safe = self._given_up = False
        self._thread: threading.Thread | None = None

    # --- its life -------------------------------------------------------------------------------

    def start(self) -> None:
        """Start the thread; RigError where there is none to be had. Nothing in virtual time."""
        if self._clock.is_virtual:
            return
        self._thread = threading.Thread(target=self._run, name=f"link {self.role}", daemon=True)
        start_thread(self._thread)

    def close(self) -> None:
        """End the thread: nobody is fed afterwards. Waits for what is under way on the link, no
        longer than one call may take."""
        with self._changed:
            self._closing = True
            self._asked.clear()
            self._changed.notify_all()
        if self._thread is not None and self._thread.ident is not None:
            self._thread.join(self._patience_s + SPARE_S)

    # --- what a tick asks for -------------------------------------------------------------------

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
        """Have `work` done. It takes the place of a `what` asked for before that has not begun.
        Raises what earlier work has met."""
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
        """Whether everything asked for is done."""
        with self._changed:
            return not self._asked and not self._working

    @property
    def silent_s(self) -> float:
        """How long what is under way on the link has been, in wall time."""
        begun_s = self._begun_s
        return 0.0 if begun_s is None else time.monotonic() - begun_s

    def check(self) -> None:
        """Raise what the loop's work has met; none of it is done any more after that."""
        if self._failure is not None:
            raise self._failure

    def settle(self) -> None:
        """Wait until everything asked for is done; raise what it has met.

        The wait is one of the procedure's: stop requests and watchers may end it. InstrumentError
        where the instrument takes longer than a call may: a link that hangs is no excuse for a
        procedure that waits for it.
        """
        give_up_s = time.monotonic() + self._patience_s + SPARE_S
        while not self._idle_within(WAIT_SLICE_S):
            self._clock.sleep(0.0)
            if time.monotonic() > give_up_s and self._failure is None:
                raise InstrumentTimeoutError(
                    self.role,
                    "finish what a loop has asked for",
                    f"not done within {self._patience_s + SPARE_S:g} s",
                    "check the connection to it, and what else the computer is busy with",
                )
        self.check()

    def _idle_within(self, seconds: float) -> bool:
        with self._changed:
            return self._changed.wait_for(lambda: not self._asked and not self._working, seconds)

    # --- keeping the drive alive ----------------------------------------------------------------

    def look(self) -> None:
        """From a slice of the procedure's wait: raise, once, what a keep-alive has met. In virtual
        time this is where the keep-alive is said."""
        if self._thread is None:
            self._feed_now()
        if self._feed_failure is not None and not self._making_safe:
            failure, self._feed_failure = self._feed_failure, None
            raise failure

    def begin_making_safe(self) -> None:
        """From now on no drive ends a wait: one that does not answer is fed no more, so that it
        stops by itself. The others are, whatever the procedure does."""
        self._making_safe = True
        self._feed_failure = None  # one answer that was lost before shall not keep it from its lift

    def end_making_safe(self) -> None:
        """The offs have run: what the drive met meanwhile is forgotten, its own off has reported
        it."""
        self._making_safe = self._given_up = False
        self._feed_failure = None

    def _feed_now(self) -> None:
        if self._feed is None or self._given_up:
            return
        try:
            self._feed()
        except Exception as failure:  # noqa: BLE001 - raised by look(), a driver's bug as well
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
        """One piece of work, if there is any, and a look whether the drive has to be fed."""
        loop, work = self._next()
        if work is not None:
            self._do(loop, work)
        now_s = time.monotonic()
        if self._asked and now_s - self._fed_s < OVERDUE_S:
            return  # it has just talked to the drive, and is about to
        self._fed_s = now_s
        if self._making_safe or self._clock.procedure_alive:
            self._begun_s = now_s
            self._feed_now()
            self._begun_s = None

    def _next(self) -> tuple[int, Work | None]:
        """The next piece of work and the loop that it belongs to, or None after a while."""
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
    """The workers of a bench, by role, in the order in which the instruments were connected."""

    def __init__(self, clock: Clock):
        self._clock = clock
        self._workers: dict[str, LinkWorker] = {}

    def add(self, role: str, feed: Work | None = None, patience_s: float = SPARE_S) -> None:
        """Have a worker for this instrument from now on; RigError where no thread can be had."""
        worker = LinkWorker(role, self._clock, feed, patience_s)
        worker.start()
        self._workers[role] = worker

    def __getitem__(self, role: str) -> LinkWorker:
        return self._workers[role]

    def __iter__(self) -> Iterator[str]:
        return iter(self._workers)

    def __len__(self) -> int:
        return len(self._workers)

    def look(self) -> None:
        """In every slice of a wait: raise what a keep-alive has met; see `LinkWorker.look`."""
        for worker in tuple(self._workers.values()):
            worker.look()

    @contextlib.contextmanager
    def making_safe(self) -> Iterator[None]:
        """Within it no drive ends another one's wait, and each that answers is fed."""
        for worker in self._workers.values():
            worker.begin_making_safe()
        try:
            yield
        finally:
            for worker in self._workers.values():
                worker.end_making_safe()

    def close(self) -> None:
        """End all of them, before the instruments' links are closed."""
        for worker in self._workers.values():
            worker.close()
