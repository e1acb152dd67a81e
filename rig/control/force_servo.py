"""Holds the normal force constant with a z axis that accepts positions. Numbers only.

The axis is stiff and the skin is soft, so a position determines a force:

    F = k z + d

k is the stiffness of the contact near the target. d, the disturbance, is everything else: creep
and, above all, the change of the normal force caused by the shear of a slide. What is known of d is
always old: a command shows in the force only `delay_s` after it was given. The servo therefore

- computes where the axis is from the commands it was given (trapezoids of speed, as a drive makes
  them),
- estimates d and its slope with a fading-memory filter (alpha-beta, critically damped), and
- commands, at every tick, the position that makes the force right at the moment when that position
  will have been reached.

A constant d, or one that changes at a constant rate, leaves no mean error: the record of positions
is the integrator.

`memory_s` sets how fast the servo follows. It is derived from delay and tick such that the true k
may be 1.3 times or half the assumed one: the stiffness of the skin rises with the force and changes
when ridges slip. `rig.control.approach` runs before the servo and measures k. Decision 0035 has the
measured accuracy.

Delays vary: a busy link may carry a target late, and a force may arrive late. `ForceServo.step`
takes both delays and relates each force to the position at which it was felt.

A repeated slide disturbs the force in the same way each time. The `ContactShift` that one slide has
shown may be passed to the servo for the following ones, which then only have to follow the
difference. Do not pass on the shift of a slide that was itself helped: it is no better, because
noise adds up from one slide to the next.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import deque
from dataclasses import dataclass, replace

MEMORY = 1.3
"""Memory of the disturbance filter, in units of the time from a command to the middle of its
effect. With a shorter memory the loop rings where k is 1.3 times the assumed one, and the finite
resolution of the axis keeps it moving to and fro."""
ARRIVAL_OF_TICK = 0.5
"""Share of a tick after which a command is taken as carried out: the middle of its tick."""
EVEN_MOVE_OVERSPEED = 1.02
"""Speed of an even move, relative to the speed that would just fill the tick. Slightly above 1, so
that an axis that follows a slow change keeps moving instead of jumping from tick to tick."""
SLOWEST_mm_s = 0.01
"""Lowest speed that is commanded for an even move, in mm/s."""
FASTEST_N_s = 200.0
"""Largest rate at which the servo changes the force, in N/s: many times what a slide needs, and
still no knock."""
REPEATS_WITHIN_s = 0.01
"""Time on either side within which the shift of an earlier slide is averaged, in s, with a weight
that falls to zero. Faster changes do not repeat: they are the noise of that slide and the axis's
steps of a micrometre, which at 200 Hz alternate from tick to tick. Replayed, they were 6 % of the
force where 2 % had been. At 100 Hz, where fast slides need every value, nothing is averaged."""
LATENESS_FADES = 0.8
"""Weight of the old value in the running mean of how late targets reach the axis."""
OLDEST_s = 0.2
"""Largest extra age of a force that is taken into account, in s. An older force is treated as this
old."""
GRID_s = 0.00025
"""Time step of the computed axis position, in s: fine compared with the shortest move of the
axis."""


@dataclass(frozen=True)
class ServoSettings:
    """Parameters of a servo. `settings_from` derives those that follow from the others."""

    target_N: float
    """Set point of the normal force, in N."""
    stiffness_N_mm: float
    """Stiffness dF/dz of the contact near the target, in N/mm. Positive: z increases into the
    skin."""
    tick_s: float
    """Time between two steps, in s."""
    delay_s: float
    """Time from a command to the first force that shows it, as `step` receives it, in s: link,
    axis, force frame, half the interval over which the force is averaged, and the age of the newest
    frame."""
    acceleration_mm_s2: float
    """Acceleration of the axis, in mm/s²."""
    memory_s: float
    """Time constant of the filter that follows the disturbance, in s."""
    speed_mm_s: float
    """Largest speed of any move, in mm/s."""
    evenly: bool = False
    """True if a move fills its tick instead of finishing as fast as it can."""


def settings_from(
    target_N: float,
    stiffness_N_mm: float,
    tick_s: float,
    delay_s: float,
    acceleration_mm_s2: float = 200.0,
    evenly: bool = False,
    largest_speed_mm_s: float = math.inf,
) -> ServoSettings:
    """Return the settings of a servo for this contact, tick and delay.

    With `evenly`, moves are spread over the whole tick: the strips then feel no jump from tick to
    tick, but a fast change of the force is followed less well. Use it where the force changes
    slowly. No move is faster than `largest_speed_mm_s`.

    Raises ValueError if a number is not finite or not positive.

    >>> settings = settings_from(target_N=4.0, stiffness_N_mm=150.0, tick_s=0.01, delay_s=0.0045)
    >>> round(settings.memory_s, 5)  # 1.3 * (4.5 ms + half a tick)
    0.01235
    >>> round(settings.speed_mm_s, 2)  # 200 N/s on 150 N/mm
    1.33
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
        speed_mm_s=min(FASTEST_N_s / stiffness_N_mm, largest_speed_mm_s),
        evenly=evenly,
    )


