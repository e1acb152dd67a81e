"""A rise of the held force that the grip has made, and its times."""

from __future__ import annotations

from dataclasses import dataclass

STALE_S = 0.1
"""Age in s of an alarm's sample from which nothing is squeezed: what slipped then has slipped on or
has stopped."""


@dataclass
class Squeeze:
    """One rise of the set point; times in s since the record began, None for what has not been."""

    sample_s: float | None
    """Time of the sample at which the alarm was raised; None for a squeeze without an alarm."""
    decided_s: float
    """When the program knew of the alarm and decided."""
    from_N: float
    to_N: float
    sent_s: float | None = None
    """When the command to z was sent."""
    acknowledged_s: float | None = None
    """When z had acknowledged it."""
    risen_s: float | None = None
    """When F_n had risen by a tenth of the step."""
