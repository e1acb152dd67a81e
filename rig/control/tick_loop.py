"""The tick loop: what a trial does a hundred times a second, on time, without drifting.

Tick k is due at start + k / rate on the run's clock, whatever the ticks before it took. A tick that
overran its period is followed by the latest that is due, at once; those before it are left out,
which it is told: they would do again, with what is known now, what it does. Waiting is the clock's:
stop requests, keep-alives and watchers are looked at in every slice, and once before every tick,
also where there is nothing to wait for: a late loop is a sign of life. One that leaves out ticks
for longer than a stall of the computer explains controls nothing any more and ends.

In real time two threads wait for each tick, on two processors (`Relay`).
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from rig.core.clock import WAIT_SLICE_S, Clock
from rig.core.errors import ExitCode, RigError
from rig.core.processor import place, two_places

LATE = 0.5
"""Share of a period from which a tick counts as late."""
BEHIND_FOR_S = 1.0
"""How long it may leave out one tick or more before each that it takes."""
ROUNDING = 1e-6
"""Of a period, by which a clock may differ from a sum."""
HIGHEST_RATE_Hz = 500.0
"""Faster than this, the clock's wake-ups and a link of a millisecond are most of a period."""


@dataclass(frozen=True)
class Tick:
    """One turn of the loop."""

    number: int
    """From 0."""
    due_s: float
    """When it was due, on the run's clock."""
    began_s: float
    """When it began."""
    missed: int = 0
    """How many were left out just before it."""

    @property
    def late_s(self) -> float:
        """How late it began; a clock that rounds may begin it a little early: that is 0."""
        return max(0.0, self.began_s - self.due_s)


@dataclass(frozen=True)
class LoopStatistics:
    """How well a loop kept its time."""

    ticks: int
    """That were due until its end."""
    planned: int
    """That would have been due, had none of them ended the loop."""
    missed: int
    """That were left out."""
    late: int
    """That began later than half a period after they were due; a tick that was left out is late
    until the one that took its place."""
    largest_lateness_s: float
    mean_lateness_s: float
    duration_s: float
    """From the first tick's due time to the end of the last."""
    ended: bool
    """Whether a tick ended the loop."""


class TooSlowError(RigError):
    """Computer or links do not keep a loop's rate; what it controls is left to the run's exit."""

    code = ExitCode.INSTRUMENT

    def __init__(self, rate_Hz: float, largest_s: float, behind_s: float):
        super().__init__(
            f"the computer or a link to an instrument cannot keep {rate_Hz:g} Hz: for "
            f"{behind_s:.1f} s at least every second tick had to be left out, the latest came "
            f"{largest_s * 1e3:.0f} ms late",
            "end other programs, or ask for fewer ticks and samples a second",
        )


class LoopRun(Protocol):
    """What the loop needs of a run."""

    @property
    def clock(self) -> Clock:
        """What it waits on."""
        ...

    def check_stop(self) -> None:
        """Let stop requests end it."""
        ...

    def check_watchers(self) -> None:
        """Let a trip or a hold end it."""
        ...


def tick_loop(
    run: LoopRun, rate_Hz: float, duration_s: float, on_tick: Callable[[Tick], bool]
) -> LoopStatistics:
    """Call `on_tick` at `rate_Hz` for `duration_s`, or until it returns False.

    There are ``duration_s * rate_Hz`` ticks (rounded), the first at once; first and last are never
    left out. Whatever a tick, a watcher or a stop request raises ends the loop. TooSlowError where
    for more than `BEHIND_FOR_S` no tick came without another being left out. ValueError for a rate
    of nothing, above `HIGHEST_RATE_Hz` or a duration that is no number.
    """
    if not 0 < rate_Hz <= HIGHEST_RATE_Hz:
        raise ValueError(f"rate_Hz {rate_Hz:g} Hz must be above 0 and at most {HIGHEST_RATE_Hz:g}")
    if not (duration_s >= 0 and math.isfinite(duration_s)):
        raise ValueError(f"duration_s {duration_s:g} s must be a number of at least 0")
    ticks = Ticks(run, rate_Hz, round(duration_s * rate_Hz), on_tick)
    places = two_places() if not run.clock.is_virtual else None
    if places is None:
        ticks.take_all()
    else:
        Relay(ticks, run, places).take_all()
    return ticks.statistics()