@dataclass(frozen=True)
class ServoStep:
    """The move of z that the servo commands in a tick."""

    increment_mm: float
    """Distance into the skin from the previously commanded position, in mm."""
    speed_mm_s: float
    """Largest speed of the move, in mm/s."""


class ContactShift:
    """Displacement of the axis that would have kept the force at its set point during a slide, over
    time."""

    def __init__(self) -> None:
        self._times: list[float] = []
        self._shifts: list[float] = []

    def add(self, since_s: float, shift_mm: float) -> None:
        """Add the shift found `since_s` after the start of the slide. Times must ascend."""
        self._times.append(since_s)
        self._shifts.append(shift_mm)

    def smoothed(self, within_s: float) -> ContactShift:
        """Return the shift with each value replaced by the mean of those less than `within_s` away
        from it, weighted by how near they are. So is the first value, to which all others refer.

        >>> shift = ContactShift()
        >>> for tick in range(9):
        ...     shift.add(0.005 * tick, 0.002 if tick % 2 else 0.001)
        >>> round(shift.at_mm(0.005), 4), round(shift.smoothed(0.01).at_mm(0.02), 4)
        (0.001, 0.0002)
        """
        found, times = ContactShift(), self._times
        for time_s in times:
            first, last = (
                bisect_right(times, time_s - within_s),
                bisect_left(times, time_s + within_s),
            )
            near = range(first, last)
            weights = [1 - abs(times[k] - time_s) / within_s for k in near]
            total = sum(w * self._shifts[k] for w, k in zip(weights, near, strict=True))
            found.add(time_s, total / sum(weights))
        return found

    def at_mm(self, since_s: float) -> float:
        """Return the shift in mm at a time after the start of the slide, relative to the first
        one.

        Values between the added ones are interpolated. The shift is 0 before the first one and
        constant after the last.

        >>> shift = ContactShift()
        >>> shift.add(0.0, 0.010)
        >>> shift.add(0.1, 0.014)
        >>> round(shift.at_mm(0.05), 4)
        0.002
        """
        after = bisect_right(self._times, since_s)
        if after == 0:
            return 0.0
        first = self._shifts[0]
        if after == len(self._times):
            return self._shifts[-1] - first
        (t0, t1), (s0, s1) = self._times[after - 1 : after + 1], self._shifts[after - 1 : after + 1]
        return s0 + (s1 - s0) * (since_s - t0) / (t1 - t0) - first


