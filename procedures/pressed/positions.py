"""Positions polled under way, as rows of the record."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from procedures.pressed.force import BLOCK_S

if TYPE_CHECKING:
    from procedures.pressed.axes import PolledAxis, PolledStage
    from procedures.pressed.reading import TrialRecord
    from rig.run.context import Run


@dataclass(frozen=True)
class AxisRows:
    """The values that a further axis adds to every row of positions, in a stream of its own."""

    axis: PolledAxis
    stream: str
    units: str
    rows: list[Any]
    """The trial's rows: time since the record began, then the stream's channels."""
    latest: Callable[[], tuple[float, ...]]
    """The channels' values as they were polled last."""


class PositionRecorder:
    """Records where the axes were when they were last polled, in blocks of `BLOCK_S`."""

    def __init__(self, run: Run, record: TrialRecord, z: PolledStage, x: PolledStage):
        self._run, self._record, self._z, self._x = run, record, z, x
        self._further: list[AxisRows] = []
        self._recorded_rows = 0
        self._latest_row_s = -math.inf
        """Time on the run's clock of the latest poll of the axes in the latest row."""

    def add(self, rows: AxisRows) -> None:
        """Record a further axis, row by row with the stages."""
        self._further.append(rows)

    def add_row(self) -> None:
        """Add a row with the positions of the axes, unless none has been polled since the row
        before."""
        polled_s = max(axis.polled_s for axis in (self._z, self._x, *self._axes()))
        if polled_s <= self._latest_row_s:
            return
        self._latest_row_s = polled_s
        since_s = polled_s - self._record.begun_s
        for further in self._further:
            further.rows.append((since_s, *further.latest()))
        z, x, position = self._z.latest, self._x.latest, self._record.position
        position.append((since_s, z.position_mm, x.position_mm, z.commanded_mm, x.commanded_mm))
        if since_s - position[self._recorded_rows][0] >= BLOCK_S:
            self.record_rows()

    def record_rows(self) -> None:
        """Record the rows that are not recorded yet."""
        first, rows = self._recorded_rows, np.array(self._record.position[self._recorded_rows :])
        if not len(rows):
            return
        self._recorded_rows += len(rows)
        self._run.record_rows("ticks", first, rows[:, :1], None, units="s")
        self._run.record_rows("position", first, rows[:, 1:], None, units="mm")
        for further in self._further:
            values = np.array(further.rows[first:])[:, 1:]
            self._run.record_rows(further.stream, first, values, None, units=further.units)

    def _axes(self) -> list[PolledAxis]:
        return [further.axis for further in self._further]
