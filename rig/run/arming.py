"""The register of what is switched on, with the shutdown action that switches each thing off.

A shutdown action is registered *before* its thing is switched on: an action that has nothing to do
is harmless, a thing without one is not. The actions run in reverse order, each isolated from the
others' failures and each with a deadline.

Each action has a thread from the moment it is registered: if no thread can be started, nothing is
switched on, and making safe needs no new thread. In real time an action that waits for an
instrument's answer does not delay the next one (`HEAD_START_S`).
"""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from rig.core.entry_points import cause
from rig.core.errors import RigError, UnsafeError
from rig.core.threads import start_thread

BEAT_EVERY_S = 0.2
"""Interval between two heartbeats of a run."""

SHUTDOWN_DEADLINE_S = 3.0
"""Wall time that one shutdown action may take, in addition to waits for a broken link."""
EMERGENCY_DEADLINE_S = 20.0
"""Longest time for which an emergency action is waited for. It only stops or switches off, so that
the time of a long way off the object is not its own."""

HEAD_START_S = 0.5
"""Wall time after which, in real time, the next shutdown action begins although the one before is
not done: much longer than it takes to stop an instrument that answers."""

Act = Callable[[], None]


class Task:
    """A call in another thread, and its result."""

    def __init__(self, act: Act):
        self._act = act
        self._done = threading.Event()
        self.begun_s = time.monotonic()
        self.reason: str | None = None
        """Reason of its failure, in words; None if it did not fail."""
        self.failure: BaseException | None = None

    @property
    def done(self) -> bool:
        """True if the call has ended, with or without a failure."""
        return self._done.is_set()

    def run(self) -> None:
        """Make the call and note its failure; raises nothing."""
        try:
            self._act()
        # A driver may raise anything and call sys.exit(); what has not returned has not worked.
        except BaseException as error:  # noqa: BLE001 - a bug in one action must not stop the others
            self.failure, self.reason = error, type(error).__name__
            with contextlib.suppress(Exception):  # an error whose text cannot be made
                self.reason = error.one_line() if isinstance(error, RigError) else cause(error)
        finally:
            self._done.set()

    def done_by(self, end_s: float, beat: Act = lambda: None) -> bool:
        """Wait until the call is done or wall time is `end_s`, calling `beat` repeatedly; return
        whether it is done."""
        while not self._done.wait(max(0.0, min(end_s - time.monotonic(), BEAT_EVERY_S))):
            beat()
            if time.monotonic() >= end_s:
                return False
        return True


class ShutdownThread:
    """A thread that waits for calls to make. It is a daemon, so that a stuck one does not prevent
    the program from ending."""

    def __init__(self) -> None:
        """Start the thread. Raises RigError if it cannot be started."""
        self._tasks: queue.SimpleQueue[Task | None] = queue.SimpleQueue()
        self._latest: Task | None = None
        self.stuck = False
        """True if a call was not done by its deadline."""
        start_thread(threading.Thread(target=self._run, name="off", daemon=True))

    @property
    def busy(self) -> bool:
        """True if a call is waiting or under way."""
        return self._latest is not None and not self._latest.done

    def do(self, act: Act) -> Task:
        """Call `act` in this thread, after all earlier calls."""
        self._latest = task = Task(act)
        self._tasks.put(task)
        return task

    def end(self) -> None:
        """End the thread after the calls that it was given."""
        self._tasks.put(None)

    def _run(self) -> None:
        while (task := self._tasks.get()) is not None:
            task.run()


@dataclass(frozen=True)
class Armed:
    """An armed thing, with its shutdown action."""

    name: str
    off: Act
    deadline_s: float
    emergency: Act | None
    """Emergency action, which a watcher has run first. It does not wait on the bench clock."""
    watches: bool
    """True for a watcher: it stays on while a run is on hold, and until everything else is off."""
    drives: bool
    """False for what moves nothing and puts nothing out, such as an acquisition or a watcher."""
    thread: ShutdownThread = field(compare=False)
    """Thread that runs the shutdown action."""


@dataclass(frozen=True)
class ShutdownFailure:
    """A shutdown action that failed, with the reason."""

    name: str
    reason: str
    drives: bool = True
    """False for what drives nothing: the bench is safe although it is still on."""
    over_limit: bool = False
    """True if it has left a force over its limit: to stop everything does not release that."""


