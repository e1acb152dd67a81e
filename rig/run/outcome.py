"""How a run ended, as values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rig.core.errors import ExitCode, RigError
from rig.run.arming import OffFailure
from rig.run.guard import TakenOver


@dataclass
class RunOutcome:
    """How a run ended."""

    status: str
    """complete, stopped or failed"""
    code: ExitCode
    points_planned: int = 0
    points_done: int = 0
    simulated: bool = False
    file: Path | None = None
    journal: Path | None = None
    """The journal, where it is still needed: to resume, or to recover what was not compiled."""
    duration_s: float = 0.0
    """Bench time of this attempt, from making ready to being safe."""
    summary: Mapping[str, Any] = field(default_factory=dict)
    failures: list[RigError] = field(default_factory=list)
    """What went wrong, first cause first."""
    off_failures: list[OffFailure] = field(default_factory=list)
    taken_over: TakenOver | None = None
    """What the guard did with a bench that the run could not make safe."""
    made_safe: tuple[str, ...] = ()
    """What the shutdown actions did at the end, as parts of a sentence: "generator off"."""
    safe: bool = False
    """Whether the bench is known to be safe: every shutdown action worked, and whole."""
    warnings: list[str] = field(default_factory=list)
