"""What is switched on, and how it is switched off again, whatever happens.

Each armed thing registers its off *before* it is switched on: an off that had nothing to do is
harmless, an on whose off was never registered is not. Offs run in reverse order, each isolated
from the others' failures and each with a deadline.

Each off has a thread that waits for it from the moment it is registered: where no thread can be
had, nothing is switched on, and making safe needs no thread that is yet to be made. In real time an
off that waits for an instrument's answer does not hold up the next one (`HEAD_START_S`).
"""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from rig.core.errors import RigError
from rig.core.threads import start_thread

BEAT_EVERY_S = 0.2
"""How often a run says that it is alive."""

OFF_DEADLINE_S = 3.0
"""Wall time one off action may take, besides waits for a link that is broken."""

HEAD_START_S = 0.5
"""Wall time after which the next off begins, in real time, although the one before is not done:
much longer than an instrument that answers takes to be stopped."""

Act = Callable[[], None]


class Task:
    """Something that another thread does, and what came of it."""

    def __init__(self, act: Act):
        self._act = act
        self._done = threading.Event()
        self.begun_s = time.monotonic()
        self.reason: str | None = None
        """Why it did not work, in words."""
        self.failure: Exception | None = None

    @property
    def done(self) -> bool:
        """Whether it is over, well or not."""
        return self._done.is_set()

    def run(self) -> None:
        """Do it, whatever it raises."""
        try:
            self._act()
        except RigError as error:
            self.failure, self.reason = error, error.one_line()
        except Exception as error:  # noqa: BLE001 - one off's bug must not stop the others
            self.failure, self.reason = error, f"{type(error).__name__}: {error}"
        finally:
            self._done.set()

    def done_by(self, end_s: float, beat: Act = lambda: None) -> bool:
        """Wait until it is done, or for the wall time `end_s`; calls `beat` again and again."""
        while not self._done.wait(max(0.0, min(end_s - time.monotonic(), BEAT_EVERY_S))):
            beat()
            if time.monotonic() >= end_s:
                return False
        return True


class OffThread:
    """A thread that waits for something to do; a daemon, so that one that is stuck holds up
    nothing."""

    def __init__(self) -> None:
        """RigError where no thread can be had."""
        self._tasks: queue.SimpleQueue[Task | None] = queue.SimpleQueue()
        self._latest: Task | None = None
        self.stuck = False
        """Whether something that it was given was not done by its deadline."""
        start_thread(threading.Thread(target=self._run, name="off", daemon=True))

    @property
    def busy(self) -> bool:
        """Whether something that it was given is not done."""
        return self._latest is not None and not self._latest.done

    def do(self, act: Act) -> Task:
        """Have `act` done, after what it was given before."""
        self._latest = task = Task(act)
        self._tasks.put(task)
        return task

    def end(self) -> None:
        """It ends when it has nothing more to do."""
        self._tasks.put(None)

    def _run(self) -> None:
        while (task := self._tasks.get()) is not None:
            task.run()


@dataclass(frozen=True)
class Armed:
    """One thing that has to be switched off."""

    name: str
    off: Act
    deadline_s: float
    at_once: Act | None
    """What a watcher does first, from another thread and without waiting on the bench clock."""
    watches: bool
    """Drives nothing, only looks: stays on while a run is on hold, and until all else is off."""
    thread: OffThread = field(compare=False)
    """Where its off is run."""


@dataclass(frozen=True)
class OffFailure:
    """An off action that did not work."""

    name: str
    reason: str
    watches: bool = False
    """It drives nothing: the bench is safe although this goes on."""


