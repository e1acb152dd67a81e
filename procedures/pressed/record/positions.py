"""Positions polled under way, as rows of the record, each with its age.

Axes are polled over links of their own, and one of them may answer late. A row is added when any
of them has answered; the others' values in it are those of their latest looks, and the stream
``ages`` has the time that has passed since each of these (decision 0073).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from procedures.pressed.record.force import BLOCK_S

if TYPE_CHECKING:
    from procedures.pressed.axes import Look, PolledAxis, PolledStage
    from procedures.pressed.record.trial_record import TrialRecord
    from rig.run.context import Run


@dataclass(frozen=True)
class AxisRows:
    """The values that a further axis adds to every row of positions, in a stream of its own."""

    axis: PolledAxis
    stream: str
    units: str
    rows: list[Any]
    """The trial's rows: time since the record began, then the stream's channels."""
    latest: Callable[[], tuple[Look, tuple[float, ...]]]
    """The latest look at the axis, and the channels' values in it."""


class LookWatch:
    """Notes in a trial's record for how long an axis in motion has not been seen."""

    def __init__(self, record: TrialRecord):
        self._record = record
        self._moves_since_s: dict[str, float] = {}
        """Since when each axis in motion has been polled, by its role."""

    def note(self, axes: Iterable[PolledAxis], now_s: float, every_s: float) -> None:
        """Note how old the latest look at each axis is at a tick: from its question on, since an
        answer that comes late may say where the axis was then. `every_s` is the time from one look
        to the next."""
        for axis in axes:
            if not axis.in_motion:
                self._moves_since_s.pop(axis.role, None)
                continue
            since_s = self._moves_since_s.setdefault(axis.role, now_s)
            if self._record.moves:
                unseen_s = now_s - max(axis.looked.asked_s, since_s)
                self._record.note_unseen(axis.role, unseen_s, every_s)


class PositionRecorder:
    """Records where the axes were when they were last polled, in blocks of `BLOCK_S`."""

    def __init__(self, run: Run, record: TrialRecord, z: PolledStage, x: PolledStage):
        self._run, self._record, self._z, self._x = run, record, z, x
        self._further: list[AxisRows] = []
        self._recorded_rows = 0
        self._latest_row_s = -math.inf
        """Time on the run's clock of the latest look in the latest row."""

    def add(self, rows: AxisRows) -> None:
        """Record a further axis, row by row with the stages."""
        self._further.append(rows)

    def add_row(self) -> None:
        """Add a row with the positions of the axes, unless none has been looked at since the row
        before."""
        # Taken once: a link's worker replaces `latest` at any time.
        z, x = self._z.latest, self._x.latest
        further = [(axis.rows, *axis.latest()) for axis in self._further]
        looked_s = [look.at_s for look in (z, x, *(look for _, look, _ in further))]
        latest_s = max(looked_s)
        if latest_s <= self._latest_row_s:
            return
        self._latest_row_s = latest_s
        since_s, position = latest_s - self._record.begun_s, self._record.position
        for rows, _, values in further:
            rows.append((since_s, *values))
        self._record.ages_s.append(tuple(latest_s - at_s for at_s in looked_s))
        position.append((since_s, z.position_mm, x.position_mm, z.commanded_mm, x.commanded_mm))
        if since_s - position[self._recorded_rows][0] >= BLOCK_S:
            self.record_rows()

    def record_rows(self) -> None:
        """Record the rows that are not recorded yet."""
        first, rows = self._recorded_rows, np.array(self._record.position[self._recorded_rows :])
        if not len(rows):
            return
        self._recorded_rows += len(rows)
        streams, ages_s = self._run.streams, np.array(self._record.ages_s[first:])
        streams.record_rows("ticks", first, rows[:, :1], None, units="s")
        streams.record_rows("position", first, rows[:, 1:], None, units="mm")
        streams.record_rows("ages", first, ages_s, None, units="s")
        for further in self._further:
            values = np.array(further.rows[first:])[:, 1:]
            streams.record_rows(further.stream, first, values, None, units=further.units)
