"""Brings the force from first touch to its set point with almost no overshoot. Numbers only.

While the axis moves at speed v, the force a controller knows is `delay_s` old, and stopping takes
another v²/2a. What is pressed meanwhile, k (v delay + v²/2a), is the overshoot. The stiffness k of
the contact is unknown before touching it. The search for contact is therefore slow enough for the
stiffest possible contact. After touch the speed follows from the missing force and the stiffness
measured so far:

    v = missing force / (k CLOSING delay)

This is a loop with one delay. It does not overshoot where the true stiffness is at most CLOSING / e
of the assumed k, overshoots by less than 10 % up to 0.58 CLOSING, and becomes unstable at 1.57
CLOSING.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rig.control.speed_bound import largest_speed_mm_s

STIFFEST_N_mm = 250.0
"""Stiffest contact of skin and object expected below 10 N, in N/mm, where the fixture states none
that is stiffer. A plate on the reference skin has 206 N/mm at 12 N."""
CLOSING = 4.0
"""Time in which the missing force falls to 1/e, in delays. It leaves room for a stiffness of 1.4
times the measured one, which is needed because the stiffness of a skin rises with the force."""
TOUCH = 0.5
"""Share of the target force that the search for contact may press before it has stopped."""
FELT = 0.05
"""Share of the target force from which a force is taken as contact."""
ARRIVED = 0.02
"""Share of the target force that may be missing when the servo takes over."""
LOCAL = 0.5
"""Lower end of the force range in which the stiffness is measured, as a share of the present
force."""
AHEAD_s = 0.03
"""Lead of the commanded target over the axis, in s of motion at the wanted speed. Far enough that
the axis reaches that speed, and near enough that a program that hangs does not press on."""
LEAST_AHEAD_mm = 0.0015
"""Shortest distance that is commanded, in mm: an axis with a resolution of 1 µm has to move at
all."""
LEAST_POINTS = 4
"""Minimum number of points from which a stiffness is computed."""
KEPT = 4000
"""Number of the latest points that are used."""


def closing_speed_mm_s(missing_N: float, stiffness_N_mm: float, delay_s: float) -> float:
    """Return the speed in mm/s at which the missing force falls to 1/e within `CLOSING` delays.

    >>> round(closing_speed_mm_s(1.0, stiffness_N_mm=150.0, delay_s=0.0145), 3)  # 1 N missing
    0.115
    """
    return missing_N / (stiffness_N_mm * CLOSING * delay_s)


class ContactStiffness:
    """Measures dF/dz of a contact while it is pressed, from positions and forces as they arrive.

    Each position and each force has its own time. Otherwise a link that takes 10 ms to report a
    position would make the contact appear half as stiff.
    """

    def __init__(self) -> None:
        self._seen_s: deque[float] = deque(maxlen=KEPT)
        self._positions: deque[float] = deque(maxlen=KEPT)
        self._felt_s: deque[float] = deque(maxlen=KEPT)
        self._forces: deque[float] = deque(maxlen=KEPT)

    def add(self, seen_s: float, position_mm: float, felt_s: float, force_N: float) -> None:
        """Add one poll: the position at `seen_s` and the force at `felt_s`, both on the same
        clock."""
        self._seen_s.append(seen_s)
        self._positions.append(position_mm)
        self._felt_s.append(felt_s)
        self._forces.append(force_N)

    def at_N_mm(  # noqa: N802 - the unit keeps its capital, here and below
        self, force_N: float
    ) -> float | None:
        """Return the stiffness near `force_N` in N/mm, or None if there are too few points near
        it.

        The points used have forces between `LOCAL` times `force_N` and `force_N` / `LOCAL`.
        """
        positions, forces = self._pairs()
        near = (forces >= LOCAL * force_N) & (forces <= force_N / LOCAL)
        if near.sum() < LEAST_POINTS:
            return None
        slope = _slope(positions[near], forces[near])
        return slope if slope is not None and slope > 0 else None

    def secant_N_mm(self) -> float:  # noqa: N802
        """Return the mean stiffness from the first poll to the latest in N/mm; 0 if the axis has
        not moved."""
        positions, forces = self._pairs()
        if len(forces) < LEAST_POINTS or positions[-1] <= positions[0]:
            return 0.0
        return max(0.0, float((forces[-1] - forces[0]) / (positions[-1] - positions[0])))

    def _pairs(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return positions and forces at the same times, as far as positions were recorded."""
        if not self._seen_s:
            return np.empty(0), np.empty(0)
        seen_s, felt_s = np.array(self._seen_s), np.array(self._felt_s)
        positions = np.interp(felt_s, seen_s, np.array(self._positions))
        known = (felt_s >= seen_s[0]) & (felt_s <= seen_s[-1])
        return positions[known], np.array(self._forces)[known]


