"""How far a batch is, as anybody may ask at any time: read from its queue alone."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

from rig.batch.folder import BatchFolder
from rig.batch.queue import Queue, RemainingWork, RunRow, RunState
from rig.core.units import duration

LATEST = 5
"""Failures and events that are shown."""


@dataclass(frozen=True)
class BatchStatus:
    """A look at a batch."""

    folder: BatchFolder
    name: str
    simulated: bool
    """On benches that the batch starts for itself, whose time goes as fast as they can."""
    state: str
    running: bool
    """Whether a supervisor is at work."""
    counts: dict[RunState, int]
    left: RemainingWork
    bench_s: float
    current: RunRow | None
    failures: list[RunRow]
    events: list[tuple[str, str, str]]
    now: datetime

    @property
    def finish(self) -> datetime:
        """When it would be over if it went on from now as planned."""
        return self.now + timedelta(seconds=self.left.bench_s)

    def as_object(self) -> dict[str, Any]:
        """For programs."""
        return {
            "folder": str(self.folder.path),
            "name": self.name,
            "simulated": self.simulated,
            "state": self.state,
            "running": self.running,
            "runs": dict(self.counts),
            "left_s": self.left.bench_s,
            "left_spread_s": self.left.spread_s,
            "bench_s": self.bench_s,
            "finish": self.finish.isoformat(timespec="seconds"),
            "run": None if self.current is None else self.current.number,
            "condition": None if self.current is None else self.current.condition,
            "failures": [
                {"run": r.number, "condition": r.condition, "code": r.code, "reason": r.reason}
                for r in self.failures
            ],
            "events": [{"time": t, "level": lv, "text": x} for t, lv, x in self.events],
        }

    def lines(self) -> list[str]:
        """For people."""
        total = sum(self.counts.values())
        marker = "SIMULATED " if self.simulated else ""
        shown = [f"{marker}batch {self.name}: {self._state()} ({self.folder.path})"]
        parts = [f"{self.counts['done']} of {total} runs done"]
        parts += [f"{n} {state}" for state, n in self.counts.items() if n and state != "done"]
        shown.append(", ".join(parts))
        if self.current is not None and self.running:
            run = self.current
            again = f", attempt {run.attempts}" if run.attempts > 1 else ""
            shown.append(f"run {run.number}: {run.condition}{again}")
        if self.left.runs:
            spread = f" +- {duration(self.left.spread_s)}" if self.left.spread_s else ""
            shown.append(
                f"left: {duration(self.left.bench_s)}{spread} of bench time"
                + (f", over at {self.finish:%Y-%m-%d %H:%M}" if self._goes_by_the_wall else "")
            )
        shown.append(f"used: {duration(self.bench_s)} of bench time")
        shown += [f"failed: run {r.number} {r.condition}: {r.reason}" for r in self.failures]
        shown += [f"{time[:19]} {level}: {text}" for time, level, text in self.events]
        if not self.running and self.left.runs:
            shown.append(f"go on with: rig batch resume {self.folder.path}")
        return shown

    @property
    def _goes_by_the_wall(self) -> bool:
        """Whether it is under way on a bench whose time is nobody's to move."""
        return self.running and not self.simulated

    def _state(self) -> str:
        if self.running or not self.state.startswith(("running", "waiting", "paused", "held")):
            return self.state
        return f"interrupted ({self.state}); its supervisor has died"


def status_of(folder: BatchFolder) -> BatchStatus:
    """Look at a batch; ConfigurationError where the folder holds none."""
    with Queue.open(folder.queue, read_only=True) as queue:
        return BatchStatus(
            folder,
            queue.meta("name"),
            queue.meta("simulated") == "yes",
            queue.meta("state"),
            folder.is_held("supervisor"),
            queue.counts(),
            queue.remaining(),
            queue.bench_s(),
            next(queue.rows(("running",)), None),
            queue.latest(("failed",), LATEST),
            queue.events(LATEST),
            datetime.now().astimezone(),
        )
