"""The status of a batch, read from its queue alone: any process may ask at any time."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from rig.batch.folder import BatchFolder
from rig.batch.plan.policy import TAKE_AGAIN, reason_to_end, remedy_at_the_end
from rig.batch.plan.settings import BatchFile
from rig.batch.plan.window import how_to_continue, window
from rig.batch.queue_records import HOLDS, PRESSES, TIME_OVER, RemainingWork, RunRow, RunState
from rig.batch.queue_view import QueueView
from rig.batch.report.heartbeat import read_heartbeat
from rig.bench.plan import read_bench
from rig.core.errors import RigError
from rig.core.text import in_shell, readable_time
from rig.core.units import counted, time_span
from rig.run.locks.bench_mark import read_marks
from rig.run.locks.lock import address_names

ENDS = ("complete", "stopped", "failed", "rebuilt")
"""First words of the states in which nothing of a batch is at work."""
LATEST = 5
"""Number of the latest failures and events that are shown."""


@dataclass(frozen=True)
class BatchStatus:
    """The progress of a batch, as `rig batch status` shows it."""

    folder: BatchFolder
    name: str
    simulated: bool
    """True if its runs are on benches that it starts for itself, in virtual time."""
    state: str
    running: bool
    """True if its supervisor is at work."""
    counts: dict[RunState, int]
    remaining: RemainingWork
    unprocessed: int
    """Finished runs whose files are still to be made: run file, detector's results or figures."""
    not_compiled: int
    """Those of them that have not even a run file."""
    bench_s: float
    holds: int
    """Holds of all runs so far; a pause by a person is none."""
    presses: int
    """Number of presses of the object in all runs; of the run under way, up to its latest hold."""
    current: RunRow | None
    failures: list[RunRow]
    invalid: int
    """Number of runs that are done and have invalid points."""
    latest_invalid: list[RunRow]
    events: list[tuple[str, str, str]]
    now: datetime
    bench_warnings: tuple[str, ...] = ()
    """Warnings about the bench of the bench file from an earlier run: not safe, or still
    pressed."""
    to_make_safe: str = ""
    """What to do about that bench before anything can be continued; empty for nothing."""
    instead: str = ""
    """What to do about the remaining runs where a mere resume takes none of them: `stop_by` has a
    date and leaves no time for them, or a stop condition is met; else empty."""

    @property
    def finish(self) -> datetime:
        """Expected end if the batch continues as planned from now on."""
        return (self.now + timedelta(seconds=self.remaining.bench_s)).astimezone()

    def as_object(self) -> dict[str, Any]:
        """Return the object that ``--json`` prints."""
        return {
            "folder": str(self.folder.path),
            "name": self.name,
            "bench_warnings": list(self.bench_warnings),
            "simulated": self.simulated,
            "state": self._state(),
            "running": self.running,
            "runs": dict(self.counts),
            "left_s": self.remaining.bench_s,
            "left_spread_s": self.remaining.spread_s,
            "bench_s": self.bench_s,
            "holds": self.holds,
            "presses": self.presses,
            "unprocessed": self.unprocessed,
            "finish": self.finish.isoformat(timespec="seconds"),
            "run": None if self.current is None else self.current.number,
            "condition": None if self.current is None else self.current.condition,
            "failures": [
                {"run": r.number, "condition": r.condition, "code": r.code, "reason": r.reason}
                for r in self.failures
            ],
            "runs_with_invalid_points": self.invalid,
            "latest_invalid": [
                {"run": r.number, "condition": r.condition, "valid": r.doubt}
                for r in self.latest_invalid
            ],
            "events": [{"time": t, "level": lv, "text": x} for t, lv, x in self.events],
        }

    def lines(self) -> list[str]:
        """Return the lines that a person reads."""
        total = sum(self.counts.values())
        marker = "SIMULATED " if self.simulated else ""
        shown = [f"warning: {text}" for text in self.bench_warnings]
        shown.append(f"{marker}batch {self.name}: {self._state()} ({self.folder.path})")
        parts = [f"{self.counts['done']} of {counted(total, 'run')} done"]
        parts += [
            f"{n} {_in_words(state)}" for state, n in self.counts.items() if n and state != "done"
        ]
        shown.append(", ".join(parts))
        if self.current is not None and self.running:
            run = self.current
            again = f", attempt {run.attempts}" if run.attempts > 1 else ""
            shown.append(f"run {run.number}: {run.condition}{again}")
        if self.remaining.runs:
            spread = f" ± {time_span(self.remaining.spread_s)}" if self.remaining.spread_s else ""
            ends = f", until {self.finish.isoformat(' ', 'minutes')}" if self._real_time else ""
            shown.append(f"remaining: {time_span(self.remaining.bench_s)}{spread}{ends}")
        shown.append(
            f"used by runs: {time_span(self.bench_s)} of bench time, rests and holds not included"
        )
        if self.presses or self.holds:
            shown.append(f"so far: {self._holds_and_presses()}")
        if self.running:
            if self.unprocessed:
                shown.append(f"making the files of {counted(self.unprocessed, 'run')}")
        else:
            shown += self._files_to_make()
        shown += [f"failed: run {r.number} {r.condition}: {r.reason}" for r in self.failures]
        shown += self._invalid_points()
        shown += [f"{readable_time(time)} {level}: {text}" for time, level, text in self.events]
        return shown if self.running else [*shown, *self.to_continue()]

    def closing_lines(self, bench: str) -> list[str]:
        """Return the lines with which the command ends that has run the batch. `bench` says how the
        latest run left its bench, as a sentence; empty where that is not known."""
        shown = [f"warning: {text}" for text in self.bench_warnings]
        shown += [f"failed: run {r.number} {r.condition}: {r.reason}" for r in self.failures]
        shown += self._invalid_points()
        if self.presses or self.holds:
            shown.append(f"in all runs: {self._holds_and_presses()}")
        shown += self._files_to_make()
        ended, _, why = self.state.partition(": ")
        ended = {"complete": "Finished"}.get(ended, f"{ended[:1].upper()}{ended[1:]}")
        done = f"{self.counts['done']} of {counted(sum(self.counts.values()), 'run')}"
        lost = [
            f"{n} {_in_words(state)}"
            for state in ("failed", "set-aside")
            if (n := self.counts[state])
        ]
        time = ""
        if self.bench_s:
            time = f"{',' * bool(lost)} in {time_span(self.bench_s)}"
            time += " of bench time" if self.simulated else ""
        time += " (simulated)" if self.simulated else ""
        reason = f": {why}" if why else "."
        shown.append(f"{ended}: {', '.join([done, *lost])}{time}{reason}")
        shown.append(f"Saved: {self.folder.path}")
        if bench:
            shown.append(bench)
        unsafe = self.to_make_safe or "NOT safe" in bench
        for line in self.to_continue():
            first = unsafe and line != self.to_make_safe
            shown.append(
                f"Once the bench is safe, {line}" if first else f"{line[0].upper()}{line[1:]}"
            )
        return shown

    def to_continue(self) -> list[str]:
        """Return what to do about a batch that is not running, one instruction a line, without a
        capital; empty where nothing is left to do."""
        resume = self.folder.resume_command
        steps = [self.to_make_safe] if self.to_make_safe else []
        if self.remaining.runs and self.instead:
            files = [f"make the missing files with: {resume}"] if self.unprocessed else []
            return [*steps, self.instead, *files]
        if self.remaining.runs or self.unprocessed:
            steps.append(f"continue with: {resume}")
        if (self.counts["failed"] or self.counts["set-aside"]) and self.instead in ("", TAKE_AGAIN):
            steps.append(f"take failed and left-out runs again with: {resume} --retry-failed")
        return steps

    def _invalid_points(self) -> list[str]:
        """Return lines on the runs that are done and have invalid points."""
        shown = [
            f"invalid: run {r.number} {r.condition}: {r.doubt}; why: rig show --all "
            f"{in_shell(self.folder.run_file(r.number, r.procedure))}"
            for r in self.latest_invalid
        ]
        if more := self.invalid - len(shown):
            shown.append(f"invalid: {counted(more, 'earlier run')} with invalid points")
        return shown

    def _holds_and_presses(self) -> str:
        return f"{counted(self.holds, 'hold')}, {counted(self.presses, 'press', 'presses')}"

    def _files_to_make(self) -> list[str]:
        shown = []
        if self.not_compiled:
            shown.append(f"not compiled yet: {counted(self.not_compiled, 'run file')}")
        if compiled := self.unprocessed - self.not_compiled:
            shown.append(f"figures and results still to be made: {counted(compiled, 'run')}")
        return shown

    @property
    def _real_time(self) -> bool:
        """True if it is under way on a bench whose time passes by itself."""
        return self.running and not self.simulated

    def _state(self) -> str:
        if self.running or not self.state or self.state.startswith(ENDS):
            return self.state
        return f"interrupted ({self.state}); its supervisor has died"


