"""Events that a detector reports."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

EventKind = Literal[
    "predictive", "incipient slip", "roll", "rejected", "cannot judge", "judges again"
]
"""Kinds of events, as they are written to processed files."""
UNJUDGED = "unjudged_ms"
"""Name of the number with which events of the last two kinds state for how long nothing had been
judged when they were decided."""
ONE_INVERTED = (
    "the first touch drives v_1 and v_2 oppositely: one is inverted, or it was not recorded"
)
"""Reason of a rejection, as the kernel states it, after which alarms are not to be trusted."""
EVENT_KINDS: tuple[EventKind, ...] = get_args(EventKind)
SHOWN_AS: dict[EventKind, str] = {
    "predictive": "motion under load begun",
    "incipient slip": "incipient slip",
    "roll": "roll",
    "rejected": "ignored",
    "cannot judge": "cannot judge",
    "judges again": "judges again",
}
"""What the kinds are called where people read them, in the singular. The paper calls the first one
predictive; it comes in every hold and roll as well, so that it predicts no slip."""

MOST_NAMED = 5
"""Number of trials that a warning names."""
_COUNTED: dict[EventKind, tuple[str, str]] = {
    "predictive": (SHOWN_AS["predictive"], "motions under load begun"),
    "incipient slip": ("alarm of incipient slip", "alarms of incipient slip"),
    "roll": (SHOWN_AS["roll"], "rolls"),
}
"""What is counted, one and several: a slip that lasts may have many alarms."""


def counted_events(kind: EventKind, number: int) -> str:
    """Return how often a kind of event was found.

    >>> counted_events("predictive", 2), counted_events("incipient slip", 1)
    ('2 motions under load begun', '1 alarm of incipient slip')
    """
    one, several = _COUNTED.get(kind, (SHOWN_AS[kind], SHOWN_AS[kind]))
    return f"{number} {one if number == 1 else several}"


@dataclass(frozen=True)
class SlipEvent:
    """A decision of a detector, and the numbers that it rests on."""

    kind: EventKind
    """``predictive``: the low-passed v_d passed its threshold, because a motion under load has
    begun (it does not warn of a slip); ``incipient slip``: a slip was detected; ``roll``: the
    current motion is a roll; ``rejected``: something resembled a slip but was not reported as one,
    see `reason`; ``cannot judge``: nothing is judged from now on, for a `reason`, until ``judges
    again``."""
    sample: int
    """Row at which it was decided, counted from the first row given."""
    time_s: float
    """Time of that row, in s from the first row."""
    confidence: float
    """Confidence from 0 to 1. For the published logics it is x / (x + threshold)."""
    reason: str = ""
    """Reason of a rejection, or why nothing can or could be judged; empty for other events."""
    features: dict[str, float] = field(default_factory=dict)
    """Numbers that decided, by name and unit (`rig.detector.kernel.EVENT_FEATURES`); of the last
    two kinds also `UNJUDGED`."""


def says_inverted(events: Iterable[SlipEvent]) -> bool:
    """Return whether the detector said that one channel may be inverted."""
    return any(event.reason == ONE_INVERTED for event in events)


def inverted_warning(trials: Mapping[str, Iterable[SlipEvent]]) -> str | None:
    """Return the warning of the trials in which one channel may be inverted; None without one.

    >>> touch = SlipEvent("rejected", 500, 0.5, 0.0, ONE_INVERTED)
    >>> inverted_warning({"trial-001": [touch], "trial-002": []})
    'alarms in trial-001 are not to be trusted: the first touch drives v_1 and v_2 oppositely, so \
one is inverted, or the first touch was not recorded'
    """
    named = [trial for trial, events in trials.items() if says_inverted(events)]
    if not named:
        return None
    more = f" and {len(named) - MOST_NAMED} more" if len(named) > MOST_NAMED else ""
    return (
        f"alarms in {', '.join(named[:MOST_NAMED])}{more} are not to be trusted: the first touch "
        "drives v_1 and v_2 oppositely, so one is inverted, or the first touch was not recorded"
    )


def unjudged_s(events: Iterable[SlipEvent], record_s: float) -> tuple[tuple[float, float], ...]:
    """Return the intervals of a recording, in s, in which a detector did not judge.

    `events` are all events of the recording in their order, and `record_s` is its length.

    >>> saturated = SlipEvent("cannot judge", 500, 0.5, 0.0, "saturated", {"unjudged_ms": 0.0})
    >>> again = SlipEvent("judges again", 600, 0.6, 0.0, "saturated", {"unjudged_ms": 100.0})
    >>> unjudged_s([saturated, again], 2.0), unjudged_s([saturated], 2.0)
    (((0.5, 0.6),), ((0.5, 2.0),))
    """
    intervals: list[tuple[float, float]] = []
    begin: float | None = None
    for event in events:
        if event.kind == "cannot judge":
            noticed = event.time_s - 1e-3 * event.features.get(UNJUDGED, 0.0)
            begin = max(0.0, noticed if begin is None else min(begin, noticed))
        elif event.kind == "judges again" and begin is not None:
            intervals.append((begin, event.time_s))
            begin = None
    if begin is not None:
        intervals.append((begin, record_s))
    return tuple(intervals)