@dataclass(frozen=True)
class ApproachStep:
    """The command of one tick of an approach."""

    speed_mm_s: float
    """Speed into the skin, in mm/s; 0 once the force has reached its target."""
    ahead_mm: float
    """Distance of the new target from the present position, in mm."""
    touched: bool
    """True once contact has been felt."""

    @property
    def arrived(self) -> bool:
        """True once the servo may take over."""
        return self.touched and self.speed_mm_s == 0


class Approach:
    """Searches for contact and brings the force up to `target_N`, with one `step` per tick.

    `delay_s` is that of the servo (`ServoSettings.delay_s`). One tick is added to it, because a
    commanded speed lasts for a whole tick whatever happens.

    >>> approach = Approach(target_N=4.0, tick_s=0.01, delay_s=0.0045)
    >>> round(approach.step(0.00, 1.000, 0.00, force_N=0.0).speed_mm_s, 2)  # searching
    0.51
    >>> approach.step(0.01, 1.005, 0.01, force_N=3.95).arrived  # within 2 % of 4 N
    True
    """

    def __init__(
        self,
        target_N: float,
        tick_s: float,
        delay_s: float,
        acceleration_mm_s2: float = 200.0,
        stiffest_N_mm: float = STIFFEST_N_mm,
        fastest_mm_s: float = math.inf,
        stage_mm_s: float = math.inf,
    ):
        """`stiffest_N_mm` is the stiffest contact that the fixture can make. `fastest_mm_s` bounds
        every speed after touch; the search has a bound of its own, and that of the stage,
        `stage_mm_s`."""
        self.target_N = target_N
        self._ahead_s = max(AHEAD_s, 3 * tick_s)
        self._acceleration, self._fastest_mm_s = acceleration_mm_s2, fastest_mm_s
        self._delay_s = delay_s + tick_s
        bound_mm_s = largest_speed_mm_s(
            TOUCH * target_N, stiffest_N_mm, self._delay_s, acceleration_mm_s2
        )
        self.search_mm_s = min(bound_mm_s, stage_mm_s)
        """Speed of the search for contact, in mm/s."""
        # A fixture that states a softer contact may be wrong, and what is assumed too soft presses
        # too hard. So what is stated makes the closing slower, never faster.
        self._assumed_N_mm = max(stiffest_N_mm, STIFFEST_N_mm)
        """Stiffness assumed until enough points were measured, in N/mm."""
        self._stiffness = ContactStiffness()
        self._touched = False
        self._latest_N = 0.0

    @property
    def stiffness_N_mm(self) -> float:  # noqa: N802
        """Stiffness at the force reached so far, in N/mm. Pass it to the servo after the approach.

        Until it can be measured, it is the stiffest that is expected. The measured one is at least
        the secant stiffness since touch, as far as such a contact is expected: a contact stiffens
        as it is pressed, and the few points that an overloaded computer has recorded may have any
        slope.
        """
        known = self._stiffness.at_N_mm(self._latest_N) if self._touched else None
        if known is None:
            return self._assumed_N_mm
        return max(known, min(self._stiffness.secant_N_mm(), self._assumed_N_mm))

    def step(
        self,
        seen_s: float,
        position_mm: float,
        felt_s: float,
        force_N: float,
        behind_s: float = 0.0,
    ) -> ApproachStep:
        """Return the move to command.

        `position_mm` is the position of the axis at `seen_s`, and `force_N` the mean force of some
        milliseconds about `felt_s`. An error of these times appears in the measured stiffness.
        `behind_s` is how much longer than `delay_s` a reaction takes at present.
        """
        self._latest_N = force_N
        if not self._touched and force_N < FELT * self.target_N:
            return self._go(self.search_mm_s)
        self._touched = True
        self._stiffness.add(seen_s, position_mm, felt_s, force_N)
        missing_N = self.target_N - force_N
        if missing_N <= ARRIVED * self.target_N:
            return ApproachStep(0.0, 0.0, True)
        delay_s = self._delay_s + behind_s
        closing_mm_s = closing_speed_mm_s(missing_N, self.stiffness_N_mm, delay_s)
        return self._go(min(closing_mm_s, self._fastest_mm_s))

    def _go(self, speed_mm_s: float) -> ApproachStep:
        braking_mm = speed_mm_s**2 / (2 * self._acceleration)
        ahead_mm = max(speed_mm_s * self._ahead_s + braking_mm, LEAST_AHEAD_mm)
        return ApproachStep(speed_mm_s, ahead_mm, self._touched)


def _slope(x: NDArray[np.float64], y: NDArray[np.float64]) -> float | None:
    """Return the slope at the last x of a parabola through the points, or of a line through few
    points or few places."""
    spread = float(np.ptp(x))
    if spread <= 0:
        return None
    # Scaled to the range of x: otherwise the powers of positions in mm make the fit
    # ill-conditioned.
    scaled = (x - x[-1]) / spread
    curved = x.size >= 3 * LEAST_POINTS and np.unique(scaled).size > 2
    degree = 2 if curved else 1
    return float(np.polynomial.polynomial.polyfit(scaled, y, degree)[1]) / spread
