"""What a detector found in a run under way, as events of its journal and as text of a reading.

A run whose settings name a detector records everything that it finds: in the journal at once, one
event each, and in the reading of each trial, in the column ``detections``.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from rig.detector.events import SHOWN_AS, UNJUDGED, SlipEvent

if TYPE_CHECKING:
    from rig.detector.events import EventKind

SLIP = "incipient slip"
"""Kind of the detections that are alarms."""
EVENT_CODES = {
    "predictive": "early-warning",
    "incipient slip": "slip-detected",
    "roll": "roll-detected",
    "rejected": "slip-rejected",
    "cannot judge": "slip-not-judged",
    "judges again": "slip-judged-again",
}
"""Codes of journal events by the kind of what was found (`rig.detector.events`)."""
SHOWN_CODES = {
    EVENT_CODES["predictive"]: "motion under load begun",
    EVENT_CODES["incipient slip"]: "incipient slip",
    EVENT_CODES["cannot judge"]: "cannot judge",
    EVENT_CODES["judges again"]: "judges again",
}
"""Those that are shown on an axis of time, and what they are called there."""
UNSHOWN_CODES = (EVENT_CODES["roll"], EVENT_CODES["rejected"])
"""Those that would cover it; the run file has them."""
NO_DETECTOR = "none"
"""Setting `detector` of a run that looks for no slips."""
SILENT_CODE = "detection-ended"
"""Code of the event after which a run detects nothing more."""


@dataclass(frozen=True)
class Detection:
    """One event of a detector in a trial."""

    kind: EventKind
    sample: int
    """Row of v_1 and v_2 at which it was decided, from 0."""
    time_s: float
    """Time of that row in s since the first one."""
    decided_s: float
    """Time on the run's clock, since the record began, at which the program knew it."""
    confidence: float
    reason: str = ""
    predictive_mV: float | None = None
    """Predictive signal at that row, P_A of a slip; None in recordings of earlier versions
    and for a detector that does not state it."""
    impulse_mV: float | None = None
    """Largest impulse of v_d until that row, P_B of a slip; None likewise, 0 before any."""
    unjudged_ms: float | None = None
    """How long nothing had been judged by then, of events of the last two kinds; None likewise, and
    for other events."""

    def as_event(self) -> SlipEvent:
        """Return the detector's event, with those of its features that are kept."""
        kept = {
            "predictive_mV": self.predictive_mV,
            "impulse_mV": self.impulse_mV,
            UNJUDGED: self.unjudged_ms,
        }
        features = {name: value for name, value in kept.items() if value is not None}
        return SlipEvent(
            self.kind, self.sample, self.time_s, self.confidence, self.reason, features
        )

    def in_words(self, point: str, detector: str) -> str:
        """Return what an event of the journal says of it."""
        why = f", {self.reason}" if self.reason else ""
        shown = SHOWN_AS[self.kind]
        return (
            f"{point}: {shown} at {self.time_s:.3f} s of its record (sample {self.sample}), "
            f"confidence {self.confidence:.2f}{why} ({detector})"
        )


def detection_of(event: SlipEvent, decided_s: float) -> Detection:
    """Return an event of a detector that was known at `decided_s`."""
    return Detection(
        event.kind,
        event.sample,
        event.time_s,
        decided_s,
        event.confidence,
        event.reason,
        event.features.get("predictive_mV"),
        event.features.get("impulse_mV"),
        event.features.get(UNJUDGED),
    )


def to_text(detections: Sequence[Detection]) -> str:
    """Return detections as the text of a reading's column."""
    return json.dumps([asdict(one) for one in detections])


def from_text(text: str) -> list[Detection]:
    """Return the detections in a reading's column; none for "", as in files of earlier versions.

    Raises ValueError for a text that is not one of `to_text`.
    """
    found: list[dict[str, Any]] = json.loads(text) if text else []
    try:
        return [Detection(**one) for one in found]
    except TypeError as error:
        raise ValueError(f"not a list of detections: {error}") from error
