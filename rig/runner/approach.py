"""From first touch to the target force without overshoot worth the name: the numbers only.

While the axis moves at speed v, the force a controller knows is `delay_s` old, and stopping takes
v^2 / 2a more. What is pressed meanwhile, k (v delay + v^2 / 2a), is the overshoot; k is the
contact's stiffness, which nobody knows before touching it. So the search for contact is slow enough
for the stiffest contact there may be, and from touch on the speed follows from what is missing and
from the stiffness as it proves to be:

    v = missing force / (k CLOSING delay).

That is a loop with one delay: without overshoot where the true stiffness is at most CLOSING / e of
k, and below 10 % where it is at most 0.58 CLOSING (it is unstable from 1.57 CLOSING on).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

STIFFEST_N_mm = 250.0
"""Of a contact of skin and object below 10 N; a plate on the reference skin has 206 at 12 N."""
CLOSING = 4.0
"""Delays in which the missing force falls to 1/e: room for a stiffness of 1.4 times the known one,
which the rise of a skin's stiffness with the force needs."""
TOUCH = 0.5
"""Of the target: what the search for contact may press before it has stopped."""
FELT = 0.05
"""Of the target: force that is contact."""
ARRIVED = 0.02
"""Of the target: missing force at which the servo takes over."""
LOCAL = 0.5
"""Of the present force: the stiffness is that of the forces from here on."""
AHEAD_s = 0.03
"""Of motion at the wanted speed: how far ahead of the axis its target is put, so that a speed is a
speed and a program that hangs does not press on."""
LEAST_AHEAD_mm = 0.0015
"""An axis that counts in micrometres has to move at all."""
LEAST_POINTS = 4
KEPT = 4000


def search_speed_mm_s(
    press_N: float,
    delay_s: float,
    acceleration_mm_s2: float,
    stiffness_N_mm: float = STIFFEST_N_mm,
) -> float:
    """Fastest speed that presses at most `press_N` between touch and standstill."""
    room_mm = press_N / stiffness_N_mm
    return acceleration_mm_s2 * (math.sqrt(delay_s**2 + 2 * room_mm / acceleration_mm_s2) - delay_s)


def closing_speed_mm_s(missing_N: float, stiffness_N_mm: float, delay_s: float) -> float:
    """Speed at which the missing force falls by 1/e in `CLOSING` delays."""
    return missing_N / (stiffness_N_mm * CLOSING * delay_s)


class ContactStiffness:
    """dF/dz of a contact that is being pressed, from positions and forces as they come.

    `force_age_s`: how much older the force of a pair is than its position.
    """

    def __init__(self, force_age_s: float):
        self._age_s = force_age_s
        self._times: deque[float] = deque(maxlen=KEPT)
        self._positions: deque[float] = deque(maxlen=KEPT)
        self._forces: deque[float] = deque(maxlen=KEPT)

    def add(self, time_s: float, position_mm: float, force_N: float) -> None:
        """One look at both."""
        self._times.append(time_s)
        self._positions.append(position_mm)
        self._forces.append(force_N)

    def at_N_mm(  # noqa: N802 - the unit keeps its capital, here and below
        self, force_N: float
    ) -> float | None:
        """Stiffness at about this force, N/mm, from the forces between `LOCAL` of it and it; None
        where too little was seen of them."""
        if len(self._times) < LEAST_POINTS:
            return None
        times = np.array(self._times)
        positions = np.interp(times - self._age_s, times, np.array(self._positions))
        forces = np.array(self._forces)
        near = (forces >= LOCAL * force_N) & (forces <= force_N / LOCAL)
        near &= times - self._age_s >= times[0]
        if near.sum() < LEAST_POINTS:
            return None
        slope = _slope(positions[near], forces[near])
        return slope if slope is not None and slope > 0 else None


@dataclass(frozen=True)
class ApproachStep:
    """What the axis is to do until the next look."""

    speed_mm_s: float
    """Into the skin; 0 where the force has arrived."""
    ahead_mm: float
    """Where to, from where the axis is."""
    touched: bool

    @property
    def arrived(self) -> bool:
        """Whether the servo may take over."""
        return self.touched and self.speed_mm_s == 0


class Approach:
    """Finds contact and brings the force up to `target_N`; one `step` a tick.

    `delay_s` is the servo's (`ServoSettings.delay_s`); a tick is added to it, for which a speed
    stands whatever happens. `force_age_s`: how much older the force given to `step` is than the
    position; an error of it shows in the stiffness that comes out.
    """

    def __init__(
        self,
        target_N: float,
        tick_s: float,
        delay_s: float,
        force_age_s: float,
        acceleration_mm_s2: float = 200.0,
    ):
        self.target_N = target_N
        self._ahead_s = max(AHEAD_s, 3 * tick_s)
        self._acceleration = acceleration_mm_s2
        self._delay_s = delay_s + tick_s
        self.search_mm_s = search_speed_mm_s(TOUCH * target_N, self._delay_s, acceleration_mm_s2)
        """Speed of the search for contact."""
        self._stiffness = ContactStiffness(force_age_s)
        self._touched = False
        self._latest_N = 0.0

    @property
    def stiffness_N_mm(self) -> float:  # noqa: N802
        """At the force reached so far, as far as is known: the servo's k once it has arrived."""
        known = self._stiffness.at_N_mm(self._latest_N) if self._touched else None
        return STIFFEST_N_mm if known is None else known

    def step(self, time_s: float, position_mm: float, force_N: float) -> ApproachStep:
        """What to do, given where the axis is and the mean force of the latest milliseconds."""
        self._latest_N = force_N
        if not self._touched and force_N < FELT * self.target_N:
            return self._go(self.search_mm_s)
        self._touched = True
        self._stiffness.add(time_s, position_mm, force_N)
        missing_N = self.target_N - force_N
        if missing_N <= ARRIVED * self.target_N:
            return ApproachStep(0.0, 0.0, True)
        return self._go(closing_speed_mm_s(missing_N, self.stiffness_N_mm, self._delay_s))

    def _go(self, speed_mm_s: float) -> ApproachStep:
        braking_mm = speed_mm_s**2 / (2 * self._acceleration)
        ahead_mm = max(speed_mm_s * self._ahead_s + braking_mm, LEAST_AHEAD_mm)
        return ApproachStep(speed_mm_s, ahead_mm, self._touched)


def _slope(x: NDArray[np.float64], y: NDArray[np.float64]) -> float | None:
    """Slope at the last x of the parabola, or where there are few points the line, through them."""
    spread = float(np.ptp(x))
    if spread <= 0:
        return None
    scaled = (x - x[-1]) / spread
    degree = 2 if x.size >= 3 * LEAST_POINTS else 1
    return float(np.polynomial.polynomial.polyfit(scaled, y, degree)[1]) / spread
