"""The forecast of a batch (`rig batch plan`) and the JSON schema of its file."""

from __future__ import annotations

import json
import shutil
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.cli.options.shared import AsJson, BatchBench, BatchPath, Debug
from rig.cli.outcome import print_json, reported, say
from rig.core.units import counted, time_span

if TYPE_CHECKING:
    from collections.abc import Iterator

    from rig.batch.execute.prepare import PreparedBatch
    from rig.batch.plan.estimate import PlacedRun


def plan(
    file: BatchPath,
    bench: BatchBench = None,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Check a batch file and list its runs.

    Shows when each run begins, the total time and the disk space.
    """
    with reported(debug, as_json):
        from rig.batch.execute.prepare import prepare

        prepared = prepare(file, bench, datetime.now().astimezone(), say)
        free_B = shutil.disk_usage(_existing(Path(prepared.batch.batch.results))).free
        if as_json:
            print_json(as_object(prepared, free_B))
            return
        for line in _table(prepared):
            print(line)  # noqa: T201 - stdout carries data
        for line in _summary(prepared, free_B):
            say(line)


def schema() -> None:
    """Print the JSON schema of batch files.

    It includes the settings of the installed procedures.
    """
    from rig.batch.plan.schema import batch_schema

    print(json.dumps(batch_schema(lambda text: say(f"warning: {text}")), indent=2))  # noqa: T201 - stdout carries data


def as_object(prepared: PreparedBatch, free_B: int) -> dict[str, Any]:
    """Return the object that ``--json`` prints."""
    forecast, expected = prepared.forecast, prepared.expected
    return {
        "name": prepared.batch.batch.name,
        "bench": None if prepared.bench is None else str(prepared.bench),
        "begins": forecast.begins.isoformat(timespec="seconds"),
        "ends": forecast.ends.isoformat(timespec="seconds"),
        "duration_s": forecast.duration_s,
        "spread_s": forecast.spread_s,
        "stop_by": None if forecast.stop_by is None else forecast.stop_by.isoformat(),
        "runs_in_time": forecast.in_time,
        "disk_B": forecast.size_B,
        "free_B": free_B,
        "expiring": [
            {"file": str(one.path), "valid_until": one.record.valid_until.isoformat()}
            for one in forecast.expiring
        ],
        "conditions": {
            name: {
                "experiment": condition.experiment + 1,
                "procedure": condition.procedure,
                "reference": condition.reference,
                "varied": dict(condition.varied),
                "settings": dict(condition.settings),
                "rest_s": condition.rest_s,
                "duration_s": expected[name].duration_s,
                "spread_s": expected[name].spread_s,
                "disk_B": expected[name].size_B,
            }
            for name, condition in prepared.plan.conditions.items()
        },
        "runs": [
            {
                "number": placed.run.number,
                "condition": placed.run.condition,
                "repeat": placed.run.repeat,
                "begins": placed.begins.isoformat(timespec="seconds"),
            }
            for placed in forecast.runs
        ],
    }


def _table(prepared: PreparedBatch) -> Iterator[str]:
    """Yield a heading, then one line a run: number, begin, condition, repeat, expected duration,
    what is varied."""
    width = max(map(len, ("condition", *prepared.plan.conditions)))
    digits = max(len("run"), len(str(len(prepared.plan.runs))))
    yield f"{'run':>{digits}} {'begins (local)':14} {'condition':{width}} repeat  duration  varied"
    for placed in prepared.forecast.runs:
        yield _line(prepared, placed, digits, width)


def _line(prepared: PreparedBatch, placed: PlacedRun, digits: int, width: int) -> str:
    run = placed.run
    condition = prepared.plan.conditions[run.condition]
    varied = " ".join(f"{name}={_shown(value)}" for name, value in condition.varied.items())
    if condition.reference:
        varied = "reference"
    duration_s = prepared.expected[run.condition].duration_s
    return (
        f"{run.number:>{digits}} {_local(placed.begins)[5:]} {run.condition:{width}} "
        f"{run.repeat:>6} {duration_s:7.1f} s  {varied}"
    ).rstrip()


def _shown(value: Any) -> str:
    if isinstance(value, list):
        return ",".join(_shown(item) for item in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def _summary(prepared: PreparedBatch, free_B: int) -> Iterator[str]:
    forecast = prepared.forecast
    name, runs = prepared.batch.batch.name, len(prepared.plan.runs)
    yield (
        f"{name}: {counted(runs, 'run')} ({counted(len(prepared.plan.conditions), 'condition')}), "
        f"about {time_span(forecast.duration_s)} ± {time_span(forecast.spread_s)}, "
        f"from {_local(forecast.begins)} to {_local(forecast.ends)} local time"
    )
    yield f"disk: about {_size(forecast.size_B)} of run files, {_size(free_B)} free"
    if forecast.size_B > free_B:
        yield "warning: the disk is too small: free space, or choose another folder for results"
    if forecast.stop_by is not None:
        stop_by = f"stop_by {_local(forecast.stop_by)} local time"
        if forecast.in_time < runs:
            from rig.batch.plan.window import how_to_continue

            yield (
                f"warning: {stop_by}: {forecast.in_time} of {counted(runs, 'run')} will have ended "
                f"by then; {how_to_continue(prepared.batch.batch)}"
            )
        else:
            yield f"{stop_by}: {runs} of {counted(runs, 'run')} will have ended by then"
    for one in forecast.expiring:
        allowed = prepared.batch.batch.allow_expired
        then = "it will be used all the same" if allowed else "later runs will be held"
        yield (
            f"warning: {one.path}: the calibration of {one.record.sensor!r} expires on "
            f"{one.record.valid_until.astimezone():%Y-%m-%d %H:%M} local time, "
            f"during the batch: {then}; calibrate before it begins"
        )


def _size(size_B: float) -> str:
    for unit in ("B", "kB", "MB"):
        if size_B < 1000:
            return f"{size_B:.3g} {unit}"
        size_B /= 1000
    return f"{size_B:.3g} GB"


def _local(instant: datetime) -> str:
    """Return an instant as a clock here shows it on that day."""
    return f"{instant.astimezone():%Y-%m-%d %H:%M:%S}"


def _existing(folder: Path) -> Path:
    """Return the folder, or the nearest one around it that exists."""
    folder = folder.absolute()
    while not folder.exists():
        folder = folder.parent
    return folder
