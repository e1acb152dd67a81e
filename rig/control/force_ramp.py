"""A tangential force that rises at a given rate, by the speed of a stage: the numbers only.

The stage drags the skin along, F_t rises with the travel, ever less steeply as ridges slip. While
it moves at speed v, the force a controller knows is `delay_s` old. So the speed follows from the
rate, from what is missing, and from the contact's tangential stiffness k as it proves to be,

    v = (rate + missing force / (CLOSING delay)) / k,

the closed form of `rig.control.approach` with the rate put ahead of it. When all of the skin slips,
no speed makes the force rise any more: what is missing grows, the speed goes to its limit, and the
ramp has become a slide.
"""

from __future__ import annotations

import math

from rig.control.approach import CLOSING, ContactStiffness

STIFFEST_N_mm = 60.0
"""Of the reference skin under shear, at the beginning: 40 to 50 N/mm at 4 N, 23 after 10 µm."""
SOFTEST_N_mm = 2.0
"""Softer, it slips: what noise makes of the stiffness counts no more."""
SLOWEST_mm_s = 0.002
"""A stage that is told to move has to."""
FALLEN_BEHIND = 2.0
"""Times of closing that the force is late by when the contact as a whole has slipped; it is late by
at most one before, the beginning of the motion included."""


class ForceRamp:
    """Brings a force up at `rate_N_s`; one `step` a tick.

    `delay_s` is from a command to the first force that shows it; a tick is added to it.
    """

    def __init__(self, rate_N_s: float, largest_mm_s: float, tick_s: float, delay_s: float):
        self.rate_N_s, self.largest_mm_s = rate_N_s, largest_mm_s
        self._closing_s = CLOSING * (delay_s + tick_s)
        self._contact = ContactStiffness()
        self._looked_s = -math.inf
        """When the latest look at the travel was."""
        self._stiffness_N_mm = STIFFEST_N_mm
        self._late_s = 0.0
        self.slipped = False
        """Whether the contact gave way: at full speed, the force fell behind the ramp."""

    @property
    def follows(self) -> bool:
        """Whether the force is on its ramp."""
        return self._late_s <= self._closing_s

    def wanted_N(self, since_s: float) -> float:  # noqa: N802 - the unit keeps its capital
        """The force that the ramp asks for, so long after its beginning."""
        return self.rate_N_s * since_s

    def step(
        self, since_s: float, seen_s: float, travel_mm: float, felt_s: float, force_N: float
    ) -> float:
        """Speed along the ramp, mm/s, `since_s` after its beginning, given the travel as it was
        seen last, at `seen_s`, and the mean force of some milliseconds about `felt_s`, both
        positive along the ramp. A look that was given before tells nothing new."""
        if seen_s > self._looked_s:
            self._looked_s = seen_s
            self._contact.add(seen_s, travel_mm, felt_s, force_N)
        missing_N = self.wanted_N(since_s) - force_N
        self._late_s = missing_N / self.rate_N_s
        known = self._contact.at_N_mm(force_N)
        if known is not None:
            self._stiffness_N_mm = max(known, SOFTEST_N_mm)
        speed = (self.rate_N_s + missing_N / self._closing_s) / self._stiffness_N_mm
        behind = self._late_s > FALLEN_BEHIND * self._closing_s
        self.slipped |= behind and speed >= self.largest_mm_s
        return min(max(speed, SLOWEST_mm_s), self.largest_mm_s)
