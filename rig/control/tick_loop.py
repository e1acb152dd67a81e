"""The tick loop: calls the control of a trial a hundred times a second, on time, without drift.

Tick k is due at start + k / rate on the run's clock, whatever the ticks before it took. A tick that
overran its period is followed at once by the latest tick that is due. The ticks before that one are
left out, because they would only repeat its work with the same data; `Tick.missed` has their
number. The clock does the waiting: stop requests, keep-alives and watchers are checked in every
slice, and once before every tick even if there is no wait, since a late loop is a sign of life as
well. A loop that misses ticks for longer than a stall of the computer can explain no longer
controls the force, and ends.

Everything happens in the procedure's thread, which calls the loop: a tick that hangs gives no sign
of life.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from rig.core.clock import Clock
from rig.core.errors import ExitCode, RigError

LATE = 0.5
"""Fraction of a period from which a tick is late."""
BEHIND_FOR_S = 1.0
"""Longest time in s for which every tick may be preceded by missed ones."""
ROUNDING = 1e-6
"""Fraction of a period by which the clock may differ from the sum of its waits."""
HIGHEST_RATE_Hz = 500.0
"""Highest rate: above it, the clock's wake-ups and a link of a millisecond take most of a
period."""


@dataclass(frozen=True)
class Tick:
    """One turn of the control loop, with the times at which it was due and began."""

    number: int
    """Number of the tick, from 0."""
    due_s: float
    """Bench time at which it was due."""
    began_s: float
    """Bench time at which it began."""
    missed: int = 0
    """Number of ticks missed just before it."""

    @property
    def late_s(self) -> float:
        """Delay of its beginning in s; 0 for a tick that a rounding clock began slightly early."""
        return max(0.0, self.began_s - self.due_s)


@dataclass(frozen=True)
class LoopStatistics:
    """Timing statistics of a loop."""

    ticks: int
    """Number of ticks due until the end of the loop."""
    missed: int
    """Number of ticks that were missed."""
    late: int
    """Number of ticks that began later than half a period after they were due; a missed tick is as
    late as the one that replaced it."""
    largest_lateness_s: float


class TooSlowError(RigError):
    """Raised when computer or links are too slow for the loop's rate; the run's exit makes the
    bench safe."""

    code = ExitCode.INSTRUMENT

    def __init__(self, rate_Hz: float, largest_s: float, behind_s: float):
        super().__init__(
            f"the computer or a link to an instrument cannot keep {rate_Hz:g} Hz: for "
            f"{behind_s:.1f} s at least every second tick had to be left out, the latest came "
            f"{largest_s * 1e3:.0f} ms late",
            "end other programs, or ask for fewer ticks (--tick) and samples (--rate) a second",
        )


class LoopRun(Protocol):
    """The part of a run that the loop uses."""

    @property
    def clock(self) -> Clock:
        """Clock that the loop waits on."""
        ...

    def check_stop(self) -> None:
        """Raise if a stop was requested."""
        ...

    def check_watchers(self) -> None:
        """Raise if a watcher found a trip or a hold."""
        ...


def tick_loop(
    run: LoopRun,
    rate_Hz: float,
    duration_s: float,
    on_tick: Callable[[Tick], bool],
    wait: Callable[[float], None] | None = None,
) -> LoopStatistics:
    """Call `on_tick` at `rate_Hz` for `duration_s`, or until it returns False.

    `wait` waits for the seconds until the next tick is due, by default on the run's clock; another
    one may work meanwhile. It has to check what the clock's waits check.

    There are ``duration_s * rate_Hz`` ticks (rounded), the first at once; the first and the last
    are never missed. An exception of a tick, a watcher or a stop request ends the loop. Raises
    TooSlowError if for more than `BEHIND_FOR_S` every tick was preceded by missed ones. Raises
    ValueError for a rate that is not above 0 and at most `HIGHEST_RATE_Hz`, or a duration
    that is not a finite number of at least 0.
    """
    if not 0 < rate_Hz <= HIGHEST_RATE_Hz:
        raise ValueError(f"rate_Hz {rate_Hz:g} Hz must be above 0 and at most {HIGHEST_RATE_Hz:g}")
    if not (duration_s >= 0 and math.isfinite(duration_s)):
        raise ValueError(f"duration_s {duration_s:g} s must be a number of at least 0")
    ticks = _Ticks(run, rate_Hz, round(duration_s * rate_Hz), on_tick, wait or run.clock.sleep)
    ticks.take_all()
    return ticks.statistics()


class _Ticks:
    """Runs the ticks of one loop, one after the other."""

    def __init__(
        self,
        run: LoopRun,
        rate_Hz: float,
        planned: int,
        on_tick: Callable[[Tick], bool],
        wait: Callable[[float], None],
    ):
        self._run, self._clock, self._on_tick, self._wait = run, run.clock, on_tick, wait
        self._rate_Hz, self._planned = rate_Hz, planned
        self._start_s = self._clock.now()
        self._due = self._missed = self._late = 0
        """Numbers of ticks due, missed and late so far."""
        self._largest_s = 0.0
        self._behind_since_s: float | None = None
        self._continues = True

    @property
    def over(self) -> bool:
        """True after the last tick."""
        return not self._continues or self._due >= self._planned

    @property
    def next_due_s(self) -> float:
        """Bench time at which the next tick is due."""
        return self._start_s + self._due / self._rate_Hz

    def take_all(self) -> None:
        """Wait for each tick and run it; returns after the last."""
        while not self.over:
            remaining_s = self.next_due_s - self._clock.now()
            if remaining_s > 0:
                self._wait(remaining_s)
            else:
                self._run.check_stop()
            self.take()

    def take(self) -> None:
        """Run the latest tick that is due, or the next one if none is."""
        self._run.check_watchers()
        now_s = self._clock.now()
        number = self._due
        if number:
            latest_due = math.floor((now_s - self._start_s) * self._rate_Hz + ROUNDING)
            number = max(number, min(latest_due, self._planned - 1))
        tick = Tick(number, self._start_s + number / self._rate_Hz, now_s, number - self._due)
        self._count(tick)
        self._due = number + 1
        self._continues = self._on_tick(tick)

    def statistics(self) -> LoopStatistics:
        """Return the statistics of the ticks so far."""
        return LoopStatistics(self._due, self._missed, self._late, self._largest_s)

    def _count(self, tick: Tick) -> None:
        """Count a tick. Raises TooSlowError if ticks have been missed for too long."""
        rate_Hz, now_s = self._rate_Hz, tick.began_s
        for due in range(self._due, tick.number + 1):
            late_s = max(0.0, now_s - (self._start_s + due / rate_Hz))
            self._late += late_s > LATE / rate_Hz
            self._largest_s = max(self._largest_s, late_s)
        self._missed += tick.missed
        if not tick.missed:
            self._behind_since_s = None
        elif self._behind_since_s is None:
            self._behind_since_s = now_s
        elif now_s - self._behind_since_s > BEHIND_FOR_S:
            raise TooSlowError(rate_Hz, self._largest_s, now_s - self._behind_since_s)
