"""Estimates what a plan needs: time with its spread, disk space, and records that expire meanwhile.

Bench time is what the procedures expect of their points and of making ready
(`rig.run.procedure`), as progress and dry runs show it. Here are what comes to it between runs
and how sure all that is. The numbers below were measured by
`tests/benchmarks/bench_batch_plan.py`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from rig.batch.plan.conditions import BatchCondition, BatchPlan, PlannedRun
from rig.batch.plan.procedures import installed
from rig.batch.plan.settings import BatchSettings
from rig.batch.plan.window import does_not_fit, window
from rig.bench.apply_calibrations import records_of
from rig.bench.plan import BenchPlan
from rig.bench.settings import FixtureSettings
from rig.instruments.calibration import CalibrationRecord
from rig.run.checked_procedure import CheckedProcedure
from rig.run.points import Point
from rig.run.stopping import MAKING_SAFE_S

CONNECTING_S = 0.6
"""Time in s on a real bench from the end of a run to the beginning of the next (journal, guard,
connections), and the time that its links take within a run in excess of those of a simulated bench.
"""
RELATIVE = 0.03
"""Standard deviation of what is expected of a run, relative, the same for all runs: friction, the
film's noise, how fast the drives home."""
RANDOM_S = 0.15
"""Standard deviation of what differs from run to run, in s."""
RUN_B, POINT_B = 270_000, 15_000
"""Bytes of a run file without its points, and of a point without its samples."""
COUNTS_KEPT, NUMBERS_KEPT = 0.72, 0.85
"""Compressed size by size: of counts with their times, and of other numbers."""
ROWS_S = 1000.0
"""Rows a second of streams that are not the DAQ's: frames of the force sensor."""
UNIFORM = math.sqrt(12)
"""Width of a uniform distribution divided by its standard deviation."""


@dataclass(frozen=True)
class ExpectedRun:
    """Expected duration and size of one run of a condition."""

    duration_s: float
    common_s: float
    """Standard deviation of what is the same in all its runs: the place of the contact, say."""
    size_B: int
    """Size of its run file."""

    @property
    def spread_s(self) -> float:
        """Standard deviation of the duration of a single run."""
        return math.hypot(self.common_s, RANDOM_S)


@dataclass(frozen=True)
class PlacedRun:
    """A run of the queue and when it is expected to begin."""

    run: PlannedRun
    begins: datetime


@dataclass(frozen=True)
class ExpiringRecord:
    """A calibration record that will have expired when the batch is over."""

    path: Path
    record: CalibrationRecord


@dataclass(frozen=True)
class Forecast:
    """When a whole batch is expected to end, how large its files become, and what does not fit."""

    begins: datetime
    duration_s: float
    """Time from then to the end of the last run, rests included."""
    spread_s: float
    """Standard deviation of the duration."""
    size_B: int
    runs: tuple[PlacedRun, ...]
    stop_by: datetime | None
    in_time: int
    """Number of runs of the queue, from the first on, that are begun if all take what is expected:
    there is time for each by `stop_by`, with the same margin as when it is about to begin."""
    expiring: tuple[ExpiringRecord, ...]

    @property
    def ends(self) -> datetime:
        """Expected end of the last run, as if there were no `stop_by`."""
        return self.begins + timedelta(seconds=self.duration_s)


def expect(
    plan: BatchPlan, fixtures: Mapping[str, FixtureSettings], real: bool
) -> dict[str, ExpectedRun]:
    """Return the expected duration and size of a run of each condition. `fixtures` are the mounted
    fixtures by procedure. `real` is for a real bench, whose stages the run before has homed and
    parked."""
    return {
        name: _expected(condition, fixtures[condition.procedure], real)
        for name, condition in plan.conditions.items()
    }


def homing_s(plan: BatchPlan, fixtures: Mapping[str, FixtureSettings]) -> float:
    """Return the time in s that the first run on a real bench takes in addition to `expect`: its
    stages may have to be homed."""
    if not plan.runs:
        return 0.0
    condition = plan.conditions[plan.runs[0].condition]
    fixture = fixtures[condition.procedure]
    return _overhead_s(condition, fixture, False) - _overhead_s(condition, fixture, True)