def status_of(folder: BatchFolder, running: bool | None = None) -> BatchStatus:
    """Return the status of a batch. Raises ConfigurationError where the folder holds none. A caller
    that knows whether it is `running` says so: then its lock is not tried, even for a moment."""
    if running is None:
        running = folder.is_held("supervisor")
    with QueueView.open(folder.queue) as queue:
        unprocessed = queue.unprocessed()
        state = queue.meta("state")
        beat = read_heartbeat(folder.heartbeat) if running else None
        if beat and beat.state == "holding" and not state.startswith(("held", "paus")):
            state = f"held: {beat.message}"  # a full disk keeps it from being in the queue
        return BatchStatus(
            folder,
            queue.meta("name"),
            queue.meta("simulated") == "yes",
            state,
            running,
            queue.counts(),
            queue.remaining(),
            len(unprocessed),
            folder.not_compiled(unprocessed),
            queue.bench_s(),
            int(queue.meta(HOLDS, "0")),
            int(queue.meta(PRESSES, "0")),
            next(queue.rows(("running",)), None),
            queue.latest(("failed",), LATEST),
            *queue.invalid(LATEST),
            queue.events(LATEST),
            datetime.now().astimezone(),
            *_bench_of(queue.meta("bench", "")),
            _instead_of_a_resume(queue),
        )


