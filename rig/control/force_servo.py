"""The normal force held constant by a z axis that takes positions: the numbers, no instrument.

The axis is stiff and the skin is not: a position decides a force,

    F = k z + d,

with the contact's stiffness k near the target and everything else, creep and above all what the
shear of a slide does to the normal force, in the disturbance d. What is known of d is old by the
time anything can be done about it: a command is seen in the force `delay_s` after it was given. So
the servo keeps account of where the axis is (trapezoids of speed, as a drive makes them), follows d
and its slope with a fading-memory filter (alpha-beta, critically damped), and gives at every tick
the position that makes the force right when that position will have been reached. A d that stands
or changes evenly leaves no error in the mean: the account of positions is the integrator.

One number sets how quickly it believes what it sees, `memory_s`. It follows from delay and tick, so
that k may be 1.3 times or half the one assumed: the skin's rises with the force, and changes when
ridges slip. `rig.control.approach` comes before and measures k. How well it holds: decision 0035.

Both may take longer now and then: a target that a busy link has carried late, a force that was
heard late. The servo is told of each (`ForceServo.step`), and puts the force seen to where the axis
was then.

A slide that is repeated disturbs the force again in the same way: what one slide has shown,
`ContactShift`, may be given to the servo for the next ones, which then have only the difference to
follow. What a slide shows that was helped itself is no better: noise adds up from one to the next.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from dataclasses import dataclass

MEMORY = 1.3
"""Of the filter, in times from a command until its middle is seen. With less, it rings where k is
1.3 times the one assumed, and the axis's counts keep it going to and fro."""
ARRIVAL_OF_TICK = 0.5
"""When a command counts as carried out: in the middle of the tick it has for it."""
EVEN_MOVE_OVERSPEED = 1.02
"""How much faster than a tick needs it an even move is made: it fills the tick, so that an
axis that follows a slow change goes on instead of jumping from tick to tick."""
SLOWEST_mm_s = 0.01
FASTEST_N_s = 200.0
"""How fast the servo may change the force: many times what a slide needs, and no knock."""
LATENESS_FADES = 0.8
"""From step to step: how late targets usually are is their latest mean."""
OLDEST_s = 0.2
"""Beyond, a force is too old to be put to a place."""
GRID_s = 0.00025
"""Of the account of where the axis is: fine against its shortest move."""


@dataclass(frozen=True)
class ServoSettings:
    """What a servo is made of; `settings_from` fills in what follows from the rest."""

    target_N: float
    stiffness_N_mm: float
    """dF/dz near the target, positive: z counts into the skin."""
    tick_s: float
    """Between two steps."""
    delay_s: float
    """From a command to the first force that shows it, as `step` is given it: link, axis, frame,
    half the stretch over which force is averaged, and the age of the newest frame."""
    acceleration_mm_s2: float
    """Of the axis."""
    memory_s: float
    """Of the filter that follows the disturbance."""
    speed_mm_s: float
    """Largest of any move."""
    evenly: bool = False
    """Whether a move fills its tick instead of being over at once."""


def settings_from(
    target_N: float,
    stiffness_N_mm: float,
    tick_s: float,
    delay_s: float,
    acceleration_mm_s2: float = 200.0,
    evenly: bool = False,
) -> ServoSettings:
    """A servo for this contact at this tick and delay; ValueError where one is not positive.

    Where the force changes slowly, moves may be made `evenly`: the strips then feel no jump from
    tick to tick, and a fast change is followed less well.
    """
    for name, value in (
        ("target_N", target_N),
        ("stiffness_N_mm", stiffness_N_mm),
        ("tick_s", tick_s),
        ("delay_s", delay_s),
        ("acceleration_mm_s2", acceleration_mm_s2),
    ):
        if not (value > 0 and math.isfinite(value)):
            raise ValueError(f"{name} {value:g} must be a number above 0")
    return ServoSettings(
        target_N,
        stiffness_N_mm,
        tick_s,
        delay_s,
        acceleration_mm_s2,
        memory_s=MEMORY * (delay_s + ARRIVAL_OF_TICK * tick_s),
        speed_mm_s=FASTEST_N_s / stiffness_N_mm,
        evenly=evenly,
    )


@dataclass(frozen=True)
class ServoStep:
    """What the axis is to do in the tick that begins."""

    increment_mm: float
    """Into the skin, from where the axis was last told to go."""
    speed_mm_s: float
    """At most."""


class ContactShift:
    """How far the axis would have had to move during a slide for the force to stay on target."""

    def __init__(self) -> None:
        self._times: list[float] = []
        self._shifts: list[float] = []

    def add(self, since_s: float, shift_mm: float) -> None:
        """What was seen `since_s` after the slide's beginning; times ascend."""
        self._times.append(since_s)
        self._shifts.append(shift_mm)

    def at_mm(self, since_s: float) -> float:
        """At any time, 0 before the first."""
        after = bisect_right(self._times, since_s)
        if after == 0:
            return 0.0
        first = self._shifts[0]
        if after == len(self._times):
            return self._shifts[-1] - first
        (t0, t1), (s0, s1) = self._times[after - 1 : after + 1], self._shifts[after - 1 : after + 1]
        return s0 + (s1 - s0) * (since_s - t0) / (t1 - t0) - first