class ForceServo:
    """Holds a force with one `step` per tick. Create it while the axis stands still near the
    target.

    >>> servo = ForceServo(settings_from(4.0, stiffness_N_mm=100.0, tick_s=0.01, delay_s=0.005))
    >>> round(servo.step(force_N=3.9).increment_mm * 1000, 1)  # 0.1 N missing: 1 µm deeper
    1.0
    """

    def __init__(self, settings: ServoSettings):
        self.settings = settings
        self._axis = _AxisAccount(settings)
        self._level_N: float | None = None
        self._slope_N_s = 0.0
        self._older_s = 0.0
        """Extra age of the force at the previous step."""
        self._usually_late_s = 0.0
        self._since_s: float | None = -math.inf
        """Time since the current slide began; None if it begins with the next step."""
        self._expected = ContactShift()
        self.shift = ContactShift()
        """The shift found so far in the current slide."""

    def slide_begins(self, expected: ContactShift | None = None) -> None:
        """Declare that the next step is the first of a slide.

        `expected` is the `shift` of an earlier slide with the same tick, delay and starting force.
        """
        self._since_s = None
        self._expected = (expected or ContactShift()).smoothed(REPEATS_WITHIN_s)
        self.shift = ContactShift()

    def hold_at(self, target_N: float, largest_speed_mm_s: float = math.inf) -> None:
        """Change the set point, from the next step on, and the speed in mm/s that no move exceeds
        there. The stiffness is taken to stay what it is.

        Raises ValueError for a force or a speed that is not above 0, and for a force that is not
        finite.
        """
        if not (target_N > 0 and math.isfinite(target_N)):
            raise ValueError(f"target_N {target_N:g} must be a number above 0")
        if not largest_speed_mm_s > 0:
            raise ValueError(f"largest_speed_mm_s {largest_speed_mm_s:g} must be above 0")
        speed_mm_s = min(FASTEST_N_s / self.settings.stiffness_N_mm, largest_speed_mm_s)
        self.settings = replace(self.settings, target_N=target_N, speed_mm_s=speed_mm_s)

    def lead(self, rise_N: float, after_s: float) -> ServoStep:
        """Return a move to command at once, between two steps, after the set point was raised by
        `rise_N` (`hold_at`); the next step continues from it.

        `after_s` is the time since the latest step. The move is at most what a step may command.

        >>> servo = ForceServo(settings_from(4.0, stiffness_N_mm=100.0, tick_s=0.01, delay_s=0.005))
        >>> _ = servo.step(force_N=4.0)
        >>> servo.hold_at(4.8)
        >>> round(servo.lead(0.8, after_s=0.004).increment_mm * 1000, 1)  # 0.8 N on 100 N/mm
        8.0
        """
        own = self.settings
        reach_mm = own.speed_mm_s * own.tick_s
        increment_mm = max(-reach_mm, min(rise_N / own.stiffness_N_mm, reach_mm))
        self._axis.command_between(increment_mm, own.speed_mm_s, after_s)
        return ServoStep(increment_mm, own.speed_mm_s)

    @property
    def commanded_mm(self) -> float:
        """Sum of all commanded increments, in mm."""
        return self._axis.target_mm

    def step(
        self, force_N: float, ticks: int = 1, late_s: float = 0.0, older_s: float = 0.0
    ) -> ServoStep:
        """Return the move to command, given the mean force of the last few milliseconds.

        `ticks` is the number of ticks since the previous step: more than one if some were missed.
        `late_s` is how much later than `delay_s` assumes the previous target reached the axis, and
        `older_s` how much older than that the force is.
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
        # Without newer force data there is nothing to learn, and the slope would be divided by 0.
        elif passed_s > 0:
            self._follow(self._level_N, disturbance_N, passed_s)
        ahead_s = ARRIVAL_OF_TICK * own.tick_s + self._usually_late_s
        until_s = own.delay_s + older_s + ahead_s
        expected_N = self._level_N + self._slope_N_s * until_s
        wanted_mm = (own.target_N - expected_N) / own.stiffness_N_mm
        wanted_mm += self._expected.at_mm(since_s + ahead_s)
        self._since_s = since_s
        # At most as far as the axis moves in one tick, which also bounds the change of the force.
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

    def _follow(self, level_N: float, disturbance_N: float, passed_s: float) -> None:
        fading = math.exp(-passed_s / self.settings.memory_s)
        expected = level_N + self._slope_N_s * passed_s
        surprise = disturbance_N - expected
        self._level_N = expected + (1 - fading**2) * surprise
        self._slope_N_s += (1 - fading) ** 2 * surprise / passed_s


class _AxisAccount:
    """Computes where the axis is from its commands: trapezoids of speed, seen after the delay."""

    def __init__(self, settings: ServoSettings):
        self._settings = settings
        self._position = self._velocity = self.target_mm = 0.0
        self._cycles = max(1, round(settings.tick_s / GRID_s))
        self._dt = settings.tick_s / self._cycles
        self._delay = max(1, round(settings.delay_s / self._dt))
        """Delay in cycles."""
        past = self._delay + round(OLDEST_s / self._dt)
        self._past: deque[float] = deque([0.0] * (past + 1), maxlen=past + 1)
        self._commanded = False
        self._speed = settings.speed_mm_s
        self._orders: list[tuple[float, float, float]] = []
        """Commands since the latest step, oldest first: when after it, in s, target and speed. The
        first is the one that was valid before."""

    def seen_mm(self, ticks: int, late_s: float, older_s: float) -> float:
        """Advance by `ticks` and return the position at which the present force was felt.

        The latest target arrived `late_s` too late; the force is `older_s` older than usual.
        """
        if self._commanded:
            # Until a late target arrived the axis followed the previous one.
            begins = [0, *(round((at_s + late_s) / self._dt) for at_s, _, _ in self._orders[1:])]
            for cycle in range(ticks * self._cycles):
                latest = max(n for n, begin in enumerate(begins) if begin <= cycle)
                self._cycle(*self._orders[latest][1:])
        return self._past[-1 - self._delay - round(older_s / self._dt)]

    def command(self, increment_mm: float, speed_mm_s: float) -> None:
        """Set a new target, from now on, and the speed to approach it."""
        self._orders = [(0.0, self.target_mm, self._speed)]
        self.command_between(increment_mm, speed_mm_s, 0.0)
        self._commanded = True

    def command_between(self, increment_mm: float, speed_mm_s: float, after_s: float) -> None:
        """Set a new target `after_s` after the latest `command`."""
        self.target_mm += increment_mm
        self._speed = speed_mm_s
        self._orders.append((after_s, self.target_mm, speed_mm_s))

    def _cycle(self, target_mm: float, speed_mm_s: float) -> None:
        dt, acceleration = self._dt, self._settings.acceleration_mm_s2
        rest = target_mm - self._position
        change = acceleration * dt
        # Speed from which the axis can still stop on the target, in discrete steps of dt.
        allowed = change * (math.sqrt(0.25 + 2 * abs(rest) / (change * dt)) - 0.5)
        wanted = math.copysign(min(allowed, speed_mm_s, abs(rest) / dt), rest)
        before = self._velocity
        self._velocity += max(-change, min(wanted - before, change))
        self._position += (self._velocity + before) / 2 * dt
        self._past.append(self._position)
