"""A grip that answers an alarm: the held force rises at once, by a bounded step.

An alarm is an incipient slip that the detector reports while a motion is under way. Each raises the
set point by `regrip_step_percent` of the normal force, at most `regrip_times`: a detector that is
wrong, or alarms for ever, presses no harder than that. The highest set point is checked against the
force limit and z's way of braking before anything moves. Nothing is squeezed before the motion
begins and after it has ended, upon an alarm that came late, and where the force sensor does not
show the held force.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Literal

from pydantic import Field, model_validator
from pydantic.config import JsonDict

from procedures.pressed.record.squeeze import STALE_S, Squeeze
from procedures.pressed.settings import PressedSettings
from rig.files.journal.detections import NO_DETECTOR, SLIP

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    import numpy.typing as npt

    from procedures.pressed.axes import SentMove
    from procedures.pressed.record.trial_record import TrialRecord
    from rig.files.journal.detections import Detection
    from rig.run.context import Run
    from rig.run.points import Reading

BLIND_S = 0.05
"""Additional age in s of the latest force from which nothing is squeezed."""
SEEN_SHARE = 0.5
"""Share of the held force that the sensor has to show for a squeeze."""
RISEN = 0.1
"""Share of a step at which the force has begun to answer."""
BEFORE_S = 0.01
"""Stretch before a decision whose mean is the force that the rise is counted from."""

REGRIP_ONLY: JsonDict = {"only_with": {"regrip": True}}
"""Marks a field that has an effect with --regrip only."""


class GripSettings(PressedSettings):
    """Settings of a trial whose grip may answer alarms."""

    regrip: bool = False
    """Raise the normal force at once on each alarm of the detector during the motion."""
    regrip_step_percent: float = Field(default=20.0, gt=0, le=100, json_schema_extra=REGRIP_ONLY)
    """Step by which an alarm raises the normal force, in percent of --normal-force."""
    regrip_times: int = Field(default=5, ge=1, le=20, json_schema_extra=REGRIP_ONLY)
    """Largest number of steps in a trial; later alarms raise nothing."""
    regrip_on: Literal["alarm", "motion"] = Field(default="alarm", json_schema_extra=REGRIP_ONLY)
    """What raises the force: an alarm, by one step; or the beginning of the motion, by all steps
    and whatever is detected, for comparison."""

    @model_validator(mode="after")
    def _can_be_raised(self) -> GripSettings:
        if not self.regrip:
            return self
        if self.regrip_on == "alarm" and self.detector == NO_DETECTOR:
            raise ValueError("regrip_on alarm needs a detector, not none")
        if self.largest_held_N >= self.largest_force_N:
            raise ValueError(
                f"regrip_times {self.regrip_times} of regrip_step_percent "
                f"{self.regrip_step_percent:g} % raise {self.normal_force_N:g} N by up to "
                f"{self.most_raised_N:g} N, to {self.largest_held_N:g} N, which is not below "
                f"largest_force_N {self.largest_force_N:g} N; ask for fewer or smaller steps"
            )
        return self

    @property
    def usual_block_s(self) -> float:
        """See `PressedSettings`; an alarm that is answered comes at most a block late."""
        return 0.002 if self.alarms_answered else super().usual_block_s

    @property
    def alarms_answered(self) -> int:
        """See `PressedSettings`."""
        return self.regrip_times if self.regrip and self.regrip_on == "alarm" else 0

    @property
    def regrip_step_N(self) -> float:  # noqa: N802 - the unit keeps its capital, here and below
        """Step in N."""
        return self.regrip_step_percent / 100 * self.normal_force_N

    @property
    def most_raised_N(self) -> float:  # noqa: N802
        """All steps together in N; 0 without re-gripping."""
        return self.regrip_times * self.regrip_step_N if self.regrip else 0.0

    @property
    def largest_held_N(self) -> float:  # noqa: N802
        """See `PressedSettings`; with every step."""
        return self.normal_force_N + self.most_raised_N


class Grip:
    """Answers the alarms of one trial; called by the procedure's thread."""

    def __init__(self, run: Run, record: TrialRecord, squeeze: Callable[[float], SentMove]):
        """`squeeze` raises the set point by so many N at once."""
        self._run, self._record, self._squeeze = run, record, squeeze
        settings = run.settings
        self._settings: GripSettings | None = (
            settings if isinstance(settings, GripSettings) and settings.regrip else None
        )
        self._armed = self._warned = False
        self._sent: list[tuple[Squeeze, SentMove]] = []

    def begin(self, set_N: float) -> None:
        """Answer alarms from now on: the motion begins. `set_N` is the set point."""
        settings = self._settings
        self._armed = settings is not None
        if settings is not None and settings.regrip_on == "motion":
            self._armed = False
            self._raise(settings.most_raised_N, None, set_N)

    def end(self) -> None:
        """Answer no further alarm, and note what became of the squeezes."""
        self._armed = False
        begun_s = self._record.begun_s
        for squeeze, sent in self._sent:
            if sent.sent_s is not None:
                squeeze.sent_s = sent.sent_s - begun_s
            if sent.acknowledged_s is not None:
                squeeze.acknowledged_s = sent.acknowledged_s - begun_s

    def answer(self, one: Detection, set_N: float) -> None:
        """Raise the set point, `set_N` so far, if what was detected is an alarm that counts."""
        settings = self._settings
        if settings is None or not self._armed or one.kind != SLIP:
            return
        needless = self._needless(settings, one)
        if why := needless or self._prevented(one, set_N):
            self._record.unanswered.append(one.time_s)
            # What the grip would have held may be lost: the person has to know that it was not the
            # grip that failed. Once a trial: on a slow computer each alarm is late.
            level = "info" if needless or self._warned else "warning"
            self._warned |= not needless
            self._run.event(level, "no-squeeze", f"{self._record.point}: no squeeze: {why}")
            return
        self._raise(settings.regrip_step_N, one.time_s, set_N)

    def _needless(self, settings: GripSettings, one: Detection) -> str:
        """Return why an alarm is not to raise the force; "" where it is."""
        record = self._record
        if one.time_s < record.motion_from_s:
            return "the alarm came before the motion"
        if len(record.squeezes) >= settings.regrip_times:
            return f"all {settings.regrip_times} steps have been made (--regrip-times)"
        return ""

    def _prevented(self, one: Detection, set_N: float) -> str:
        """Return what is too late or too uncertain for the force to be raised; "" for nothing."""
        record, force = self._record, self._run.force
        age_s = self._run.clock.now() - record.begun_s - one.time_s
        if age_s > STALE_S:
            return f"the alarm came {age_s:.2g} s after its sample, more than {STALE_S:g} s"
        if force.older_s > BLIND_S:
            return f"the latest force is {force.older_s:.2g} s old"
        shown_N = float(force.mean_N(BEFORE_S)[2])
        if shown_N < SEEN_SHARE * set_N:
            return f"the force sensor shows {shown_N:.2g} N where {set_N:.3g} N are held"
        return ""

    def _raise(self, rise_N: float, sample_s: float | None, set_N: float) -> None:
        record = self._record
        self._run.check_watchers()  # what has tripped is made safe by now: no further order to z
        squeeze = Squeeze(sample_s, self._run.clock.now() - record.begun_s, set_N, set_N + rise_N)
        record.squeezes.append(squeeze)
        self._sent.append((squeeze, self._squeeze(rise_N)))
        because = "the motion begins" if sample_s is None else f"the alarm at {sample_s:.3f} s"
        self._run.event(
            "info",
            "squeeze",
            f"{record.point}: set point raised from {set_N:.3g} N to {set_N + rise_N:.3g} N at "
            f"{squeeze.decided_s:.4f} s, because of {because}",
        )


