"""What the parts of a run have in common: the loop over its points, the checks in every wait, and
the saving of its data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rig.files.journal.recorder import Recorder
    from rig.run.checked_procedure import CheckedProcedure
    from rig.run.context import Run
    from rig.run.job import Journal, RunJob
    from rig.run.observers import Observers
    from rig.run.outcome import RunOutcome
    from rig.run.phases import Phases
    from rig.run.points import Reading
    from rig.run.stopping import StopFlag


@dataclass(frozen=True)
class RunParts:
    """One run that has a journal: what was asked for, what it works with, and what has come of it
    so far."""

    job: RunJob
    procedure: CheckedProcedure
    run: Run
    """What the procedure's hooks get."""
    journal: Journal
    recorder: Recorder
    """Writes the journal, in a thread of its own."""
    readings: dict[str, Reading]
    """Readings of the points in the journal, by id; those of an earlier attempt at the run, too."""
    phases: Phases
    stop: StopFlag
    observers: Observers
    outcome: RunOutcome
