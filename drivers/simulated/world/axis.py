"""The motion of one simulated axis: what its setpoint and its carriage do, at any past instant.

Pure mechanics without I/O, protocol or clock: every call says what time it is. Motion is a history
of stretches of constant acceleration, so position and velocity are exact wherever they are asked
for, and a force sensor may sample the past. Distances in mm, speeds in mm/s, World time in integer
microseconds.

The setpoint follows trapezoidal profiles. The carriage follows the setpoint unless an external
force larger than the drive's force limit holds it back: then it stands where it is, and the
following error grows until its window is left. That, and the limit switches, are checked once a
millisecond of World time while the axis moves, as a drive's own cycle does.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import numpy as np
import numpy.typing as npt

CYCLE_us = 1000
FASTEST_OTHER_mm_s = 20.0
"""Largest speed at which the object may move that an axis pushes against, if its speed is not
known."""
COMMANDS_KEPT = 64
"""More than come within `LONGEST_LIGHT_s` from the fastest loop, 500 a second."""
LONGEST_LIGHT_s = 0.1
"""Longest time in s for which a light load is not computed again."""
LEAST_SPEED_mm_s = 2.0
"""A load that is left alone may rise as if it were moved so fast: rubber recovers (assumed)."""
HISTORY_KEPT = 20_000
"""Number of recorded motions: minutes of servo motion at 100 retargets per second."""

Load = Callable[[float, int], float]
"""Force in N along the axis's positive direction on a carriage at (position in mm, World us)."""


@dataclass(frozen=True)
class Mechanics:
    """Mechanical properties of the axis."""

    start_mm: float = 10.0
    """Position of the carriage when the World begins."""
    low_switch_mm: float = -5.0
    """Position of the negative hardware limit switch."""
    high_switch_mm: float = 105.0
    quick_deceleration_mm_s2: float = 5000.0
    """Deceleration of the drive when a limit switch or a fault makes it stop."""
    following_window_mm: float = 0.5
    """Largest lag of the carriage behind the setpoint."""
    fixed_stop_window_mm: float = 0.05
    """The same while the drive travels to a fixed stop: there it means that the stop is found."""
    peak_force_N: float = 200.0
    """Largest force of the drive when nothing else limits it."""
    friction_N: float = 2.0
    """Friction of guide and screw in motion, as the motor's torque shows it (assumed)."""


class AxisEvent(Enum):
    """Events that end the motion of an axis without a command."""

    FOLLOWING_ERROR = "following error"
    FIXED_STOP = "fixed stop"
    LOW_SWITCH = "negative limit switch"
    HIGH_SWITCH = "positive limit switch"


@dataclass(frozen=True)
class Happening:
    """An event of an axis, with its World time and the position at which it happened."""

    event: AxisEvent
    t_us: int
    position_mm: float


@dataclass(frozen=True)
class Phase:
    """A stretch of constant acceleration, of finite or endless (``inf``) length."""

    duration_s: float
    acceleration_mm_s2: float