def note_rises(
    squeezes: list[Squeeze], times_s: npt.NDArray[np.float64], force_N: npt.NDArray[np.float64]
) -> None:
    """Note in each squeeze when the force (n,) at times (n,) had risen by `RISEN` of its step,
    counted from the mean before the decision."""
    for squeeze in squeezes:
        before = (times_s > squeeze.decided_s - BEFORE_S) & (times_s <= squeeze.decided_s)
        if not before.any():
            continue
        wanted_N = force_N[before].mean() + RISEN * (squeeze.to_N - squeeze.from_N)
        risen = (times_s > squeeze.decided_s) & (force_N >= wanted_N)
        squeeze.risen_s = float(times_s[risen][0]) if risen.any() else None


def grip_reading(record: TrialRecord) -> Reading:
    """Return the columns `GRIP` of the layout."""
    note_rises(record.squeezes, record.frame_times_s(), record.forces_N()[:, 0])
    within = record.alarms
    first = record.squeezes[0] if record.squeezes else None
    stages: Reading = {}
    for stage in ("decided", "sent", "acknowledged", "risen"):
        at_s = None if first is None else getattr(first, f"{stage}_s")
        since_s = None if first is None or first.sample_s is None else first.sample_s
        stages[f"squeeze_{stage}_s"] = None if at_s is None or since_s is None else at_s - since_s
    return {
        "alarms": float(len(within)),
        "first_alarm_s": within[0].time_s if within else None,
        "squeezes": float(len(record.squeezes)),
        "unanswered_alarms": float(len(record.unanswered)),
        **stages,
        "squeeze_record": json.dumps([asdict(one) for one in record.squeezes]),
    }
