"""Observers of a run, which show or forward its progress and must never disturb it.

An observer derives from `RunObserver` and overrides what it wants to know. `Observers` calls all of
them; an exception in one is reported once as a warning and the run continues.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
import time
from collections.abc import Callable, Sequence, Set
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rig.core.errors import LONGEST_REASON, shortened
from rig.core.threads import start_thread

if TYPE_CHECKING:
    from rig.run.points import Point, Reading

RUNNING, PAUSED, HOLD, MAKING_SAFE = "running", "paused", "hold", "making safe"
"""States that `RunObserver.state` reports."""


class RunObserver:
    """Base of an observer of a run. Every method here does nothing; override those that you need.

    The methods are called one at a time and in order, from a thread of the observers. The run's own
    thread waits for them, at most `OBSERVED_S` while the bench may be armed: return within a few
    milliseconds, and never wait for a person or a network. Behind an observer that blocks, the
    calls wait for their turn and the run continues. No observer is waited for between the reason to
    make the bench safe and its being safe.
    """

    @property
    def observer_name(self) -> str:
        """Name of this observer in a warning."""
        return type(self).__name__.lstrip("_")

    def planned(self, points: Sequence[Point], recorded: Set[str], overhead_s: float) -> None:
        """Take note of the points of the run, in their order. Called before the first point is
        measured, and again when the procedure has added further points.

        `recorded` are the ids of points that are in the journal already; `overhead_s` is the bench
        time that arming and making safe will take, and further points that the procedure adds.
        """

    def point_recorded(self, number: int, total: int, point: Point, reading: Reading) -> None:
        """Take note that a point is in the journal, the `number`-th of `total`."""

    def event(self, level: str, message: str) -> None:
        """Show a message that a person should see now; `level` is info, warning or error."""

    def state(self, name: str) -> None:
        """Take note of the run's new state: ``running``, ``paused`` (by the operator) or on
        ``hold`` (for another reason), each with the bench safe but for ``running``; or it is
        ``making safe``."""

    def hold_begun(self, reason: str, holds: int, presses: int) -> None:
        """Take note of a hold that is not a pause by the operator, once the bench is safe: its
        reason, and how many holds and presses the run has had so far."""

    def pressed(self, presses: int) -> None:
        """Take note that z goes down to press the object, for so many times in the run so far."""

    def saving(self) -> None:
        """Take note that the bench is safe and the run file is about to be written. Not called for
        a run without a point, nor if the journal is compiled later."""

    def saved(self, run_file: Path) -> None:
        """Take note that the run file is complete."""


Call = Callable[[RunObserver], None]

OBSERVED_S = 0.1
"""Longest wait of the run for its observers while the bench may be armed: a fraction of the time
without a sign of life after which drives are no longer fed (`rig.core.clock.SIGN_OF_LIFE_S`)."""
ANNOUNCED_S = 5.0
"""Longest wait for the observers once the bench is safe, so that their lines come before what
follows: one that blocks must not keep the data from being saved."""


class Observers(RunObserver):
    """Forwards every call to several observers, each isolated from the exceptions of the others."""

    def __init__(self, observers: Sequence[RunObserver], warn: Callable[[str], None]):
        self._observers = tuple(observers)
        self._warn = warn
        """Function that records a warning; called once for each observer that fails."""
        self._failed: set[int] = set()
        self._announced: queue.SimpleQueue[Call | None] = queue.SimpleQueue()
        self._changed = threading.Condition()
        self._pending = 0
        """Calls that the observers have not taken note of yet."""
        self._behind_s = 0.0
        """Longest wait that has run out since the observers last had nothing to take note of."""
        self._unless_over: tuple[float, str, str] | None = None
        """Time by the monotonic clock, in s, and level and text of what is shown then unless the
        run is over."""
        # Started here, before anything moves: making safe must not depend on a thread that the
        # computer may refuse to start by then.
        start_thread(threading.Thread(target=self._take_announced, name="observers", daemon=True))

    def planned(self, points: Sequence[Point], recorded: Set[str], overhead_s: float) -> None:
        """See `RunObserver`."""
        self._each(lambda one: one.planned(points, recorded, overhead_s))

    def point_recorded(self, number: int, total: int, point: Point, reading: Reading) -> None:
        """See `RunObserver`."""
        self._each(lambda one: one.point_recorded(number, total, point, reading))

    def event(self, level: str, message: str) -> None:
        """See `RunObserver`."""
        self._each(lambda one: one.event(level, message))

    def state(self, name: str) -> None:
        """See `RunObserver`."""
        self._each(lambda one: one.state(name))

    def hold_begun(self, reason: str, holds: int, presses: int) -> None:
        """See `RunObserver`."""
        self._each(lambda one: one.hold_begun(reason, holds, presses))

    def pressed(self, presses: int) -> None:
        """See `RunObserver`. The observers are not waited for."""
        self._announce(lambda one: one.pressed(presses))

    def making_safe(self) -> None:
        """Report the state ``making safe`` without waiting for the observers: one that blocks must
        not delay the shutdown actions."""
        self._announce(lambda one: one.state(MAKING_SAFE))

    def warn_at_once(self, message: str) -> None:
        """Show a warning, from any thread, without waiting for the observers, as `making_safe`."""
        self._announce(lambda one: one.event("warning", message))

    def unless_over(self, after_s: float, message: str, level: str = "info") -> None:
        """Show a message of this level after this time unless `end` is called before. For what the
        run's own thread could not report: it may then wait for a disk that does not answer."""
        self._unless_over = time.monotonic() + after_s, level, message
        self._announce(lambda one: None)  # the observers' thread now wakes at that time

    def end(self) -> None:
        """End the observers' thread after their last call, and wait for that at most
        `ANNOUNCED_S`."""
        self._announced.put(None)
        self._await(ANNOUNCED_S)

    def saving(self) -> None:
        """See `RunObserver`."""
        self._each(lambda one: one.saving(), ANNOUNCED_S)

    def saved(self, run_file: Path) -> None:
        """See `RunObserver`."""
        self._each(lambda one: one.saved(run_file), ANNOUNCED_S)

    def _each(self, call: Call, longest_s: float | None = None) -> None:
        """Have all observers take note, and wait for them at most `longest_s`."""
        self._announce(call)
        self._await(OBSERVED_S if longest_s is None else longest_s)

    def _await(self, longest_s: float) -> None:
        """Wait until the observers have taken note of everything. Behind one that blocks, only the
        first wait is made: several in a row must not add up."""
        with self._changed:
            if longest_s <= self._behind_s:
                return
            if not self._changed.wait_for(lambda: self._pending == 0, longest_s):
                self._behind_s = longest_s

    def _announce(self, call: Call) -> None:
        with self._changed:
            self._pending += 1
        self._announced.put(call)

    def _take_announced(self) -> None:
        while (call := self._next()) is not None:
            self._call_each(call)
            with self._changed:
                self._pending -= 1
                if self._pending == 0:
                    self._behind_s = 0.0
                self._changed.notify_all()

    def _next(self) -> Call | None:
        """Return what follows, None at the end; meanwhile show what is due."""
        while self._unless_over is not None:
            due_s, level, message = self._unless_over
            with contextlib.suppress(queue.Empty):
                return self._announced.get(timeout=max(0.0, due_s - time.monotonic()))
            self._unless_over = None
            self._call_each(partial(_show, level, message))
        return self._announced.get()

    def _call_each(self, call: Call) -> None:
        for observer in self._observers:
            try:
                call(observer)
            except (Exception, SystemExit) as error:  # noqa: BLE001 - whatever it raises
                self._report(observer, error)

    def _report(self, observer: RunObserver, error: BaseException) -> None:
        if id(observer) in self._failed:
            return
        self._failed.add(id(observer))
        name = type(observer).__name__
        with contextlib.suppress(Exception):
            name = observer.observer_name
        what = " ".join(f"{type(error).__name__}: {error}".split())
        text = f"{name} failed: {shortened(what, LONGEST_REASON)}; the run continues without it"
        logging.getLogger("rig").warning("%s", text, exc_info=error)
        self._warn(text)
        self._call_each(lambda one: one.event("warning", text))


def _show(level: str, message: str, observer: RunObserver) -> None:
    observer.event(level, message)
