"""What a detector says."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

EventKind = Literal["predictive", "incipient slip", "roll", "rejected"]
EVENT_KINDS: tuple[EventKind, ...] = get_args(EventKind)


@dataclass(frozen=True)
class SlipEvent:
    """A decision, and what it rests on."""

    kind: EventKind
    """``predictive``: the low-passed v_d arms; ``incipient slip``: it fires; ``roll``: what is
    under way is a roll; ``rejected``: something that might have been a slip, with the reason."""
    sample: int
    """Row at which it was decided, from the first row given."""
    time_s: float
    """The same row's time, 0 at the first row."""
    confidence: float
    """From 0 to 1; of the published logics x / (x + threshold)."""
    reason: str = ""
    """Why it was rejected."""
    features: dict[str, float] = field(default_factory=dict)
    """What decided; names carry their units."""
