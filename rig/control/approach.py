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

    Each has its own time: a link that takes ten milliseconds to say where the axis is would else
    make the contact seem half as stiff.
    """

    def __init__(self) -> None:
        self._seen_s: deque[float] = deque(maxlen=KEPT)
        self._positions: deque[float] = deque(maxlen=KEPT)
        self._felt_s: deque[float] = deque(maxlen=KEPT)
        self._forces: deque[float] = deque(maxlen=KEPT)

    def add(self, seen_s: float, position_mm: float, felt_s: float, force_N: float) -> None:
        """One look at both: where the axis was at `seen_s`, and the force at `felt_s`."""
        self._seen_s.append(seen_s)
        self._positions.append(position_mm)
        self._felt_s.append(felt_s)
        self._forces.append(force_N)

    def at_N_mm(  # noqa: N802 - the unit keeps its capital, here and below
        self, force_N: float
    ) -> float | None:
        """Stiffness at about this force, N/mm, from the forces between `LOCAL` of it and it; None
        where too little was seen of them."""
        positions, forces = self._pairs()
        near = (forces >= LOCAL * force_N) & (forces <= force_N / LOCAL)
        if near.sum() < LEAST_POINTS:
            return None
        slope = _slope(positions[near], forces[near])
        return slope if slope is not None and slope > 0 else None

    def secant_N_mm(self) -> float:  # noqa: N802
        """Force by way from the first look to the latest, N/mm; 0 where there is no way."""
        positions, forces = self._pairs()
        if len(forces) < LEAST_POINTS or positions[-1] <= positions[0]:
            return 0.0
        return max(0.0, float((forces[-1] - forces[0]) / (positions[-1] - positions[0])))

    def _pairs(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Forces, and where the axis was when they were felt, as far as it had been seen."""
        if not self._seen_s:
            return np.empty(0), np.empty(0)
        seen_s, felt_s = np.array(self._seen_s), np.array(self._felt_s)
        positions = np.interp(felt_s, seen_s, np.array(self._positions))
        known = (felt_s >= seen_s[0]) & (felt_s <= seen_s[-1])
        return positions[known], np.array(self._forces)[known]


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
    stands whatever happens.
    """

    def __init__(
        self,
        target_N: float,
        tick_s: float,
        delay_s: float,
        acceleration_mm_s2: float = 200.0,
    ):
        self.target_N = target_N
        self._ahead_s = max(AHEAD_s, 3 * tick_s)
        self._acceleration = acceleration_mm_s2
        self._delay_s = delay_s + tick_s
        self.search_mm_s = search_speed_mm_s(TOUCH * target_N, self._delay_s, acceleration_mm_s2)
        """Speed of the search for contact."""
        self._stiffness = ContactStiffness()
        self._touched = False
        self._latest_N = 0.0

    @property
    def stiffness_N_mm(self) -> float:  # noqa: N802
        """At the force reached so far, as far as is known: the servo's k once it has arrived.

        No less than the force by the way since touch: a contact stiffens as it is pressed, and the
        few points that a starved computer has seen may lie on any slope.
        """
        known = self._stiffness.at_N_mm(self._latest_N) if self._touched else None
        if known is None:
            return STIFFEST_N_mm
        return max(known, min(self._stiffness.secant_N_mm(), STIFFEST_N_mm))

    def step(
        self,
        seen_s: float,
        position_mm: float,
        felt_s: float,
        force_N: float,
        behind_s: float = 0.0,
    ) -> ApproachStep:
        """What to do, given where the axis was at `seen_s` and the mean force of some milliseconds
        about `felt_s`: an error of these times shows in the stiffness that comes out. `behind_s`:
        by how much longer than `delay_s` things take just now."""
        self._latest_N = force_N
        if not self._touched and force_N < FELT * self.target_N:
            return self._go(self.search_mm_s)
        self._touched = True
        self._stiffness.add(seen_s, position_mm, felt_s, force_N)
        missing_N = self.target_N - force_N
        if missing_N <= ARRIVED * self.target_N:
            return ApproachStep(0.0, 0.0, True)
        delay_s = self._delay_s + behind_s
        return self._go(closing_speed_mm_s(missing_N, self.stiffness_N_mm, delay_s))

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
