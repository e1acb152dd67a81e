"""Profiles of the rotary stage in a roll trial: from upright to an angle and back, or any curve.

A profile gives the angle at any time, for the x stage that follows it, and the turns that make the
stage follow it. The stage makes a trapezoid of speed itself, which takes two turns; a curve given
as data is streamed to it as set points. Angles in deg from upright, times in s from the profile's
begin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

STREAM_AHEAD_S = 0.006
"""Time in s by which a set point is sent ahead: the stage's delay in following (assumed)."""


@dataclass(frozen=True)
class Turn:
    """One command to the stage, and its time."""

    at_s: float
    to_deg: float
    speed_deg_s: float
    acceleration_deg_s2: float


class Profile(Protocol):
    """The interface of a profile: an angle over time."""

    @property
    def duration_s(self) -> float:
        """Time from its beginning to its end in s."""
        ...

    @property
    def there_s(self) -> float:
        """Time in s that counts as the way there: to the middle of the stay at the largest
        angle."""
        ...

    @property
    def fastest_deg_s(self) -> float:
        """Largest speed that is asked for."""
        ...

    def at_deg(self, time_s: float) -> float:
        """Return the angle at a time; before the beginning and after the end, that of the
        respective end."""
        ...

    def turns(self, tick_s: float) -> tuple[Turn, ...]:
        """Return the turns that make a stage follow the profile with at most one command per
        tick."""
        ...


@dataclass(frozen=True)
class ThereAndBack:
    """A trapezoid of speed to an angle, a stay there, and the same back (paper, Figure 17)."""

    angle_deg: float
    speed_deg_s: float
    acceleration_deg_s2: float
    stay_s: float

    @property
    def way_s(self) -> float:
        """Time from one end to the other in s; over a short way the speed is a triangle."""
        way_deg, speed = abs(self.angle_deg), self.speed_deg_s
        acceleration = self.acceleration_deg_s2
        if way_deg * acceleration < speed**2:
            return 2 * math.sqrt(way_deg / acceleration)
        return way_deg / speed + speed / acceleration

    @property
    def duration_s(self) -> float:
        """See `Profile`."""
        return 2 * self.way_s + self.stay_s

    @property
    def there_s(self) -> float:
        """See `Profile`."""
        return self.duration_s / 2

    @property
    def fastest_deg_s(self) -> float:
        """See `Profile`; over a short way it is not reached."""
        return self.speed_deg_s

    def at_deg(self, time_s: float) -> float:
        """See `Profile`."""
        back_s = self.way_s + self.stay_s
        gone_deg = self._gone_deg(time_s) - self._gone_deg(time_s - back_s)
        return math.copysign(gone_deg, self.angle_deg)

    def turns(self, tick_s: float) -> tuple[Turn, ...]:
        """See `Profile`."""
        how = (self.speed_deg_s, self.acceleration_deg_s2)
        return (Turn(0.0, self.angle_deg, *how), Turn(self.way_s + self.stay_s, 0.0, *how))

    def _gone_deg(self, time_s: float) -> float:
        """Return the angle covered at a time after the beginning of a way."""
        time_s = min(max(time_s, 0.0), self.way_s)
        acceleration = self.acceleration_deg_s2
        ramp_s = min(self.speed_deg_s / acceleration, self.way_s / 2)
        speed = acceleration * ramp_s
        left_s = self.way_s - time_s
        if time_s < ramp_s:
            return acceleration * time_s**2 / 2
        if left_s < ramp_s:
            return abs(self.angle_deg) - acceleration * left_s**2 / 2
        return speed * (time_s - ramp_s / 2)


@dataclass(frozen=True)
class Curve:
    """Angles at given times, with linear interpolation."""

    times_s: tuple[float, ...]
    angles_deg: tuple[float, ...]
    acceleration_deg_s2: float
    """Acceleration that the stage may use to follow."""

    @property
    def duration_s(self) -> float:
        """See `Profile`."""
        return self.times_s[-1]

    @property
    def there_s(self) -> float:
        """See `Profile`; of several largest angles, the first."""
        angles = self.angles_deg
        first = last = max(range(len(angles)), key=lambda corner: abs(angles[corner]))
        while last + 1 < len(angles) and angles[last + 1] == angles[first]:
            last += 1
        return (self.times_s[first] + self.times_s[last]) / 2

    @property
    def fastest_deg_s(self) -> float:
        """See `Profile`."""
        points = pairwise(zip(self.times_s, self.angles_deg, strict=True))
        return max(abs(to - at) / (end_s - begin_s) for (begin_s, at), (end_s, to) in points)

    def at_deg(self, time_s: float) -> float:
        """See `Profile`."""
        points = zip(self.times_s, self.angles_deg, strict=True)
        for (begin_s, begin_deg), (end_s, end_deg) in pairwise(points):
            if time_s < end_s:
                share = max(time_s - begin_s, 0.0) / (end_s - begin_s)
                return begin_deg + share * (end_deg - begin_deg)
        return self.angles_deg[-1]

    def turns(self, tick_s: float) -> tuple[Turn, ...]:
        """See `Profile`."""
        turns, here_deg = [], self.at_deg(0.0)
        for number in range(math.ceil(self.duration_s / tick_s)):
            at_s = number * tick_s
            to_deg = self.at_deg(at_s + tick_s + STREAM_AHEAD_S)
            if to_deg != here_deg:
                speed_deg_s = abs(to_deg - here_deg) / tick_s
                turns.append(Turn(at_s, to_deg, speed_deg_s, self.acceleration_deg_s2))
            here_deg = to_deg
        return tuple(turns)
