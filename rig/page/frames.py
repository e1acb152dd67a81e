"""What is sent to a viewer: only what is new since the frame that it has taken before.

A viewer pulls: its next frame is made when its connection has taken the last one. One that never
reads gets none and keeps nothing here but its cursor; the frames that it missed are dropped.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from rig.core.json_text import finite
from rig.page.watch import BenchWatch
from rig.page.word import SILENT_S
from rig.run.locks.lock_holder import LockHolder

SPECTRUM_EVERY_S = 1.0
LATE_SHARE = 0.005
"""Share of late ticks from which the page says that the control loop is late."""


@dataclass
class Cursor:
    """What a viewer of the page has been sent already, so that only what is new follows."""

    generation: int = -1
    keys: dict[str, int] = field(default_factory=dict)
    event: int = 0
    curve: int = 0
    spectrum_s: float = 0.0


def next_frame(
    watch: BenchWatch, cursor: Cursor, *, may_stop: bool, polled_s: float
) -> dict[str, Any]:
    """Return the next frame for a viewer and move its cursor. `polled_s` is the monotonic time at
    which the watch was polled last: an old one makes the state unknown."""
    now = time.monotonic()
    with watch.lock:
        view = watch.view
        if cursor.generation != watch.generation:
            cursor.generation = watch.generation
            cursor.keys, cursor.event, cursor.curve = {}, 0, 0
            cursor.spectrum_s = 0.0
        word, reason = watch.word.word, watch.word.reason
        if now - polled_s > SILENT_S:
            word, reason = (
                "unknown",
                f"for {now - polled_s:.0f} s the page's server has not looked at the bench: this "
                "computer is too busy, or rig.log says why",
            )
        frame: dict[str, Any] = {
            "gen": watch.generation,
            "time": datetime.now().astimezone().isoformat(" ", "seconds"),
            "word": word,
            "reason": reason,
            "silent_s": round(watch.silent_s(now), 1),
            "run": view.summary(),
            "last_file": watch.last_file,
            "holder": _who(watch.holder),
            "bench_holder": _who(watch.signs.holder),
            "stop": _stop(watch),
            "may_stop": may_stop,
            "can_make_safe": may_stop
            and watch.signs.bench_file is not None
            and watch.holder is None
            and watch.signs.holder is None,
            "late": "" if view.end else _late(view.ticks, view.late_ticks),
            "series": _series(watch, cursor),
            "events": [event for event in (*view.events, *view.slips) if event["n"] > cursor.event],
            "curve": [list(point) for point in view.curve[cursor.curve :]],
        }
        cursor.event, cursor.curve = view.event_count, len(view.curve)
        if now - cursor.spectrum_s >= SPECTRUM_EVERY_S:
            cursor.spectrum_s = now
            frame["spectrum"] = view.spectrum()
    return frame


def as_event(frame: dict[str, Any]) -> bytes:
    """Return a frame as a server-sent event."""
    return b"data: " + json.dumps(finite(frame), separators=(",", ":")).encode() + b"\n\n"


def _series(watch: BenchWatch, cursor: Cursor) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, ring in watch.view.rings.items():
        if ring.last_key < 0:
            continue
        # The newest interval may have grown since it was sent: it is sent again.
        found[name] = ring.since(cursor.keys.get(name, -1))
        cursor.keys[name] = ring.last_key
    return found


def _stop(watch: BenchWatch) -> dict[str, Any] | None:
    course, stop = watch.course(), watch.stop
    if course is None or stop is None:
        return None
    return {
        "phase": course.phase,
        "text": course.text,
        "over": course.over,
        "safe": course.safe,
        "asked": stop.wall,
        "presses": stop.presses,
        "since_s": round(time.monotonic() - stop.at_s, 1),
    }


def _late(ticks: int, late: int) -> str:
    if not ticks or late < LATE_SHARE * ticks:
        return ""
    return (
        f"The control loop is late: {late} of {ticks} ticks began late "
        f"({100 * late / ticks:.1f} %). Close the browser on the bench's computer, or watch from "
        "another computer."
    )


def _who(holder: LockHolder | None) -> dict[str, Any] | None:
    if holder is None:
        return None
    return {"pid": holder.pid, "user": holder.user, "own": holder.own}
