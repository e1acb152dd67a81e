"""The largest speed towards a contact from which an axis stops before the force is too large.

Numbers only. The distance covered from contact to standstill at speed v is v τ + v²/2a: τ is the
reaction time, from the contact until the axis begins to brake, and a its deceleration (uniform
motion, then uniform deceleration). A contact of stiffness k answers with k times that distance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from rig.core.errors import LimitError


def largest_speed_mm_s(
    margin_N: float, stiffness_N_mm: float, reaction_s: float, deceleration_mm_s2: float
) -> float:
    """Return the largest speed in mm/s for which (v τ + v²/2a) k is at most `margin_N`.

    `margin_N` is the force in N that may be added between contact and standstill, `stiffness_N_mm`
    is k in N/mm, `reaction_s` is τ in s, `deceleration_mm_s2` is a in mm/s². It is 0 where no force
    may be added.

    >>> round(largest_speed_mm_s(2.0, 250.0, reaction_s=0.01, deceleration_mm_s2=200.0), 2)
    0.68
    """
    room_mm = max(margin_N, 0.0) / stiffness_N_mm
    return deceleration_mm_s2 * (
        math.sqrt(reaction_s**2 + 2 * room_mm / deceleration_mm_s2) - reaction_s
    )


@dataclass(frozen=True)
class SpeedBound:
    """A bound on the speed towards a contact, with the numbers that it follows from."""

    margin_N: float
    stiffness_N_mm: float
    reaction_s: float
    deceleration_mm_s2: float

    @property
    def speed_mm_s(self) -> float:
        """Largest speed in mm/s."""
        return largest_speed_mm_s(
            self.margin_N, self.stiffness_N_mm, self.reaction_s, self.deceleration_mm_s2
        )

    def in_words(self) -> str:
        """Return the bound with the numbers that it follows from."""
        return (
            f"{self.speed_mm_s:.3g} mm/s, from which it stops within {self.margin_N:.3g} N: "
            f"stiffest contact {self.stiffness_N_mm:g} N/mm, reaction {self.reaction_s:.2g} s, "
            f"deceleration {self.deceleration_mm_s2:g} mm/s2"
        )

    def require(self, device: str, speed_mm_s: float) -> None:
        """Raise LimitError, which names the numbers that the bound follows from, for a faster
        speed."""
        if speed_mm_s <= self.speed_mm_s:
            return
        raise LimitError(
            f"{device}: a speed of {speed_mm_s:.3g} mm/s towards a contact is above "
            f"{self.in_words()}",
            "choose a slower one or a smaller force, or correct stiffest_contact_N_mm in [fixture]",
        )