class ForceServo:
    """Holds a force; one `step` a tick, begun where the axis stands at rest near the target."""

    def __init__(self, settings: ServoSettings):
        self.settings = settings
        self._axis = _AxisAccount(settings)
        self._level_N: float | None = None
        self._slope_N_s = 0.0
        self._older_s = 0.0
        """Of the force at the step before."""
        self._usually_late_s = 0.0
        self._since_s: float | None = -math.inf
        """Since the slide under way has begun; None where it begins with the next step."""
        self._expected = ContactShift()
        self.shift = ContactShift()
        """What the slide under way has shown so far."""

    def slide_begins(self, expected: ContactShift | None = None) -> None:
        """The next step is the first of a slide; `expected` is the `shift` of one like it, on the
        same tick and delay, from the same force."""
        self._since_s = None
        self._expected, self.shift = expected or ContactShift(), ContactShift()

    @property
    def commanded_mm(self) -> float:
        """Sum of the increments so far."""
        return self._axis.target_mm

    def step(
        self, force_N: float, ticks: int = 1, late_s: float = 0.0, older_s: float = 0.0
    ) -> ServoStep:
        """What to do, given the mean force of the latest milliseconds, so many ticks after the step
        before: more than one where some were left out.

        `late_s`: by how much later than `delay_s` takes for granted the target of the step before
        has come to the axis; `older_s`: by how much older than that the force is.
        """
        own, axis = self.settings, self._axis
        older_s = min(max(older_s, 0.0), OLDEST_s)
        since_s = 0.0 if self._since_s is None else self._since_s + ticks * own.tick_s
        seen_mm = axis.seen_mm(ticks, max(late_s, 0.0), older_s)
        seen_s, passed_s = since_s - own.delay_s - older_s, ticks * own.tick_s
        passed_s -= older_s - self._older_s
        self._older_s = older_s
        self._usually_late_s *= LATENESS_FADES
        self._usually_late_s += (1 - LATENESS_FADES) * max(late_s, 0.0)
        if seen_s >= 0 and passed_s > 0:
            missing_N = own.target_N - force_N
            self.shift.add(seen_s, seen_mm + missing_N / own.stiffness_N_mm)
        disturbance_N = force_N - own.stiffness_N_mm * (seen_mm - self._expected.at_mm(seen_s))
        if self._level_N is None:
            self._level_N = disturbance_N
        elif passed_s > 0:  # else nothing new has been heard
            self._follow(self._level_N, disturbance_N, passed_s)
        ahead_s = ARRIVAL_OF_TICK * own.tick_s + self._usually_late_s
        until_s = own.delay_s + older_s + ahead_s
        expected_N = self._level_N + self._slope_N_s * until_s
        wanted_mm = (own.target_N - expected_N) / own.stiffness_N_mm
        wanted_mm += self._expected.at_mm(since_s + ahead_s)
        self._since_s = since_s
        reach_mm = own.speed_mm_s * own.tick_s
        increment = wanted_mm - axis.target_mm
        increment = max(-reach_mm, min(increment, reach_mm))
        speed_mm_s = own.speed_mm_s
        if own.evenly:
            speed_mm_s = min(
                max(EVEN_MOVE_OVERSPEED * abs(increment) / own.tick_s, SLOWEST_mm_s), speed_mm_s
            )
        axis.command(increment, speed_mm_s)
        return ServoStep(increment, speed_mm_s)

    def correct(self, difference_mm: float) -> None:
        """The axis was told to go `difference_mm` further than the latest step said: its counts are
        coarser, or a limit stood in the way."""
        self._axis.correct(difference_mm)

    def _follow(self, level_N: float, disturbance_N: float, passed_s: float) -> None:
        fading = math.exp(-passed_s / self.settings.memory_s)
        expected = level_N + self._slope_N_s * passed_s
        surprise = disturbance_N - expected
        self._level_N = expected + (1 - fading**2) * surprise
        self._slope_N_s += (1 - fading) ** 2 * surprise / passed_s


class _AxisAccount:
    """Where the axis is, from what it was told: trapezoids of speed, late by the delay."""

    def __init__(self, settings: ServoSettings):
        self._settings = settings
        self._position = self._velocity = self.target_mm = 0.0
        self._cycles = max(1, round(settings.tick_s / GRID_s))
        self._dt = settings.tick_s / self._cycles
        self._delay = max(1, round(settings.delay_s / self._dt))
        """In cycles."""
        past = self._delay + round(OLDEST_s / self._dt)
        self._past: deque[float] = deque([0.0] * (past + 1), maxlen=past + 1)
        self._commanded = False
        self._speed = settings.speed_mm_s
        self._before = 0.0, self._speed
        """Target and speed that the latest replaced."""

    def seen_mm(self, ticks: int, late_s: float, older_s: float) -> float:
        """The position that the force given to the present step, so many ticks after the one
        before, belongs to; the latest target was late, the force is older than it should be."""
        if self._commanded:
            late = round(late_s / self._dt)
            for cycle in range(ticks * self._cycles):
                self._cycle(*(self._before if cycle < late else (self.target_mm, self._speed)))
        return self._past[-1 - self._delay - round(older_s / self._dt)]

    def command(self, increment_mm: float, speed_mm_s: float) -> None:
        """A new target, from now on, and how fast to go there."""
        self._before = self.target_mm, self._speed
        self.target_mm += increment_mm
        self._speed = speed_mm_s
        self._commanded = True

    def correct(self, difference_mm: float) -> None:
        """It is another one."""
        self.target_mm += difference_mm

    def _cycle(self, target_mm: float, speed_mm_s: float) -> None:
        dt, acceleration = self._dt, self._settings.acceleration_mm_s2
        rest = target_mm - self._position
        change = acceleration * dt
        allowed = change * (math.sqrt(0.25 + 2 * abs(rest) / (change * dt)) - 0.5)
        wanted = math.copysign(min(allowed, speed_mm_s, abs(rest) / dt), rest)
        before = self._velocity
        self._velocity += max(-change, min(wanted - before, change))
        self._position += (self._velocity + before) / 2 * dt
        self._past.append(self._position)
