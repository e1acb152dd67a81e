"""How a run ended, what it recorded, and what it warned of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rig.core.errors import ExitCode, RigError
from rig.run.arming import ShutdownFailure
from rig.run.making_safe.guard_link import TakenOver
from rig.run.stopping import StopRequestedError


@dataclass
class RunOutcome:
    """How a run ended, what it recorded, and what it warned of."""

    status: str
    """One of ``complete``, ``stopped`` and ``failed``."""
    code: ExitCode
    points_planned: int = 0
    points_done: int = 0
    points_earlier: int = 0
    """Number of those done that an earlier attempt recorded."""
    simulated: bool = False
    file: Path | None = None
    journal: Path | None = None
    """Journal, if it is still needed to resume the run or to recover its data."""
    duration_s: float = 0.0
    """Bench time of this attempt, from its start until the bench was safe."""
    on_hold_s: float = 0.0
    """That part of it for which the run waited, on hold or paused, with the bench safe."""
    holds: int = 0
    """Holds of this attempt, pauses by the operator not included."""
    presses: int = 0
    """Number of times that z has gone down to press the object in this attempt."""
    summary: Mapping[str, Any] = field(default_factory=dict)
    in_brief: Sequence[str] = ()
    """The summary in lines, as `rig show` shows it."""
    failures: list[RigError] = field(default_factory=list)
    """Failures, the first cause first."""
    off_failures: list[ShutdownFailure] = field(default_factory=list)
    taken_over: TakenOver | None = None
    """Result of the guard's try on a bench that the run could not make safe."""
    made_safe: tuple[str, ...] = ()
    """Effects of the shutdown actions at the end, as parts of a sentence: "generator off"."""
    safe: bool = False
    """True if the bench is known to be safe: every shutdown action worked completely."""
    armed: bool = True
    """False if this attempt has switched nothing on and moved nothing."""
    own_bench: bool = False
    """True if the bench was started for this run alone: no earlier run can have left it pressed."""
    left: tuple[str, ...] = ()
    """How z was left where it could not be moved clear, or where that is not known, as parts of a
    sentence: "the skin may still be pressed"."""
    warnings: list[str] = field(default_factory=list)

    def end_with(self, error: RigError) -> RunOutcome:
        """Take an error as what has ended the run, and return the outcome; a stop request is no
        failure."""
        self.status = "stopped" if isinstance(error, StopRequestedError) else "failed"
        self.code = error.code
        self.failures.extend(error.parts())
        return self

    def add_failure(self, error: RigError) -> None:
        """Add a failure behind the first cause, unless it is the first cause again. A run that only
        invalid readings distinguish from one that is done gets its exit code."""
        if all(error.message != known.message for known in self.failures):
            self.failures.append(error)
        if self.code in (ExitCode.DONE, ExitCode.FINISHED_WITH_FAILURES):
            self.code = error.code
        self.status = "failed"
