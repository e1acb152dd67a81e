"""Raises a tangential force at a given rate by the speed of a stage. Numbers only.

The stage drags the skin along, and F_t rises with the travel, ever less steeply as ridges slip.
While the stage moves at speed v, the force a controller knows is `delay_s` old. The speed therefore
follows from the rate, the missing force and the tangential stiffness k measured so far:

    v = (rate + missing force / (CLOSING delay)) / k

This is the loop of `rig.control.approach` with the rate added. Once all of the skin slips, no speed
makes the force rise any further: the missing force grows, the speed reaches its limit, and the ramp
has become a slide.

With `holds_N` the force rises to it and is held there, as a weight does that is lowered onto the
contact. While the contact sticks the stage goes to and fro by what is missing or too much; while it
slips, the speed grows with what is missing, up to the largest speed: the weight falls. That is no
inertia: a body would fall by g, the stage by its acceleration, and faster than its speed by none.
"""

from __future__ import annotations

import math

from rig.control.approach import CLOSING, ContactStiffness

STIFFEST_N_mm = 60.0
"""Tangential stiffness assumed at the start, in N/mm. The reference skin has 40 to 50 N/mm at 4 N,
and 23 N/mm after 10 µm."""
SOFTEST_N_mm = 2.0
"""Lowest stiffness that is believed, in N/mm: a softer contact slips, and the measured value is
noise."""
SLOWEST_mm_s = 0.002
"""Lowest speed that is commanded, in mm/s, because a stage cannot be commanded to move at 0."""
FALLEN_BEHIND = 2.0
"""Lateness of the force, in closing times, from which the whole contact is taken to slip. Before
that it is at most 1 late, including the start of the motion."""


class ForceRamp:
    """Raises a force at `rate_N_s`, with one `step` per tick.

    `delay_s` is the time from a command to the first force that shows it. One tick is added to it.

    >>> ramp = ForceRamp(rate_N_s=2.0, largest_mm_s=1.0, tick_s=0.01, delay_s=0.005)
    >>> ramp.wanted_N(0.5)
    1.0
    >>> round(ramp.step(0.5, seen_s=0.49, travel_mm=0.02, felt_s=0.495, force_N=1.0), 4)  # 2 / 60
    0.0333
    """

    def __init__(
        self,
        rate_N_s: float,
        largest_mm_s: float,
        tick_s: float,
        delay_s: float,
        holds_N: float = math.inf,
    ):
        self.rate_N_s, self.largest_mm_s, self.holds_N = rate_N_s, largest_mm_s, holds_N
        self._tick_s, self._falling_mm_s = tick_s, 0.0
        self._stiffest_N_mm = 0.0
        """Largest stiffness measured so far."""
        self._closing_s = CLOSING * (delay_s + tick_s)
        self._contact = ContactStiffness()
        self._polled_s = -math.inf
        """Time of the latest known travel."""
        self._stiffness_N_mm = STIFFEST_N_mm
        self._late_s = 0.0
        self.slipped = False
        """True once the contact gave way: at full speed the force fell behind the ramp."""

    @property
    def follows(self) -> bool:
        """True while the force follows the ramp."""
        return self._late_s <= self._closing_s

    def wanted_N(self, since_s: float) -> float:  # noqa: N802 - the unit keeps its capital
        """Return the force that the ramp requires `since_s` after its start, in N."""
        return min(self.rate_N_s * since_s, self.holds_N)

    def step(
        self, since_s: float, seen_s: float, travel_mm: float, felt_s: float, force_N: float
    ) -> float:
        """Return the speed along the ramp in mm/s, `since_s` after the start of the ramp; negative
        is back, which only a held force asks for.

        `travel_mm` is the latest known travel, measured at `seen_s`, and `force_N` the mean force
        of some milliseconds about `felt_s`, both positive along the ramp. A travel that was passed
        before is ignored.
        """
        if seen_s > self._polled_s:
            self._polled_s = seen_s
            self._contact.add(seen_s, travel_mm, felt_s, force_N)
        missing_N = self.wanted_N(since_s) - force_N
        self._late_s = missing_N / self.rate_N_s
        known = self._contact.at_N_mm(force_N)
        if known is not None:
            self._stiffness_N_mm = max(known, SOFTEST_N_mm)
            self._stiffest_N_mm = max(self._stiffest_N_mm, self._stiffness_N_mm)
        if math.isfinite(self.holds_N):
            return self._load_mm_s(since_s, missing_N)
        speed = (self.rate_N_s + missing_N / self._closing_s) / self._stiffness_N_mm
        behind = self._late_s > FALLEN_BEHIND * self._closing_s
        self.slipped |= behind and speed >= self.largest_mm_s
        return min(max(speed, SLOWEST_mm_s), self.largest_mm_s)

    def _load_mm_s(self, since_s: float, missing_N: float) -> float:
        """Return the speed in mm/s that a weight takes: what closes the missing force at the
        stiffness of a contact that sticks, and the fall of one that slips."""
        stiffness_N_mm, closing_s = self._stiffest_N_mm or STIFFEST_N_mm, self._closing_s
        rising = self.rate_N_s * since_s < self.holds_N
        if missing_N > 0:
            self._falling_mm_s += missing_N / (closing_s**2 * stiffness_N_mm) * self._tick_s
            self._falling_mm_s = min(self._falling_mm_s, self.largest_mm_s)
        else:
            self._falling_mm_s = 0.0
        rate_N_s = (self.rate_N_s if rising else 0.0) + missing_N / closing_s
        speed_mm_s = rate_N_s / stiffness_N_mm + self._falling_mm_s
        return max(-self.largest_mm_s, min(speed_mm_s, self.largest_mm_s))