class Arming:
    """The register of offs of one run.

    `overlapping`: an off that takes long does not hold up the next. In virtual time it has to: one
    thread at a time may wait on that clock.
    """

    def __init__(self, overlapping: bool = False) -> None:
        self._overlapping = overlapping
        self._lock = threading.Lock()
        self._armed: list[Armed] = []
        """Replaced, never changed: who runs through it needs no lock."""

    @property
    def names(self) -> tuple[str, ...]:
        """What is armed, in the order of arming."""
        return tuple(armed.name for armed in self._armed)

    def register(
        self,
        name: str,
        off: Act,
        deadline_s: float = OFF_DEADLINE_S,
        at_once: Act | None = None,
        watches: bool = False,
    ) -> None:
        """Remember `off` under `name`; registering a name again replaces its off.

        RigError where no thread can be had for it: then `name` must not be switched on.
        """
        thread = self._thread_of(name)
        if thread is None or (thread.stuck and thread.busy):
            thread = OffThread()
        with self._lock:
            others = [armed for armed in self._armed if armed.name != name]
            self._armed = [*others, Armed(name, off, deadline_s, at_once, watches, thread)]

    def _thread_of(self, name: str) -> OffThread | None:
        return next((armed.thread for armed in self._armed if armed.name == name), None)

    def act_at_once(self) -> list[str]:
        """From a watcher's thread: what stops the bench now, each isolated; what failed, in words.

        Nothing is forgotten: the offs themselves still run at the exit.
        """
        begun: list[tuple[Armed, Task]] = []
        here: list[Task] = []
        for armed in reversed(self._armed):
            if armed.at_once is None:
                continue
            if self._overlapping and not armed.thread.busy:
                task = armed.thread.do(armed.at_once)
            else:  # its off is on the way: this shall not wait for it
                task = Task(armed.at_once)
                here.append(task)
            begun.append((armed, task))
        for task in here:
            task.run()
        failures = []
        for armed, task in begun:
            if not task.done_by(task.begun_s + armed.deadline_s):
                failures.append(f"{armed.name}: not done within {armed.deadline_s:g} s")
            elif task.failure is not None:
                failures.append(f"{armed.name}: {task.reason}")
        return failures

    def begin(self, name: str, act: Act, head_start_s: float = HEAD_START_S) -> None:
        """From another off: do `act`, which belongs to what is armed as `name`, first. In real time
        it is done in that thing's thread and this waits for it no longer than `head_start_s`.

        Raises what `act` has met, where that is known by then.
        """
        thread = self._thread_of(name) if self._overlapping else None
        if thread is None:
            act()
            return
        task = thread.do(act)
        if task.done_by(task.begun_s + head_start_s) and task.failure is not None:
            raise task.failure

    def make_safe(self, beat: Act = lambda: None, watch_on: bool = False) -> list[OffFailure]:
        """Run every off in reverse order; returns those that failed and forgets the others.

        `beat` is called before every off and again and again while it runs: a clean-up within its
        deadline is a sign of life, and nobody may kill a stage that is on its way up. With
        `watch_on` what only watches stays on.
        """
        under_way: list[tuple[Armed, Task]] = []
        failures: list[OffFailure] = []
        for armed in reversed(self._armed):
            if watch_on and armed.watches:
                continue
            if armed.watches:  # what moves may still ask it
                failures += self._await(under_way, beat)
                under_way = []
            beat()
            task = _begin_off(armed)
            under_way.append((armed, task))
            if self._overlapping:
                task.done_by(task.begun_s + min(HEAD_START_S, armed.deadline_s), beat)
            else:
                failures += self._await(under_way, beat)
                under_way = []
        return failures + self._await(under_way, beat)

    def _await(self, under_way: list[tuple[Armed, Task]], beat: Act) -> list[OffFailure]:
        """Wait for each to be done, no longer than its deadline; forget those that worked."""
        failures = []
        for armed, task in under_way:
            if task.done_by(task.begun_s + armed.deadline_s, beat):
                reason = task.reason
            else:
                armed.thread.stuck = True
                reason = f"not done within {armed.deadline_s:g} s"
            if reason is not None:
                failures.append(OffFailure(armed.name, reason, armed.watches))
            else:
                self._forget(armed)
        return failures

    def _forget(self, armed: Armed) -> None:
        """What another thread has armed meanwhile stays armed."""
        with self._lock:
            self._armed = [other for other in self._armed if other is not armed]
            replaced = any(other.thread is armed.thread for other in self._armed)
        if not replaced:
            armed.thread.end()


def _begin_off(armed: Armed) -> Task:
    """Run the off in its thread; in another where that is stuck in an earlier try, and behind that
    try where none can be had."""
    if armed.thread.stuck and armed.thread.busy:
        with contextlib.suppress(RigError):
            another = OffThread()
            task = another.do(armed.off)
            another.end()
            return task
    return armed.thread.do(armed.off)
