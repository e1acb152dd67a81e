"""Decides what follows from the end of a run: try again, continue, hold, or end the batch. Pure
functions.

A time-out is worth another try. A limit never is: it would be exceeded again, with the skin pressed
once more. Neither are more holds than the bench file allows. A condition that keeps failing is left
out and the night continues. A person's interlock ends the night: only a person resets it and starts
again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from rig.batch.plan.settings import BatchSettings
from rig.core.errors import ExitCode, InstrumentTimeoutError, RigError, shortened
from rig.files.errors import NO_LOCKS, TOO_MANY_OPEN, RecordingError
from rig.run.holds import HoldLimitError
from rig.run.interlocks.watch import InterlockError
from rig.run.locks.lock import BenchInUseError

FailureKind = Literal[
    "timeout",
    "instrument",
    "holds",
    "died",
    "interlock",
    "limit",
    "usage",
    "in-use",
    "storage",
    "recording",
    "unsafe",
    "internal",
]
"""Reason of a failure, as retries distinguish it. "storage" and "recording" are failures to save
data: the first may pass once the disk has room, the other needs a person. "in-use" is a bench that
another program has."""

LONGEST_REASON = 200
"""Characters of a run's reason in that of its batch: enough for the first cause. The event of the
run has all of it, which is a page where the bench could not be made safe."""


@dataclass(frozen=True)
class FailureDecision:
    """Consequences of a failed attempt for its run, its condition and the batch."""

    run: Literal["again", "failed"]
    batch: Literal["go-on", "hold", "end"] = "go-on"
    why: str = ""
    set_aside: bool = False
    """True if its condition's other runs are left out."""


def kind_of(code: int, failures: Sequence[RigError], made_safe: bool = False) -> FailureKind:
    """Return the kind of failure that ended a run: exit code and failures, first cause first;
    `made_safe` where the run could not make its bench safe, and its guard then could."""
    if code == ExitCode.UNSAFE:
        return "instrument" if made_safe else "unsafe"
    first = failures[0] if failures else None
    if isinstance(first, RecordingError):
        return "recording" if _errno_of(first) in (*NO_LOCKS, *TOO_MANY_OPEN) else "storage"
    if isinstance(first, BenchInUseError):
        return "in-use"
    if isinstance(first, HoldLimitError):
        return "holds"
    if isinstance(first, InterlockError):
        return "interlock"
    if isinstance(first, InstrumentTimeoutError):
        return "timeout"
    by_code: dict[int, FailureKind] = {
        ExitCode.INSTRUMENT: "instrument",
        ExitCode.LIMIT: "limit",
        ExitCode.USAGE: "usage",
    }
    return by_code.get(code, "internal")


def _errno_of(error: BaseException | None) -> int | None:
    """Return the number of the system's error behind an error; None if there is none."""
    while error is not None and not isinstance(error, OSError):
        error = error.__cause__
    return None if error is None else error.errno


def after_failure(
    batch: BatchSettings,
    kind: FailureKind,
    before: Mapping[str, int],
    failed_of_condition: int,
    failed_in_a_row: int,
    reason: str,
) -> FailureDecision:
    """Return the decision after a failed attempt.

    `before` has the number of this run's attempts that ended for each kind, this one included.
    `failed_of_condition` and `failed_in_a_row` are numbers of runs that failed for good, without
    this one.
    """
    first = shortened(reason, LONGEST_REASON)
    if kind == "unsafe":
        return FailureDecision("again", "end", f"the bench could not be made safe: {first}")
    if kind == "interlock":  # a person has to reset it, and to start the batch again
        return FailureDecision("again", "end", reason)
    if kind == "in-use":  # a person may be at the bench: nothing begins by itself once it is free
        return FailureDecision("again", "hold", reason)
    if kind in ("storage", "recording"):
        return FailureDecision("again", "hold", f"the data cannot be saved: {reason}")
    if before.get(kind, 0) <= getattr(batch.retries, kind, 0):
        return FailureDecision("again")
    aside = failed_of_condition + 1 >= batch.set_aside_after
    if batch.on_failure == "stop":
        return FailureDecision("failed", "end", f"a run failed: {first}", aside)
    if batch.on_failure == "hold":
        return FailureDecision("failed", "hold", f"a run failed: {first}", aside)
    row = failed_in_a_row + 1
    if row >= batch.hold_when.consecutive_failures:
        return FailureDecision(
            "failed", "hold", f"{row} runs in a row have failed, last: {first}", aside
        )
    return FailureDecision("failed", set_aside=aside)


NEW_BATCH = (
    "begin a new batch with the runs that are left: rig batch resume does not change stop_when"
)
"""What to do once a stop condition is met that stays so, as an instruction without a capital."""
TAKE_AGAIN = f"take failed runs again with rig batch resume --retry-failed, or {NEW_BATCH}"
"""The same where the runs that have failed are what meets it."""


def remedy_at_the_end(batch: BatchSettings, done: int, bench_s: float) -> str:
    """Return what to do once `reason_to_end` has given one."""
    return NEW_BATCH if reason_to_end(batch, done, 0, bench_s) else TAKE_AGAIN


def reason_to_end(batch: BatchSettings, done: int, failed: int, bench_s: float) -> str:
    """Return the stop condition that is met; empty if none is."""
    when = batch.stop_when
    if when.finished_runs is not None and done >= when.finished_runs:
        return f"{done} runs are finished (stop_when.finished_runs = {when.finished_runs})"
    if when.failed_runs is not None and failed >= when.failed_runs:
        return f"{failed} runs have failed (stop_when.failed_runs = {when.failed_runs})"
    if when.bench_hours is not None and bench_s >= 3600 * when.bench_hours:
        hours = bench_s / 3600
        return f"the bench was in use for {hours:.2f} h (bench_hours = {when.bench_hours:g})"
    return ""