class Arming:
    """The register of shutdown actions of one run.

    With `overlapping` an action that takes long does not delay the next one. Virtual time does not
    allow that: one thread at a time may wait on its clock.
    """

    def __init__(self, overlapping: bool = False) -> None:
        self._overlapping = overlapping
        self._lock = threading.Lock()
        self._armed: list[Armed] = []
        """List that is replaced, never changed, so that iterating over it needs no lock."""
        self.begun = False
        """True once anything was registered, and so may have been switched on."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the armed things in the order of arming."""
        return tuple(armed.name for armed in self._armed)

    def register(
        self,
        name: str,
        off: Act,
        deadline_s: float = SHUTDOWN_DEADLINE_S,
        emergency: Act | None = None,
        watches: bool = False,
        drives: bool = True,
    ) -> None:
        """Register the shutdown action `off` of `name`; registering a name again replaces its
        action. What `watches` drives nothing.

        Raises RigError if its thread cannot be started: `name` must then not be switched on.
        """
        thread = self._thread_of(name)
        if thread is None or (thread.stuck and thread.busy):
            thread = ShutdownThread()
        self.begun = True
        with self._lock:
            others = [armed for armed in self._armed if armed.name != name]
            self._armed = [
                *others,
                Armed(name, off, deadline_s, emergency, watches, drives and not watches, thread),
            ]

    def _thread_of(self, name: str) -> ShutdownThread | None:
        return next((armed.thread for armed in self._armed if armed.name == name), None)

    def emergency_stop(self) -> list[str]:
        """Run all emergency actions, each isolated, and wait for them; return the failures in
        words.

        In real time each runs in the thread of its armed thing, so that none delays another, unless
        the shutdown action is under way there. Everything stays registered: the shutdown actions
        themselves still run at the exit.
        """
        begun: list[tuple[Armed, Task]] = []
        here: list[Task] = []
        for armed in reversed(self._armed):
            if armed.emergency is None:
                continue
            if self._overlapping and not armed.thread.busy:
                task = armed.thread.do(armed.emergency)
            else:
                # Its shutdown action is under way, and the emergency action must not wait for that.
                task = Task(armed.emergency)
                here.append(task)
            begun.append((armed, task))
        for task in here:
            task.run()
        failures = []
        for armed, task in begun:
            within_s = min(armed.deadline_s, EMERGENCY_DEADLINE_S)
            if not task.done_by(task.begun_s + within_s):
                failures.append(f"{armed.name}: not done within {within_s:g} s")
            elif task.failure is not None:
                failures.append(f"{armed.name}: {task.reason}")
        return failures

    def begin(self, name: str, act: Act, head_start_s: float = HEAD_START_S) -> None:
        """Call `act`, which belongs to the armed thing `name`, from another shutdown action and
        before the rest of it.

        In real time the call is made in that thing's thread, and this waits for it no longer than
        `head_start_s`.

        Raises the exception of `act` if it is known by then.
        """
        thread = self._thread_of(name) if self._overlapping else None
        if thread is None:
            act()
            return
        task = thread.do(act)
        if task.done_by(task.begun_s + head_start_s) and task.failure is not None:
            raise task.failure

    def make_safe(self, beat: Act = lambda: None, watch_on: bool = False) -> list[ShutdownFailure]:
        """Run every shutdown action in reverse order; return those that failed and forget the
        others.

        `beat` is called before every action and repeatedly while it runs: an action within its
        deadline is a sign of life, and the guard must not interrupt a stage on its way up. With
        `watch_on` the watchers stay on.
        """
        under_way: list[tuple[Armed, Task]] = []
        failures: list[ShutdownFailure] = []
        for armed in reversed(self._armed):
            if watch_on and armed.watches:
                continue
            if armed.watches:  # A motion that is being stopped may still read the sensor.
                failures += self._await(under_way, beat)
                under_way = []
            beat()
            task = _begin_shutdown(armed)
            under_way.append((armed, task))
            if self._overlapping:
                task.done_by(task.begun_s + min(HEAD_START_S, armed.deadline_s), beat)
            else:
                failures += self._await(under_way, beat)
                under_way = []
        return failures + self._await(under_way, beat)

    def _await(self, under_way: list[tuple[Armed, Task]], beat: Act) -> list[ShutdownFailure]:
        """Wait for each action, no longer than its deadline; forget those that worked."""
        failures = []
        for armed, task in under_way:
            if task.done_by(task.begun_s + armed.deadline_s, beat):
                reason = task.reason
            else:
                armed.thread.stuck = True
                reason = f"not done within {armed.deadline_s:g} s"
            if reason is not None:
                remains = isinstance(task.failure, UnsafeError)
                failures.append(ShutdownFailure(armed.name, reason, armed.drives, remains))
            else:
                self._forget(armed)
        return failures

    def _forget(self, armed: Armed) -> None:
        """Remove an armed thing; one that another thread has armed under its name meanwhile
        stays."""
        with self._lock:
            self._armed = [other for other in self._armed if other is not armed]
            replaced = any(other.thread is armed.thread for other in self._armed)
        if not replaced:
            armed.thread.end()


def _begin_shutdown(armed: Armed) -> Task:
    """Run the shutdown action in its thread. If that is stuck in an earlier try, use another
    thread; if none can be started, queue the action behind that try."""
    if armed.thread.stuck and armed.thread.busy:
        with contextlib.suppress(RigError):
            another = ShutdownThread()
            task = another.do(armed.off)
            another.end()
            return task
    return armed.thread.do(armed.off)