@dataclass(frozen=True)
class Stretch:
    """A phase placed in the World: its state at `start_s`."""

    start_s: float
    position_mm: float
    velocity_mm_s: float
    acceleration_mm_s2: float

    def at(self, t_s: float) -> tuple[float, float]:
        """Return the position in mm and the velocity in mm/s at a time in s."""
        dt = t_s - self.start_s
        velocity = self.velocity_mm_s + self.acceleration_mm_s2 * dt
        return self.position_mm + (self.velocity_mm_s + velocity) / 2 * dt, velocity

    def positions(self, times_s: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return the positions in mm at several times in s, in the same shape: to the bit those of
        `at`, except that a time before `start_s` has the position of the start."""
        if self.velocity_mm_s == 0 and self.acceleration_mm_s2 == 0:
            return np.full(times_s.shape, self.position_mm)
        dt = np.maximum(times_s, self.start_s) - self.start_s
        if self.acceleration_mm_s2 == 0:
            return self.position_mm + self.velocity_mm_s * dt
        velocity = self.velocity_mm_s + self.acceleration_mm_s2 * dt
        return self.position_mm + (self.velocity_mm_s + velocity) / 2 * dt

    def highest_mm(self, begin_s: float, end_s: float) -> float:
        """Return the largest position between two times, the first not before `start_s`."""
        highest = max(self.at(begin_s)[0], self.at(end_s)[0])
        if self.acceleration_mm_s2 < 0:
            turns_s = self.start_s - self.velocity_mm_s / self.acceleration_mm_s2
            if begin_s < turns_s < end_s:
                highest = max(highest, self.at(turns_s)[0])
        return highest


def stopping_distance(velocity_mm_s: float, deceleration_mm_s2: float) -> float:
    """Return the distance in mm of a controlled stop, v |v| / 2a; it has the sign of the
    velocity."""
    return velocity_mm_s * abs(velocity_mm_s) / (2 * deceleration_mm_s2)


def stop_profile(velocity_mm_s: float, deceleration_mm_s2: float) -> list[Phase]:
    """Return a controlled stop."""
    if velocity_mm_s == 0:
        return []
    braking = -math.copysign(deceleration_mm_s2, velocity_mm_s)
    return [Phase(abs(velocity_mm_s) / deceleration_mm_s2, braking)]


def move_profile(
    distance_mm: float, velocity_mm_s: float, speed: float, acceleration: float, deceleration: float
) -> list[Phase]:
    """Return the motion from a velocity to rest `distance_mm` further on, in the least time that
    the limits allow.

    A motion that cannot stop in time, or goes the other way, stops first and comes back.
    """
    overshoot = stopping_distance(velocity_mm_s, deceleration)
    away = velocity_mm_s * distance_mm < 0 or (distance_mm == 0 and velocity_mm_s != 0)
    if away or abs(overshoot) > abs(distance_mm) * (1 + 1e-12) + 1e-12:
        first = stop_profile(velocity_mm_s, deceleration)
        return first + move_profile(distance_mm - overshoot, 0.0, speed, acceleration, deceleration)
    if distance_mm == 0:
        return []
    sign = math.copysign(1.0, distance_mm)
    length, begin = abs(distance_mm), abs(velocity_mm_s)
    peak_squared = (length + begin**2 / (2 * acceleration)) / (
        1 / (2 * acceleration) + 1 / (2 * deceleration)
    )
    peak = min(max(math.sqrt(peak_squared), begin), max(speed, 0.0)) if begin <= speed else speed
    rate = acceleration if peak >= begin else -deceleration
    changing = (peak**2 - begin**2) / (2 * rate)
    cruising = max(0.0, length - changing - peak**2 / (2 * deceleration))
    phases = [
        Phase((peak - begin) / rate, sign * rate),
        Phase(cruising / peak if peak else 0.0, 0.0),
        Phase(peak / deceleration, -sign * deceleration),
    ]
    return [phase for phase in phases if phase.duration_s > 0]


class MotionPath:
    """A history of stretches that ends at rest."""

    def __init__(self, start_mm: float):
        self._stretches = [Stretch(0.0, start_mm, 0.0, 0.0)]
        self._starts = [0.0]

    @property
    def rests_from_s(self) -> float:
        """Time at which the motion planned so far ends."""
        return self._starts[-1]

    def at(self, t_s: float) -> tuple[float, float]:
        """Return the position in mm and the velocity in mm/s at a time in s; before the recorded
        history, its first state."""
        index = max(bisect_right(self._starts, t_s) - 1, 0)
        stretch = self._stretches[index]
        return stretch.at(max(t_s, stretch.start_s))

    def positions(self, times_s: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return the positions in mm at ascending times in s, in the same shape; they are to the
        bit those of `at`."""
        if not times_s.size:
            return np.empty(0)
        first = max(bisect_right(self._starts, float(times_s[0])) - 1, 0)
        last = max(bisect_right(self._starts, float(times_s[-1])), first + 1)
        if last == first + 1:
            return self._stretches[first].positions(times_s)
        edges = np.searchsorted(times_s, self._starts[first + 1 : last], side="left")
        bounds = [0, *edges.tolist(), times_s.size]
        result = np.empty(times_s.size)
        for k, stretch in enumerate(self._stretches[first:last]):
            own = slice(bounds[k], bounds[k + 1])
            result[own] = stretch.positions(times_s[own])
        return result

    def highest_mm(self, begin_s: float, end_s: float) -> float:
        """Return the largest position between two times."""
        first = max(bisect_right(self._starts, begin_s) - 1, 0)
        last = max(bisect_right(self._starts, end_s), first + 1)
        highest = -math.inf
        for k in range(first, last):
            stretch = self._stretches[k]
            until_s = end_s if k + 1 == last else self._starts[k + 1]
            highest = max(highest, stretch.highest_mm(max(begin_s, stretch.start_s), until_s))
        return highest

    def acceleration(self, t_s: float) -> float:
        """Return the acceleration in mm/s^2."""
        return self._stretches[max(bisect_right(self._starts, t_s) - 1, 0)].acceleration_mm_s2

    def replan(
        self,
        t_s: float,
        position_mm: float,
        velocity_mm_s: float,
        phases: list[Phase],
        end_mm: float,
    ) -> None:
        """Replace the motion from `t_s` on by this one, which ends exactly at `end_mm`."""
        keep = bisect_right(self._starts, t_s)
        if keep and self._starts[keep - 1] == t_s:
            keep -= 1  # a stretch of no length says nothing
        del self._stretches[keep:], self._starts[keep:]
        for phase in phases:
            stretch = Stretch(t_s, position_mm, velocity_mm_s, phase.acceleration_mm_s2)
            self._append(stretch)
            t_s += phase.duration_s
            position_mm, velocity_mm_s = stretch.at(t_s)
        self._append(Stretch(t_s, end_mm, 0.0, 0.0))
        if len(self._starts) > 2 * HISTORY_KEPT:
            del self._stretches[:-HISTORY_KEPT], self._starts[:-HISTORY_KEPT]

    def _append(self, stretch: Stretch) -> None:
        self._stretches.append(stretch)
        self._starts.append(stretch.start_s)


@dataclass(frozen=True)
class AxisCommand:
    """The move that an axis was asked for last."""

    target_mm: float
    speed_mm_s: float
    acceleration_mm_s2: float
    deceleration_mm_s2: float

    def profile(self, position_mm: float, velocity_mm_s: float) -> list[Phase]:
        """Return the motion to a position from a state of motion."""
        return move_profile(
            self.target_mm - position_mm,
            velocity_mm_s,
            self.speed_mm_s,
            self.acceleration_mm_s2,
            self.deceleration_mm_s2,
        )


class SimulatedAxis:
    """One axis. Commands never go back in time; positions may be asked for at any past instant."""

    def __init__(self, mechanics: Mechanics, load: Load):
        self.mechanics = mechanics
        self._force_limit_N = mechanics.peak_force_N
        self.seeks_fixed_stop = False
        """True if being held back is what the motion is for."""
        self.stiffest_load_N_mm = math.inf
        """Largest stiffness of a load in its way, if it is known: then a force far below the limit
        need not be computed."""
        self.other_axis: SimulatedAxis | None = None
        """The only other axis that moves the load, where there is one."""
        self.jammed = False
        """A fault: the carriage cannot be moved by any force."""
        self.idle = False
        """A fault: moves are taken and nothing moves, not even the setpoint."""
        self._load = load
        self._setpoint = MotionPath(mechanics.start_mm)
        self._carriage = MotionPath(mechanics.start_mm)
        self._command: AxisCommand | None = None
        self._held_direction = 0.0
        """Direction in which the setpoint continued when the carriage was held back; 0 while it
        follows."""
        self._settled_us = 0
        self._settling = False
        self._asked: tuple[int, float] | None = None
        """Time of the latest computation of the load, in us, and the load, in N."""
        self._light_until_us = 0
        """Time in us until which the load cannot reach the force limit."""
        self._commanded: deque[tuple[int, float]] = deque([(0, 0.0)], maxlen=COMMANDS_KEPT)
        """Times in us of commanded speeds, and the speeds. Until the next one the setpoint is not
        faster than this speed or than it was at that time."""
        self._happenings: list[Happening] = []

    # --- what it does -------------------------------------------------------------------------

    @property
    def force_limit_N(self) -> float:  # noqa: N802 - the unit keeps its capital
        """Largest force of the drive, from now on."""
        return self._force_limit_N

    @force_limit_N.setter
    def force_limit_N(self, limit_N: float) -> None:  # noqa: N802
        self._force_limit_N, self._asked, self._light_until_us = limit_N, None, 0

    def move(self, now_us: int, command: AxisCommand) -> None:
        """Go to a position, also out of a motion under way. Raises ValueError for a speed of 0."""
        if not command.speed_mm_s > 0:
            raise ValueError(f"cannot move at {command.speed_mm_s} mm/s")
        if self.idle:
            return
        self.settle(now_us)
        position, velocity = self._setpoint.at(now_us * 1e-6)
        self._command = command
        self._commanded.append((now_us, command.speed_mm_s))
        self._become(
            now_us, position, velocity, command.profile(position, velocity), command.target_mm
        )
        self.look_ahead()
        if self.other_axis is not None:
            self.other_axis.look_ahead()

    def stop(self, now_us: int, deceleration_mm_s2: float) -> None:
        """Make a controlled stop."""
        self.settle(now_us)
        self._brake(now_us, deceleration_mm_s2)

    # --- what can be seen of it ---------------------------------------------------------------

    @property
    def command(self) -> AxisCommand | None:
        """The move that was asked for last; None once something has ended it."""
        return self._command

    @property
    def settling(self) -> bool:
        """True if its history is being brought up to date just now."""
        return self._settling

    def position(self, t_us: int) -> float:
        """Return the position of the carriage at a time, in mm."""
        self.settle(t_us)
        return self._carriage.at(t_us * 1e-6)[0]

    def positions(self, times_us: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        """Return the positions at several ascending times, (n,), in the unit of `position`."""
        if times_us.size:
            self.settle(int(times_us[-1]))
        return self._carriage.positions(np.asarray(times_us * 1e-6, np.float64))

    def highest_mm(self, begin_us: int, end_us: int) -> float:
        """Return the largest of its positions between two instants."""
        self.settle(end_us)
        return self._carriage.highest_mm(begin_us * 1e-6, end_us * 1e-6)

    def velocity(self, t_us: int) -> float:
        """Return the carriage's velocity in mm/s."""
        self.settle(t_us)
        return self._carriage.at(t_us * 1e-6)[1]

    def acceleration(self, t_us: int) -> float:
        """Return the carriage's acceleration in mm/s^2."""
        self.settle(t_us)
        return self._carriage.acceleration(t_us * 1e-6)

    def following_error(self, t_us: int) -> float:
        """Return how far the carriage lags behind the setpoint, in mm."""
        self.settle(t_us)
        return self._setpoint.at(t_us * 1e-6)[0] - self._carriage.at(t_us * 1e-6)[0]

    def drive_force_N(self, t_us: int) -> float:  # noqa: N802
        """Return the force that the motor exerts on the carriage: against its load and, in motion,
        its friction. A carriage that is held back gets all that the drive is allowed."""
        self.settle(t_us)
        if self._held_direction:
            return self._held_direction * self._force_limit_N
        position, velocity = self._carriage.at(t_us * 1e-6)
        moving = math.copysign(1.0, velocity) if velocity else 0.0
        return moving * self.mechanics.friction_N - self._load(position, t_us)

    def finished(self, t_us: int) -> bool:
        """Return whether the setpoint has come to its end."""
        self.settle(t_us)
        return t_us * 1e-6 >= self._setpoint.rests_from_s

    def happenings(self, now_us: int) -> list[Happening]:
        """Return the events of the axis since the last call, in order."""
        self.settle(now_us)
        met, self._happenings = self._happenings, []
        return met

    # --- one cycle after the other ------------------------------------------------------------

    def settle(self, t_us: int) -> None:
        """Bring the history up to `t_us`. A load that asks for a position meanwhile, because
        another axis moves the same thing, gets the history as it is."""
        if self._settling or t_us <= self._settled_us:
            return
        self._settling = True
        try:
            begin_us = max(self._settled_us, self._uneventful_until_us(t_us))
            cycle = (begin_us // CYCLE_us + 1) * CYCLE_us
            while cycle <= t_us and (cycle - CYCLE_us) * 1e-6 < self._setpoint.rests_from_s:
                self._cycle(cycle)
                cycle += CYCLE_us
            self._settled_us = t_us
        finally:
            self._settling = False

    def _uneventful_until_us(self, t_us: int) -> int:
        """Return the time, at most `t_us`, until which no cycle would find anything: the load is
        light, and both switches are out of reach."""
        until_us = min(t_us, self._light_until_us - 1)
        if until_us - self._settled_us < CYCLE_us or self._held_direction or self.jammed:
            return 0
        position = self._carriage.at(self._settled_us * 1e-6)[0]
        way_mm = self.fastest_since_mm_s(self._settled_us) * (until_us - self._settled_us) * 1e-6
        low_mm, high_mm = self.mechanics.low_switch_mm, self.mechanics.high_switch_mm
        return until_us if low_mm < position - way_mm and position + way_mm < high_mm else 0

    def _cycle(self, t_us: int) -> None:
        position, velocity = self._carriage.at(t_us * 1e-6)
        wanted, going = self._setpoint.at(t_us * 1e-6)
        if self._held_direction:
            self._stay(t_us, position, wanted, going)
        elif going and self._held_back(position, going, t_us):
            self._held_direction = math.copysign(1.0, going)
            self._carriage.replan(t_us * 1e-6, position, 0.0, [], position)
        elif self._command is None:
            return  # braking already
        elif velocity < 0 and position <= self.mechanics.low_switch_mm:
            self._meet(AxisEvent.LOW_SWITCH, t_us, position)
        elif velocity > 0 and position >= self.mechanics.high_switch_mm:
            self._meet(AxisEvent.HIGH_SWITCH, t_us, position)

    def _held_back(self, position: float, going: float, t_us: int) -> bool:
        if self.jammed:
            return True
        if t_us < self._light_until_us:
            return False
        load_N = self._load(position, t_us)
        self._asked = t_us, abs(load_N)
        self.look_ahead()
        return -load_N * math.copysign(1.0, going) > self._force_limit_N

    def look_ahead(self) -> None:
        """Find out until when the load cannot come to the force limit, as fast as it may rise by
        what has been commanded so far; whoever moves it otherwise asks for this again."""
        if self._asked is None:
            return
        t_us, load_N = self._asked
        other_mm_s = FASTEST_OTHER_mm_s
        if self.other_axis is not None:
            other_mm_s = self.other_axis.fastest_since_mm_s(t_us)
        speed_mm_s = max(self.fastest_since_mm_s(t_us) + other_mm_s, LEAST_SPEED_mm_s)
        light_s = (self._force_limit_N - load_N) / (self.stiffest_load_N_mm * speed_mm_s)
        self._light_until_us = t_us + math.floor(1e6 * min(light_s, LONGEST_LIGHT_s))

    def fastest_since_mm_s(self, t_us: int) -> float:
        """Return an upper bound of its speed from then until the next command."""
        fastest = abs(self._setpoint.at(t_us * 1e-6)[1])
        for at_us, speed_mm_s in reversed(self._commanded):
            fastest = max(fastest, speed_mm_s)
            if at_us <= t_us:
                return fastest
        return math.inf  # more commands than are recorded

    def _stay(self, t_us: int, position: float, wanted: float, going: float) -> None:
        """Hold the carriage until the setpoint has come back to it.

        A load that yields meanwhile (a skin that creeps) does not move the carriage.
        """
        ahead = (wanted - position) * self._held_direction
        seeking, mechanics = self.seeks_fixed_stop, self.mechanics
        if ahead > (mechanics.fixed_stop_window_mm if seeking else mechanics.following_window_mm):
            self._meet(
                AxisEvent.FIXED_STOP if seeking else AxisEvent.FOLLOWING_ERROR, t_us, position
            )
        elif ahead <= 0 and not self.jammed and self._command is not None:
            self._held_direction = 0.0
            phases = self._command.profile(position, going)
            self._become(t_us, position, going, phases, self._command.target_mm)
        elif -ahead > mechanics.following_window_mm:
            self._meet(AxisEvent.FOLLOWING_ERROR, t_us, position)

    def _meet(self, event: AxisEvent, t_us: int, position: float) -> None:
        self._happenings.append(Happening(event, t_us, position))
        self._brake(t_us, self.mechanics.quick_deceleration_mm_s2)

    def _brake(self, t_us: int, deceleration_mm_s2: float) -> None:
        """Brake. A carriage that is held back is at rest already: its setpoint comes back to it."""
        path = self._carriage if self._held_direction else self._setpoint
        self._held_direction = 0.0
        position, velocity = path.at(t_us * 1e-6)
        end = position + stopping_distance(velocity, deceleration_mm_s2)
        phases = stop_profile(velocity, deceleration_mm_s2)
        self._command = None
        self._become(t_us, position, velocity, phases, end)

    def _become(
        self, t_us: int, position: float, velocity: float, phases: list[Phase], end_mm: float
    ) -> None:
        self._setpoint.replan(t_us * 1e-6, position, velocity, phases, end_mm)
        if not self._held_direction:
            self._carriage.replan(t_us * 1e-6, position, velocity, phases, end_mm)
