"""What a person sees of a run: progress on stderr, the closing lines, ``--json`` on stdout."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Self

from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)

from rig.cli.outcome import say, tell_failure
from rig.core.units import duration
from rig.figures.drawing import Drawn, draw_in_child

if TYPE_CHECKING:
    from pathlib import Path

    from rig.run.outcome import Outcome
    from rig.run.points import Point, Reading
    from rig.run.procedure import Procedure


class ConsoleReporter:
    """Progress with time left on a terminal, one plain line a point where it is none."""

    def __init__(self, name: str):
        self._console = Console(stderr=True)
        self._name = name
        self._progress: Progress | None = None
        self._task = TaskID(0)
        self._weights: Mapping[str, float] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._progress is not None:
            self._progress.stop()

    def planned(self, points: tuple[Point, ...], kept: set[str], overhead_s: float) -> None:
        """The run has these points, of which some were kept by an earlier attempt; bench time
        that goes into making ready and parking."""
        self._weights = {point.id: max(point.duration_s, 1e-3) for point in points}
        left = sum(w for name, w in self._weights.items() if name not in kept)
        self._say(
            f"{self._name}: {len(points) - len(kept)} points to take"
            + (f", {len(kept)} kept before" if kept else "")
            + f", about {duration(left + overhead_s)} of bench time"
        )
        if self._progress is not None:  # a plan before this one is done
            self._progress.stop()
        if self._console.is_terminal:
            self._progress = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                TextColumn("{task.fields[done]}"),
                TextColumn("left"),
                TimeRemainingColumn(),
                console=self._console,
                transient=True,
            )
            self._task = self._progress.add_task(self._name, total=left, done="")
            self._progress.start()

    def point_kept(self, number: int, total: int, point: Point, reading: Reading) -> None:
        """Point `number` of `total` is in the journal."""
        if self._progress is not None:
            self._progress.update(
                self._task, advance=self._weights[point.id], done=f"{number}/{total} {point.id}"
            )
        else:
            self._say(f"{number}/{total} {point.id}")

    def event(self, level: str, message: str) -> None:
        """Something a person should see now."""
        self._say(f"{level}: {message}")

    def storing(self) -> None:
        """The bench is safe; the data are being brought into their file."""
        if self._progress is not None:
            self._progress.stop()

    def stored(self, run_file: Path) -> None:
        """They are there."""

    def _say(self, text: str) -> None:
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)


def finish(
    procedure: Procedure, outcome: Outcome, as_json: bool, figures: bool, debug: bool
) -> None:
    """Failures, figures, what was done to the bench, where the data are and, last, how to go on."""
    for failure in outcome.failures:
        if outcome.status != "stopped":
            tell_failure(failure, debug)
    for off in outcome.off_failures:
        say(f"error: NOT SAFE: {off.name} could not be switched off: {off.reason}")
    if outcome.taken_over is not None:
        say(outcome.taken_over.told)
    drawn = Drawn()
    if figures and outcome.file is not None and outcome.points_done:
        drawn = draw_in_child(outcome.file)
    outcome.warnings.extend(drawn.warnings)
    for warning in outcome.warnings:
        say(f"warning: {warning}")
    for figure in drawn.files:
        say(f"figure: {figure}")
    if as_json:
        print(json.dumps(as_object(outcome, [str(path) for path in drawn.files])))  # noqa: T201 - stdout carries data
    else:
        _tell_summary(outcome)
    say(closing_line(procedure.NAME, outcome))


def _tell_summary(outcome: Outcome) -> None:
    for name, value in outcome.summary.items():
        if isinstance(value, list) and all(isinstance(item, str) for item in value):
            for sentence in value:
                say(f"  {sentence}")
        elif isinstance(value, list):
            say(f"  {name}: {', '.join(f'{item:.6g}' for item in value)}")
        elif not isinstance(value, dict):  # tables are for --json
            say(f"  {name}: {value:.6g}" if isinstance(value, float) else f"  {name}: {value}")
    if outcome.file is not None:
        print(outcome.file, flush=True)  # noqa: T201 - stdout carries data


def finish_dry_run(outcome: Outcome, as_json: bool) -> None:
    """What a rehearsal found: whether it works, and how long it takes."""
    for failure in outcome.failures:
        tell_failure(failure)
    say(
        f"dry run: {outcome.points_done} of {outcome.points_planned} points in "
        f"{duration(outcome.duration_s)} of bench time on the simulated bench; "
        "nothing was recorded"
    )
    if as_json:
        shown = as_object(outcome, []) | {"file": None, "journal": None, "dry_run": True}
        print(json.dumps(shown))  # noqa: T201 - stdout carries data


def closing_line(name: str, outcome: Outcome) -> str:
    """One line: how it ended, what was switched off, what is kept, how to go on."""
    marker = "SIMULATED " if outcome.simulated else ""
    ended = {"complete": "complete", "stopped": "stopped", "failed": "failed"}[outcome.status]
    if outcome.status == "stopped" and outcome.failures:
        ended = outcome.failures[0].message
    parts = [f"{marker}{name}: {ended}"]
    if outcome.switched_off:
        parts.append(f"switched off: {', '.join(outcome.switched_off)}")
    parts.append(
        f"{outcome.points_done} of {outcome.points_planned} points kept"
        + (f" in {outcome.file}" if outcome.file else "")
    )
    if outcome.duration_s:
        parts.append(f"{duration(outcome.duration_s)} of bench time")
    if outcome.journal is not None and outcome.file is None:
        parts.append(f"recover with: rig recover {outcome.journal}")
    elif outcome.journal is not None and outcome.points_done < outcome.points_planned:
        parts.append(f"resume with: rig resume {outcome.journal}")
    return "; ".join(parts)


def as_object(outcome: Outcome, figures: list[str]) -> dict[str, Any]:
    """The object that ``--json`` prints."""
    return {
        "file": None if outcome.file is None else str(outcome.file),
        "journal": None if outcome.journal is None else str(outcome.journal),
        "outcome": outcome.status,
        "exit": int(outcome.code),
        "simulated": outcome.simulated,
        "points_planned": outcome.points_planned,
        "points_done": outcome.points_done,
        "duration_s": outcome.duration_s,
        "summary": dict(outcome.summary),
        "errors": [failure.one_line() for failure in outcome.failures]
        + [f"{off.name} not switched off: {off.reason}" for off in outcome.off_failures],
        "warnings": outcome.warnings,
        "figures": figures,
    }