def _instead_of_a_resume(queue: QueueView) -> str:
    """Return what to do about the remaining runs if a `stop_by` with a date is over, or a stop
    condition is met."""
    with suppress(ValueError):  # no file, or one that this version does not read: resume says so
        batch = BatchFile.model_validate_json(queue.meta("file", "")).batch
        counts, used_s = queue.counts(), queue.bench_s()
        if reason_to_end(batch, counts["done"], counts["failed"], used_s):
            return remedy_at_the_end(batch, counts["done"], used_s)
        if not isinstance(batch.stop_by, datetime):
            return ""
        now = datetime.now().astimezone()
        _, until = window(batch, now)
        # The time of a batch without a bench file is virtual.
        passed = until is not None and until <= now and bool(queue.meta("bench", ""))
        if passed or queue.meta(TIME_OVER, ""):
            return how_to_continue(batch)
    return ""


def _bench_of(bench_file: str) -> tuple[tuple[str, ...], str]:
    """Return what the marks of a bench say, unless their run is at work, and what makes it safe if
    they refuse it; of a bench file that cannot be read, the reason."""
    if not bench_file:
        return (), ""
    try:
        marks = read_marks(address_names(read_bench(Path(bench_file))))
    except RigError as error:
        return (f"the state of the bench is not known: {error.one_line()}",), ""
    refused = any(mark.refuses for mark in marks)
    return (
        tuple(mark.in_words() for mark in marks if not mark.lives),
        f"check the bench, then run: rig make-safe --bench {in_shell(bench_file)}"
        if refused
        else "",
    )


def _in_words(state: str) -> str:
    """Return what a person reads of a run's state in the queue."""
    return "left out" if state == "set-aside" else state
