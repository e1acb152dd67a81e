"""The output of a run: progress on stderr, the closing lines, ``--json`` on stdout."""

from __future__ import annotations

import signal
import sys
import traceback
from collections.abc import Mapping, Sequence, Set
from typing import TYPE_CHECKING, Any, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskID, TextColumn
from rich.text import Text

from rig.cli.outcome import log, print_json, say, say_all, say_failure, turning
from rig.core.entry_points import BrokenPackageError
from rig.core.text import in_shell, printable
from rig.core.units import counted, duration
from rig.figures.drawing import DrawingProcess, Drawn, LeaveOutError
from rig.run.checked_procedure import ProcedureFaultError
from rig.run.observers import HOLD, PAUSED, RUNNING, RunObserver
from rig.run.stopping import STOP_SIGNALS, WORDS

if TYPE_CHECKING:
    from pathlib import Path
    from types import FrameType

    from rig.run.outcome import RunOutcome
    from rig.run.points import Point, Reading
    from rig.run.procedure import Procedure


class _Eta(ProgressColumn):
    """Column of the progress bar with the estimated remaining time."""

    def render(self, task: Task) -> Text:
        """Return the cell of the progress bar."""
        left_s = task.time_remaining
        return Text("ETA …" if left_s is None else f"ETA {duration(left_s)}")


class ConsoleObserver(RunObserver):
    """Shows a progress bar on a terminal that can redraw one, else one plain line per point."""

    def __init__(self, procedure: type[Procedure], simulated: bool = False):
        self._procedure = procedure
        self._console = Console(stderr=True)
        self._bench_time = " of bench time" if simulated else ""
        self._progress: Progress | None = None
        self._task = TaskID(0)
        self._weights: Mapping[str, float] = {}
        self._interrupted = False
        """True if the run is paused or on hold."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._progress is not None:
            self._progress.stop()

    @property
    def observer_name(self) -> str:
        """Name of this observer in a warning."""
        return "the progress display"

    def planned(self, points: Sequence[Point], recorded: Set[str], overhead_s: float) -> None:
        """See `RunObserver`."""
        first_plan = not self._weights
        self._weights = {point.id: max(point.duration_s, 1e-3) for point in points}
        left_s = sum(w for name, w in self._weights.items() if name not in recorded)
        one, several = self._procedure.point_name
        to_do = len(points) - len(recorded)
        if not recorded:
            what = counted(to_do, one, several)
        elif first_plan:
            all_of_them = counted(len(points), one, several)
            what = f"resuming, {len(recorded)} of {all_of_them} done, {to_do} to go"
        else:
            what = (
                f"{counted(to_do, 'further ' + one, 'further ' + several)} ({len(recorded)} done)"
            )
        about = duration(left_s + overhead_s)
        self._say(f"{self._procedure.name}: {what}, about {about}{self._bench_time}")
        if self._progress is not None:  # The earlier plan is done.
            self._progress.stop()
        if self._console.is_terminal and not self._console.is_dumb_terminal:
            self._progress = Progress(
                TextColumn("{task.description}", markup=False),
                BarColumn(),
                TextColumn("{task.fields[done]}", markup=False),
                _Eta(),
                console=self._console,
                transient=True,
            )
            self._task = self._progress.add_task(self._procedure.name, total=left_s, done="")
            self._progress.start()

    def point_recorded(self, number: int, total: int, point: Point, reading: Reading) -> None:
        """See `RunObserver`."""
        done = f"{number}/{total} {point.id}"
        if self._progress is not None:
            weight = self._weights[point.id]
            self._progress.update(self._task, advance=weight, done=printable(done))
        else:
            self._say(done)

    def event(self, level: str, message: str) -> None:
        """See `RunObserver`."""
        self._say(message if level == "info" else f"{level}: {message}")

    def state(self, name: str) -> None:
        """Show that the run is paused or resumed; the signal's handler shows what a stop does."""
        if name == PAUSED:
            self._say("PAUSED (bench is safe). Ctrl-Z continues, Ctrl-C ends the run.")
        elif name == RUNNING and self._interrupted:
            self._say("Resumed.")
        if name in (PAUSED, HOLD, RUNNING):
            self._interrupted = name != RUNNING

    def saving(self) -> None:
        """See `RunObserver`."""
        if self._progress is not None:
            self._progress.stop()

    def _say(self, text: str) -> None:
        self._console.print(printable(text), markup=False, highlight=False, soft_wrap=True)


