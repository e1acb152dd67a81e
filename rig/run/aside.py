"""Work on a link that a tick asks for and does not wait for.

A transaction takes as long as a link, an instrument and the computer's scheduler take; a tick that
waits for three of them is late whenever one of them is. In real time each link therefore has a
thread of its own while a loop runs, and what it has found is there for the next tick. Where a
simulated bench's time stands while an instrument answers there is nothing to gain: the work is done
where it is asked for, and a run stays the same to the byte.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from types import TracebackType

from rig.core.clock import Clock


class Aside:
    """What is asked of one link. Within ``with``, a thread does it, one thing after the other;
    outside, and in slaved time, `ask` does it itself.

    Leaving ``with`` waits for what was asked, unless something is raised there: then what has not
    begun is forgotten, and what is under way is left to end. A stop that follows has to hold
    against it (`rig.instruments.roles.LinearStage.stop`).
    """

    def __init__(self, name: str, clock: Clock):
        self._name, self._clock = name, clock
        self._executor: ThreadPoolExecutor | None = None
        self._asked: dict[str, Future[None]] = {}
        self._failure: BaseException | None = None
        self._begun_s: float | None = None
        """When what is under way began."""

    def __enter__(self) -> Aside:
        if not self._clock.stands:
            self._executor = ThreadPoolExecutor(1, f"aside {self._name}")
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
            executor, self._executor = self._executor, None
            self._asked.clear()
            if executor is not None:
                executor.shutdown(wait=False, cancel_futures=True)

    def ask(self, what: str, work: Callable[[], None]) -> None:
        """Have `work` done. It takes the place of a `what` asked for before that has not begun.
        Raises what an earlier work has met."""
        self.check()
        if self._executor is None:
            work()
            return
        earlier = self._asked.get(what)
        if earlier is not None:
            earlier.cancel()
        self._asked[what] = self._executor.submit(self._do, work)

    @property
    def idle(self) -> bool:
        """Whether everything asked for is done."""
        return all(asked.done() for asked in self._asked.values())

    def talking(self) -> bool:
        """Whether the link is at work, or has failed and nobody has been told yet."""
        return not self.idle or self._failure is not None

    @property
    def silent_s(self) -> float:
        """How long what is under way has been."""
        begun_s = self._begun_s
        return 0.0 if begun_s is None else self._clock.now() - begun_s

    def check(self) -> None:
        """Raise what a work has met. Nothing is done any more after that."""
        if self._failure is not None:
            raise self._failure

    def settle(self) -> None:
        """Wait until everything asked for is done; raise what it has met."""
        wait(self._asked.values())
        self.check()

    def _do(self, work: Callable[[], None]) -> None:
        if self._failure is not None:
            return
        self._begun_s = self._clock.now()
        try:
            with self._clock.aside():
                work()
        except BaseException as failure:  # noqa: BLE001 - raised by check()
            self._failure = failure
        finally:
            self._begun_s = None
