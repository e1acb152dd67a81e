"""The tick loop: what a trial does a hundred times a second, on time, without drifting.

Tick k is due at start + k / rate on the run's clock, whatever the ticks before it took. A tick that
overran its period is followed by the latest that is due, at once; those before it are left out,
which it is told: they would do again, with what is known now, what it does. Waiting is the clock's:
stop requests, keep-alives and watchers are looked at in every slice, and once before every tick,
also where there is nothing to wait for: a late loop is a sign of life. One that leaves out ticks
for longer than a stall of the computer explains controls nothing any more and ends.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from rig.clock import Clock
from rig.errors import ExitCode, RigError

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
    clock = run.clock
    planned = round(duration_s * rate_Hz)
    start_s = clock.now()
    ticks = missed = late = 0
    largest_s = total_s = 0.0
    behind_since_s: float | None = None
    going_on = True
    while going_on and ticks < planned:
        remaining_s = start_s + ticks / rate_Hz - clock.now()
        if remaining_s > 0:
            clock.sleep(remaining_s)
        else:
            run.check_stop()
        run.check_watchers()
        now_s = clock.now()
        number = ticks
        if ticks:
            latest_due = math.floor((now_s - start_s) * rate_Hz + ROUNDING)
            number = max(ticks, min(latest_due, planned - 1))
        tick = Tick(number, start_s + number / rate_Hz, now_s, number - ticks)
        for due in range(ticks, number + 1):
            late_s = max(0.0, now_s - (start_s + due / rate_Hz))
            late += late_s > LATE / rate_Hz
            largest_s = max(largest_s, late_s)
            total_s += late_s
        missed += tick.missed
        if not tick.missed:
            behind_since_s = None
        elif behind_since_s is None:
            behind_since_s = now_s
        elif now_s - behind_since_s > BEHIND_FOR_S:
            raise TooSlowError(rate_Hz, largest_s, now_s - behind_since_s)
        going_on = on_tick(tick)
        ticks = number + 1
    mean_s = total_s / ticks if ticks else 0.0
    duration = clock.now() - start_s
    return LoopStatistics(ticks, planned, missed, late, largest_s, mean_s, duration, not going_on)