def finish(
    procedure: type[Procedure],
    outcome: RunOutcome,
    as_json: bool,
    drawing: DrawingProcess | None,
    debug: bool,
) -> None:
    """Report failures and warnings, the summary and, last, how the run ended and how to
    continue. `drawing` draws the figures; None for none."""
    for failure in outcome.failures:
        if outcome.status != "stopped":
            say_failure(failure, debug)
    _say_what_stayed_on(outcome)
    if outcome.taken_over is not None:
        say(outcome.taken_over.summary)
    drawn = Drawn()
    if drawing is not None and outcome.file is not None and outcome.points_done:
        drawn = _drawn(drawing, outcome, outcome.file)
    outcome.warnings.extend(drawn.warnings)
    for warning in outcome.warnings:
        log.warning("%s", warning)
        say(f"warning: {warning}")
    for trace in drawn.tracebacks:
        log.warning("%s", trace)
        if debug:
            say_all(trace)
    if as_json:
        print_json(as_object(outcome, [str(path) for path in drawn.files]))
    else:
        _report_summary(outcome)
    for line in closing_lines(procedure, outcome, drawn.files):
        say(line)


def _drawn(drawing: DrawingProcess, outcome: RunOutcome, file: Path) -> Drawn:
    """Draw the figures of a run. Where that takes its time, the person learns at once that the
    bench is safe and the data are saved; a signal ends the wait and not the run, which is over."""

    def slow() -> None:
        state = f"{_bench_state(outcome, nothing_done=True)}. " if outcome.made_safe else ""
        say(f"{state}Saved: {file}. Drawing the figures (Ctrl-C leaves them out) ...")

    stops: list[int] = []

    def leave_out(number: int, frame: FrameType | None) -> None:
        stops.append(number)
        if len(stops) == 1:  # a second one must not cost the closing lines
            raise LeaveOutError(f"stopped by {WORDS[signal.Signals(number)]}")

    before = {number: signal.signal(number, leave_out) for number in STOP_SIGNALS}
    try:
        with turning("drawing the figures"):
            return drawing.draw(file, slow)
    except LeaveOutError as error:  # before the drawing began, or after its end
        return Drawn(warnings=(f"it is not known whether figures were drawn: {error.message}",))
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _say_what_stayed_on(outcome: RunOutcome) -> None:
    for off in outcome.off_failures:
        say(f"error: NOT SAFE: {off.name} could not be switched off: {off.reason}")


def _report_summary(outcome: RunOutcome) -> None:
    """Report the results in brief; the file's path goes to stdout for a program that reads it. A
    person at a terminal sees it in the closing lines."""
    shown = outcome.in_brief if outcome.points_done else ()
    if shown:
        scattered = any(" ± " in line for line in shown) and "trials" in outcome.summary
        say("Results (mean ± standard deviation):" if scattered else "Results:")
    for line in shown:
        say(f"  {line}")
    if outcome.file is not None and not sys.stdout.isatty():
        print(outcome.file, flush=True)  # noqa: T201 - stdout carries data


def finish_dry_run(
    procedure: type[Procedure], outcome: RunOutcome, as_json: bool, debug: bool
) -> None:
    """Report the result of a dry run: whether the procedure works, and how long it takes.

    The traceback of a fault in another package is shown, since a dry run leaves no log.
    """
    for failure in outcome.failures:
        fault = isinstance(failure, (ProcedureFaultError, BrokenPackageError)) and failure.__cause__
        if fault and isinstance(failure, ProcedureFaultError):
            failure.hint = "the traceback is on stderr; report it to whoever maintains the package"
        say_failure(failure, debug)
        if fault and not debug:
            traceback.print_exception(fault)
    _say_what_stayed_on(outcome)
    for warning in outcome.warnings:
        say(f"warning: {warning}")
    say(
        f"Dry run {_ending(outcome)}: {_done(procedure, outcome)} in "
        f"{duration(outcome.duration_s)} of bench time on the simulated bench; nothing was saved."
    )
    if as_json:
        shown = as_object(outcome, []) | {"file": None, "journal": None, "dry_run": True}
        print_json(shown)


