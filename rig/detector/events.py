"""Events that a detector reports."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

EventKind = Literal["predictive", "incipient slip", "roll", "rejected"]
"""Kinds of events, as they are written to processed files."""
EVENT_KINDS: tuple[EventKind, ...] = get_args(EventKind)


@dataclass(frozen=True)
class SlipEvent:
    """A decision of a detector, and the numbers that it rests on."""

    kind: EventKind
    """``predictive``: the low-passed v_d passed its threshold (an early warning); ``incipient
    slip``: a slip was detected; ``roll``: the current motion is a roll; ``rejected``: something
    resembled a slip but was not reported as one, see `reason`."""
    sample: int
    """Row at which it was decided, counted from the first row given."""
    time_s: float
    """Time of that row, in s from the first row."""
    confidence: float
    """Confidence from 0 to 1. For the published logics it is x / (x + threshold)."""
    reason: str = ""
    """Reason of a rejection; empty for other events."""
    features: dict[str, float] = field(default_factory=dict)
    """Numbers that decided, by name and unit (`rig.detector.kernel.EVENT_FEATURES`)."""