def forecast(
    batch: BatchSettings,
    plan: BatchPlan,
    expected: Mapping[str, ExpectedRun],
    now: datetime,
    first_s: float = 0.0,
    bench: BenchPlan | None = None,
) -> Forecast:
    """Return the batch in time, were it begun `now`; `first_s` as of `homing_s`."""
    not_before, stop_by = window(batch, now)
    begins = now if not_before is None else max(now, not_before)
    durations = [
        plan.conditions[run.condition].rest_s + expected[run.condition].duration_s
        for run in plan.runs
    ]
    over_s = first_s + np.cumsum(durations, dtype=float)
    begun_s = [0.0, *over_s[:-1].tolist()]
    total_s = float(over_s[-1]) if len(durations) else 0.0
    common_s = math.fsum(expected[run.condition].common_s for run in plan.runs)
    spread_s = math.hypot(common_s, math.sqrt(len(durations)) * RANDOM_S)
    in_time = len(durations)
    for number, (run, end_s) in enumerate(zip(plan.runs, over_s.tolist(), strict=True)):
        takes_s = end_s + MAKING_SAFE_S
        if does_not_fit(begins, stop_by, takes_s, expected[run.condition].spread_s):
            in_time = number
            break
    ends = begins + timedelta(seconds=total_s + 2 * spread_s)
    return Forecast(
        begins=begins,
        duration_s=total_s,
        spread_s=spread_s,
        size_B=sum(expected[run.condition].size_B for run in plan.runs),
        runs=tuple(
            PlacedRun(run, begins + timedelta(seconds=since_s))
            for run, since_s in zip(plan.runs, begun_s, strict=True)
        ),
        stop_by=stop_by,
        in_time=in_time,
        expiring=tuple(
            ExpiringRecord(path, record)
            for _, path, record in (() if bench is None else records_of(bench))
            if now < record.valid_until <= ends
        ),
    )


def _expected(condition: BatchCondition, fixture: FixtureSettings, real: bool) -> ExpectedRun:
    points = _planned(condition).points()
    further_s = _planned(condition).refining_s()
    taking_s = math.fsum(point.duration_s for point in points) + further_s
    duration_s = taking_s + _overhead_s(condition, fixture, real) + (CONNECTING_S if real else 0.0)
    earliest, latest = (_overhead_s(condition, place, real) for place in _ends_of_contact(fixture))
    common_s = math.hypot((latest - earliest) / UNIFORM, RELATIVE * duration_s)
    return ExpectedRun(duration_s, common_s, _size_B(condition, points))


def _overhead_s(condition: BatchCondition, fixture: FixtureSettings, homed: bool) -> float:
    return _planned(condition).overhead_s(fixture, homed)


def _planned(condition: BatchCondition) -> CheckedProcedure:
    """Return the procedure of a condition, with its settings."""
    procedure = installed(condition.procedure)
    return CheckedProcedure(procedure(procedure.Settings.model_validate(condition.settings)))


def _ends_of_contact(fixture: FixtureSettings) -> tuple[FixtureSettings, FixtureSettings]:
    """Return the fixture as if the middle of where contact may be felt were its beginning, and its
    end."""
    first_mm, last_mm = fixture.contact_from_mm, fixture.contact_to_mm
    if first_mm is None or last_mm is None:
        return fixture, fixture
    farther_mm = 2 * last_mm - first_mm
    return (
        fixture.model_copy(update={"contact_to_mm": first_mm}),
        fixture.model_copy(update={"contact_to_mm": farther_mm}),
    )


def _size_B(condition: BatchCondition, points: Iterable[Point]) -> int:  # noqa: N802 - bytes
    """Return the size of a run file in bytes: every stream lasts as long as its points."""
    streams = installed(condition.procedure).streams
    size = float(RUN_B)
    for point in points:
        rate_S_s = max((a.rate_S_s for a in point.acquisitions), default=0.0)
        each_s = sum(
            len(stream.channels)
            * np.dtype(stream.dtype).itemsize
            * (rate_S_s * COUNTS_KEPT if stream.units == "count" else ROWS_S * NUMBERS_KEPT)
            for stream in streams
        )
        size += POINT_B + each_s * point.duration_s
    return round(size)
