"""The tick loop: what a trial does a hundred times a second, on time, without drifting.

Tick k is due at start + k / rate on the run's clock, whatever the ticks before it took; a tick that
overran its period is followed by the next at once, and none is left out. Waiting is the clock's:
stop requests, keep-alives and watchers are looked at in every slice, and once before every tick,
also where there is nothing to wait for: a late loop is a sign of life. One that stays behind for
longer than a stall of the computer explains controls nothing any more and ends.
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
BEHIND_S = 0.1
"""Lateness that a loop works off again after a stall."""
BEHIND_FOR_S = 1.0
"""How long it may be behind by more than that before it is said not to keep up."""
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

    @property
    def late_s(self) -> float:
        """How late it began; a clock that rounds may begin it a little early: that is 0."""
        return max(0.0, self.began_s - self.due_s)


@dataclass(frozen=True)
class LoopStatistics:
    """How well a loop kept its time."""

    ticks: int
    """That ran."""
    planned: int
    """That would have run, had none of them ended the loop."""
    late: int
    """That began later than half a period after they were due."""
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
            f"{behind_s:.1f} s every tick was late by more than {BEHIND_S * 1e3:.0f} ms, the worst "
            f"by {largest_s * 1e3:.0f} ms",
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

    There are ``duration_s * rate_Hz`` ticks (rounded), the first at once. Whatever a tick, a
    watcher or a stop request raises ends the loop. TooSlowError where every tick of more than
    `BEHIND_FOR_S` was late by more than `BEHIND_S`. ValueError for a rate of nothing, above
    `HIGHEST_RATE_Hz` or a duration that is no number.
    """
    if not 0 < rate_Hz <= HIGHEST_RATE_Hz:
        raise ValueError(f"rate_Hz {rate_Hz:g} Hz must be above 0 and at most {HIGHEST_RATE_Hz:g}")
    if not (duration_s >= 0 and math.isfinite(duration_s)):
        raise ValueError(f"duration_s {duration_s:g} s must be a number of at least 0")
    clock = run.clock
    planned = round(duration_s * rate_Hz)
    start_s = clock.now()
    ticks = late = 0
    largest_s = total_s = 0.0
    behind_since_s: float | None = None
    going_on = True
    while going_on and ticks < planned:
        due_s = start_s + ticks / rate_Hz
        remaining_s = due_s - clock.now()
        if remaining_s > 0:
            clock.sleep(remaining_s)
        else:
            run.check_stop()
        run.check_watchers()
        tick = Tick(ticks, due_s, clock.now())
        late += tick.late_s > LATE / rate_Hz
        largest_s = max(largest_s, tick.late_s)
        total_s += tick.late_s
        if tick.late_s <= BEHIND_S:
            behind_since_s = None
        elif behind_since_s is None:
            behind_since_s = tick.began_s
        elif tick.began_s - behind_since_s > BEHIND_FOR_S:
            raise TooSlowError(rate_Hz, largest_s, tick.began_s - behind_since_s)
        going_on = on_tick(tick)
        ticks += 1
    mean_s = total_s / ticks if ticks else 0.0
    duration = clock.now() - start_s
    return LoopStatistics(ticks, planned, late, largest_s, mean_s, duration, not going_on)