def closing_lines(
    procedure: type[Procedure], outcome: RunOutcome, drawn: Sequence[Path]
) -> list[str]:
    """Return lines on how the run ended, where its data are, the state of the bench, and how to
    continue."""
    ended = _ending(outcome)
    if not _has_begun(outcome):
        return [f"{ended[0].upper()}{ended[1:]}: the run did not begin, nothing was recorded."]
    lines = [f"{ended[0].upper()}{ended[1:]}: {_done(procedure, outcome)}"]
    if outcome.points_earlier:
        lines[0] += f", {outcome.points_earlier} of them earlier"
    if outcome.duration_s:
        lines[0] += "," if outcome.points_earlier else ""
        lines[0] += f" in {duration(outcome.duration_s)}"
        lines[0] += " of bench time" if outcome.simulated else ""
        lines[0] += " since the resume" if outcome.points_earlier else ""
    lines[0] += " (simulated)." if outcome.simulated else "."
    if outcome.file is not None:
        pictures = len({path.with_suffix("") for path in drawn})
        figures = f" and {counted(pictures, 'figure')} (PNG and SVG)" if drawn else ""
        lines.append(f"Saved: {outcome.file}{figures}")
    if outcome.made_safe:
        lines.append(f"{_bench_state(outcome)}: {', '.join(outcome.made_safe)}.")
    elif outcome.armed:
        if outcome.safe or outcome.off_failures or outcome.left:
            lines.append(f"{_bench_state(outcome, nothing_done=True)}.")
    elif outcome.own_bench:
        lines.append("Bench is safe: there was nothing to switch off.")
    else:  # An earlier run may have left something pressed.
        lines.append("Bench is unchanged: there was nothing to switch off.")
    if outcome.journal is not None and outcome.file is None:
        lines.append(f"Recover the run file with: rig recover {in_shell(outcome.journal)}")
    elif outcome.journal is not None and _resumes(outcome):
        not_safe = outcome.off_failures and not _guard_made_safe(outcome)
        resume = "Once the bench is safe, resume with" if not_safe else "Resume with"
        lines.append(f"{resume}: rig resume {in_shell(outcome.journal)}")
    return lines


def _resumes(outcome: RunOutcome) -> bool:
    """Return whether `rig resume` can take the points that are left."""
    return (
        outcome.journal is not None
        and outcome.file is not None
        and outcome.points_done < outcome.points_planned
    )


def _has_begun(outcome: RunOutcome) -> bool:
    """Return whether a run has a journal, a file or points, also of an earlier attempt, or has
    armed anything."""
    recorded = outcome.journal or outcome.file or outcome.points_done
    return bool(recorded or outcome.made_safe)


def _ending(outcome: RunOutcome) -> str:
    if outcome.status == "stopped" and outcome.failures:
        return outcome.failures[0].message
    return {"complete": "finished", "stopped": "stopped", "failed": "failed"}[outcome.status]


def _done(procedure: type[Procedure], outcome: RunOutcome) -> str:
    planned = counted(outcome.points_planned, *procedure.point_name)
    return f"{outcome.points_done} of {planned}"


def _bench_state(outcome: RunOutcome, nothing_done: bool = False) -> str:
    """Return how the bench was left, as the beginning of a sentence that names what was done; as a
    whole one where `nothing_done`, because no shutdown action has worked or none was needed."""
    if outcome.off_failures and _guard_made_safe(outcome):
        text, before_list = "Bench was made safe by the guard (see above)", "; before"
    elif outcome.off_failures:
        text, before_list = "Bench is NOT safe (see above)", "; done"
    elif outcome.left:
        found = " and ".join(outcome.left)
        then = "you resume" if _resumes(outcome) else "the next run"
        text = f"Bench is stopped, but {found} (see above): check stage_z before {then}"
        before_list = "; done"
    else:
        is_safe = "Bench is safe" if outcome.safe else "Bench is stopped, but check it (see above)"
        text, before_list = is_safe, ""
    return text if nothing_done else text + before_list


def _guard_made_safe(outcome: RunOutcome) -> bool:
    return outcome.taken_over is not None and outcome.taken_over.safe


def as_object(outcome: RunOutcome, figures: list[str]) -> dict[str, Any]:
    """Return the object that ``--json`` prints."""
    return {
        "file": None if outcome.file is None else str(outcome.file),
        "journal": None if outcome.journal is None else str(outcome.journal),
        "outcome": outcome.status,
        "exit": int(outcome.code),
        "simulated": outcome.simulated,
        "points_planned": outcome.points_planned,
        "points_done": outcome.points_done,
        "duration_s": outcome.duration_s,
        "holds": outcome.holds,
        "presses": outcome.presses,
        "summary": dict(outcome.summary),
        "errors": [failure.one_line() for failure in outcome.failures]
        + [f"{off.name} not switched off: {off.reason}" for off in outcome.off_failures],
        "warnings": outcome.warnings,
        "figures": figures,
    }
