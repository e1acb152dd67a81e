"""How the rotary stage turns in a roll trial: from upright to an angle and back, or any curve.

A profile gives the angle at any time, for what has to follow it, and the turns that make the stage
go along it. A trapezoid of speed is the stage's own and takes two turns; a curve given as data is
streamed to it as set points. Angles in deg from upright, times in s from the profile's begin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

STREAM_AHEAD_S = 0.006
"""How far before its time a set point is aimed at: what the stage follows behind (assumed)."""


@dataclass(frozen=True)
class Turn:
    """What the stage is told, and when."""

    at_s: float
    to_deg: float
    speed_deg_s: float
    acceleration_deg_s2: float


class Profile(Protocol):
    """An angle over time."""

    @property
    def duration_s(self) -> float:
        """From its begin to its end."""
        ...

    def at_deg(self, time_s: float) -> float:
        """Where the stage is to be; before the begin and after the end where it is to be there."""
        ...

    def turns(self, tick_s: float) -> tuple[Turn, ...]:
        """What makes a stage that is told something once a tick go along it."""
        ...


@dataclass(frozen=True)
class ThereAndBack:
    """A trapezoid of speed to an angle, a stay, and the same back (paper, Figure 17)."""

    angle_deg: float
    speed_deg_s: float
    acceleration_deg_s2: float
    stay_s: float

    @property
    def way_s(self) -> float:
        """From one end to the other: a short way is a triangle of speed."""
        way_deg, speed = abs(self.angle_deg), self.speed_deg_s
        acceleration = self.acceleration_deg_s2
        if way_deg * acceleration < speed**2:
            return 2 * math.sqrt(way_deg / acceleration)
        return way_deg / speed + speed / acceleration

    @property
    def duration_s(self) -> float:
        """See `Profile`."""
        return 2 * self.way_s + self.stay_s

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
        """How far along the way, some time after its begin."""
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
    """Angles at given times, straight between them."""

    times_s: tuple[float, ...]
    angles_deg: tuple[float, ...]
    acceleration_deg_s2: float
    """That the stage may use to follow."""

    @property
    def duration_s(self) -> float:
        """See `Profile`."""
        return self.times_s[-1]

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
        told, here_deg = [], self.at_deg(0.0)
        for number in range(math.ceil(self.duration_s / tick_s)):
            at_s = number * tick_s
            to_deg = self.at_deg(at_s + tick_s + STREAM_AHEAD_S)
            if to_deg != here_deg:
                speed_deg_s = abs(to_deg - here_deg) / tick_s
                told.append(Turn(at_s, to_deg, speed_deg_s, self.acceleration_deg_s2))
            here_deg = to_deg
        return tuple(told)
