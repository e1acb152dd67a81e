"""The truth of a trial on the simulated bench, from the account that its World left in the run
file.

Everything that happened after the record ended is left out: a slide that stops short slips when it
is lifted, which nothing that sees the record can know.
"""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from rig.evaluation.scoring.outcomes import FOUND_WITHIN_S
from rig.files.journal.layout import TRUTH

if TYPE_CHECKING:
    from rig.files.runfile.reader import RunFile

AT_REST_mm = 0.002
"""Way from where x comes to rest within which it rests; its drive resolves less."""
SETTLED_S = 0.25
"""Time after a motion from which the contact is quiet: the rubber and the strips' filters have
settled."""
LIFTS_WITHIN_S = 0.1
"""A ridge that is let go slips as a whole before it lifts off: the slip belongs to the lift-off if
it comes less than this before it."""
ROLL = "roll-trial"
"""The procedure that rolls."""


def times_of(reading: dict[str, Any], record_s: float) -> dict[str, float | None]:
    """Return what the World says of a trial, in s from the start of its record; None for never, and
    for what happened after the record, which is `record_s` long. The dict is empty where the World
    says nothing."""
    account = reading.get(TRUTH)
    if not account:
        return {}
    known = json.loads(account)
    ridge, begun_us = known["ridge"] - 1, known["record_begun_us"]

    def seconds(us: float | None) -> float | None:
        at_s = math.inf if us is None else 1e-6 * (us - begun_us)
        return at_s if at_s <= record_s else None

    # The normal force may change before the object moves, or alone.
    begun_s = [seconds(known["slide_us"]), *(reading.get(name) for name in _BEGINS)]
    moved_s = min((at_s for at_s in begun_s if at_s is not None), default=None)
    lifts = [seconds(us) for us in known.get("ridge_lift_off_us", [])]
    lifts_after = [at for at in lifts if at is not None and moved_s is not None and at >= moved_s]
    return {
        "motion_s": moved_s,
        "node_slip_s": seconds(known["first_slip_us"][ridge]),
        "ridge_slip_s": seconds(known["whole_slip_us"][ridge]),
        "gross_slip_s": seconds(known["gross_slip_us"]),
        "lift_off_s": lifts_after[0] if lifts_after else None,
    }


def slips_of(reading: dict[str, Any], record_s: float) -> tuple[tuple[float, float], ...]:
    """Return begin and end of every slip of the ridge that is read as a whole, in s from the start
    of its record, which is `record_s` long; one that lasts beyond it ends with it. The tuple is
    empty where the World says nothing of them."""
    known = json.loads(reading.get(TRUTH) or "{}")
    begun_us = known.get("record_begun_us", 0)
    begins_us, ends_us = known.get("ridge_slip_begins_us", []), known.get("ridge_slip_ends_us", [])
    slips = []
    for number, begin_us in enumerate(begins_us):
        begin_s = 1e-6 * (begin_us - begun_us)
        end_s = 1e-6 * (ends_us[number] - begun_us) if number < len(ends_us) else math.inf
        if begin_s <= record_s:
            slips.append((begin_s, min(end_s, record_s)))
    return tuple(slips)


_BEGINS = ("motion_from_s", "slide_from_s", "roll_from_s")
"""Columns that state when a procedure began its motion, of which a reading has one."""


def begin_of(reading: dict[str, Any]) -> float | None:
    """Return when the procedure began its motion, in s of the record; None if it does not say."""
    begins = (reading[name] for name in _BEGINS if reading.get(name) is not None)
    return next(map(float, begins), None)


def label_of(times: dict[str, float | None], procedure: str, motion_end_s: float | None) -> str:
    """Return the label of a trial from its times and the end of its motion in s of the record; a
    motion without an end lasts as long as the record."""
    slip_s, lift_s = times["ridge_slip_s"], times["lift_off_s"]
    lifted = lift_s is not None
    if procedure == ROLL:
        return "lift-off" if lifted else "slip in a roll" if slip_s is not None else "roll"
    if slip_s is not None and (lift_s is None or slip_s < lift_s - LIFTS_WITHIN_S):
        ends_s = math.inf if motion_end_s is None else motion_end_s
        return "slip in a slide" if ends_s > slip_s + FOUND_WITHIN_S else "slip"
    if lifted:
        return "lift-off"
    return "hold" if times["node_slip_s"] is None else "partial slip"


def motion_end_of(run: RunFile, point: str, reading: dict[str, Any]) -> float | None:
    """Return when the motion of a point ended, in s of its record: when x came to rest, or the roll
    ended; None where the file does not say, and 0 where x has never moved."""
    if reading.get("roll_to_s") is not None:
        return float(reading["roll_to_s"])
    axes = {wave.stream: wave for wave in run.waveforms(point)}
    if not {"ticks", "position"} <= set(axes):
        return None
    elapsed_s, x_mm = axes["ticks"].values("elapsed"), axes["position"].values("x")
    if len(x_mm) != len(elapsed_s) or not len(x_mm):
        return None
    moving = np.flatnonzero(np.abs(x_mm - x_mm[-1]) > AT_REST_mm)
    # The look after the last one away from there; x that never moved ends where the force may.
    return float(elapsed_s[min(moving[-1] + 1, len(elapsed_s) - 1)]) if moving.size else 0.0


def quiet_of(
    times: dict[str, float | None],
    settings: dict[str, Any],
    reading: dict[str, Any],
    motion_end_s: float | None,
    record_s: float,
) -> tuple[tuple[float, float], ...]:
    """Return the intervals, in s of the record, in which the skin was pressed at a constant force
    and nothing moved or slipped as a whole: the rest before the motion, and the time after it."""
    begins = begin_of(reading)
    if begins is None:
        return ()
    quiet = [(max(0.0, begins - float(settings.get("rest_s", 0.0)) + 0.02), begins)]
    slipped = times.get("ridge_slip_s") is not None or times.get("lift_off_s") is not None
    course_s = max(settings.get("force_times_s") or (0.0,))
    if motion_end_s is not None and not slipped:
        quiet.append((max(motion_end_s, begins + course_s) + SETTLED_S, record_s))
    return tuple((begin, end) for begin, end in quiet if end > begin)
