"""What a queue gives and takes: estimates, claims, results of attempts, rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from rig.batch.plan.conditions import BatchCondition
from rig.core.errors import ExitCode
from rig.core.units import counted

RunState = Literal["queued", "running", "done", "failed", "set-aside"]
Ending = Literal["complete", "stopped", "failed", "died"]
WAITS_FOR_A_PERSON = "waits for a person"
"""Name of the reason for which a batch waits until a person resumes it."""
HOLDS, PRESSES = "holds", "presses"
"""Entries about the batch: how many holds its runs have had, and how often they have pressed
the object."""
TIME_OVER = "time over"
"""The entry that is not empty after a batch has ended because of its `stop_by`."""


class RunEstimate(NamedTuple):
    """Expected duration and size of a run."""

    duration_s: float
    spread_s: float
    """Standard deviation of its duration."""
    size_B: int = 0
    """Size of its run file."""


@dataclass(frozen=True)
class Claim:
    """A run that a worker has taken on, and which attempt at it this is."""

    number: int
    attempt: int
    repeat: int
    condition: BatchCondition
    estimate_s: float
    """Expected duration: as planned, or that of the longest of the latest complete runs of the
    condition, if that is longer."""
    spread_s: float
    size_B: int = 0
    """Size of its run file at most, as planned."""


@dataclass(frozen=True)
class AttemptResult:
    """How an attempt of a batch at a run ended, and how far it came."""

    ending: Ending
    kind: str = ""
    """Kind of a failure, by which it is retried (`rig.batch.plan.policy.FailureKind`); or empty."""
    code: int = 0
    reason: str = ""
    bench_s: float = 0.0
    """Bench time without `on_hold_s`: what an attempt takes that nothing disturbs."""
    points_done: int = 0
    points_planned: int = 0
    summary: Mapping[str, Any] | None = None
    holds: int = 0
    """Holds of this attempt, which are counted for the batch, not for each run."""
    presses: int = 0
    """Number of presses of the object; counted likewise."""
    on_hold_s: float = 0.0
    """Bench time for which it waited, on hold or paused. It is not kept."""
    bench: str = ""
    """How the attempt left the bench, as a sentence; empty where that is not known. It is not
    kept."""

    @property
    def elapsed_s(self) -> float:
        """All the bench time from its beginning to its end."""
        return self.bench_s + self.on_hold_s


@dataclass(frozen=True)
class RemainingWork:
    """Work that a batch has still to do, as planned."""

    runs: int
    bench_s: float
    spread_s: float
    """Standard deviation of `bench_s`, runs of one condition wrong together."""
    size_B: int = 0
    """Size of the run files to come."""


@dataclass(frozen=True)
class RunRow:
    """A run of the queue with its state, and what its attempts have come to."""

    number: int
    condition: str
    repeat: int
    state: RunState
    code: int | None
    reason: str
    bench_s: float
    points_done: int
    points_planned: int
    attempts: int
    procedure: str
    trials: int | None = None
    """Trials that its summary is about; None where it says nothing of that."""
    valid_trials: int | None = None

    @property
    def doubt(self) -> str:
        """What a run that is done says of invalid points: ``0 of 2 trials valid``; "" if all are
        valid."""
        if self.state != "done" or self.code != ExitCode.FINISHED_WITH_FAILURES:
            return ""
        return valid_of({"trials": self.trials, "valid_trials": self.valid_trials})


def valid_of(summary: Mapping[str, Any]) -> str:
    """Return how many trials of a run with invalid points are valid, by its summary."""
    trials, valid = summary.get("trials"), summary.get("valid_trials")
    if not isinstance(trials, int) or not isinstance(valid, int):
        return "some points are invalid"
    return f"{valid} of {counted(trials, 'trial')} valid"