class Ticks:
    """The ticks of one loop, taken one after the other."""

    def __init__(self, run: LoopRun, rate_Hz: float, planned: int, on_tick: Callable[[Tick], bool]):
        self._run, self._clock, self._on_tick = run, run.clock, on_tick
        self._rate_Hz, self._planned = rate_Hz, planned
        self._start_s = self._clock.now()
        self._due = self._missed = self._late = 0
        """Those that were due, left out and late up to now."""
        self._largest_s = self._total_s = 0.0
        self._behind_since_s: float | None = None
        self._going_on = True

    @property
    def over(self) -> bool:
        """Whether none follows."""
        return not self._going_on or self._due >= self._planned

    @property
    def next_due_s(self) -> float:
        """When the next is due, on the run's clock."""
        return self._start_s + self._due / self._rate_Hz

    def take_all(self) -> None:
        """Wait for each and take it."""
        while not self.over:
            remaining_s = self.next_due_s - self._clock.now()
            if remaining_s > 0:
                self._clock.sleep(remaining_s)
            else:
                self._run.check_stop()
            self.take()

    def take(self) -> None:
        """Take the latest that is due, or the next where none is."""
        self._run.check_watchers()
        now_s = self._clock.now()
        number = self._due
        if number:
            latest_due = math.floor((now_s - self._start_s) * self._rate_Hz + ROUNDING)
            number = max(number, min(latest_due, self._planned - 1))
        tick = Tick(number, self._start_s + number / self._rate_Hz, now_s, number - self._due)
        self._count(tick)
        self._due = number + 1
        self._going_on = self._on_tick(tick)

    def statistics(self) -> LoopStatistics:
        """How well they kept their time up to now."""
        mean_s = self._total_s / self._due if self._due else 0.0
        return LoopStatistics(
            self._due,
            self._planned,
            self._missed,
            self._late,
            self._largest_s,
            mean_s,
            self._clock.now() - self._start_s,
            not self._going_on,
        )

    def _count(self, tick: Tick) -> None:
        """TooSlowError where it is one of too many that had others left out."""
        rate_Hz, now_s = self._rate_Hz, tick.began_s
        for due in range(self._due, tick.number + 1):
            late_s = max(0.0, now_s - (self._start_s + due / rate_Hz))
            self._late += late_s > LATE / rate_Hz
            self._largest_s = max(self._largest_s, late_s)
            self._total_s += late_s
        self._missed += tick.missed
        if not tick.missed:
            self._behind_since_s = None
        elif self._behind_since_s is None:
            self._behind_since_s = now_s
        elif now_s - self._behind_since_s > BEHIND_FOR_S:
            raise TooSlowError(rate_Hz, self._largest_s, now_s - self._behind_since_s)


class Relay:
    """Two threads on two processors that wait for the same ticks: who comes first takes one.

    A processor that is busy, or on a virtual machine away, when a tick is due would make it late;
    that both are is rare. One thread at a time is the procedure; between ticks it looks at stop
    requests and keep-alives no less often than a wait of the clock does. What either meets ends
    both, and is raised by `take_all`.
    """

    def __init__(self, ticks: Ticks, run: LoopRun, places: tuple[frozenset[int], frozenset[int]]):
        self._ticks, self._run, self._clock = ticks, run, run.clock
        self._turn = threading.Lock()
        self._ended = threading.Event()
        self._failure: BaseException | None = None
        self._looked_s = -math.inf
        """When stop requests and keep-alives were looked at last."""
        self._threads = [
            threading.Thread(target=self._take_part, args=(own,), name="ticks", daemon=True)
            for own in places
        ]

    def take_all(self) -> None:
        """Until the last; the calling thread waits."""
        try:
            for thread in self._threads:
                thread.start()
            for thread in self._threads:
                thread.join()
        finally:
            self._ended.set()
            for thread in self._threads:
                if thread.ident is not None:
                    thread.join()
        if self._failure is not None:
            raise self._failure

    def _take_part(self, processors: frozenset[int]) -> None:
        place(0, processors)
        while not self._ended.is_set():
            remaining_s = self._ticks.next_due_s - self._clock.now()
            if remaining_s > 0:
                self._ended.wait(min(remaining_s, WAIT_SLICE_S))
            with self._turn:
                if self._ended.is_set():
                    return
                try:
                    self._take_what_is_due()
                except BaseException as failure:  # noqa: BLE001 - raised by take_all()
                    self._failure = failure
                    self._ended.set()

    def _take_what_is_due(self) -> None:
        now_s = self._clock.now()
        due = now_s >= self._ticks.next_due_s and not self._ticks.over
        if due or now_s - self._looked_s >= WAIT_SLICE_S:
            self._looked_s = now_s
            self._clock.sleep(0.0)
        if due:
            self._ticks.take()
        if self._ticks.over:
            self._ended.set()
