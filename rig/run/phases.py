"""The phases of a run that has a journal, and the exceptions that may end a wait in each."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from enum import Enum

from rig.run.passing import Passing


class RunPhase(Enum):
    """The phase of a run, which decides what may end a wait."""

    READY = "ready"
    """Phase in which nothing is armed, or the run is between two points. Stop requests and failures
    of the recorder end a wait."""
    MEASURING = "measuring"
    """Arming, or measuring a point. Trips and holds end a wait as well."""
    ON_HOLD = "on hold"
    """The bench is safe and the run waits until the condition has passed. Stop requests and
    failures of the recorder end a wait; trips and holds do not."""
    MAKING_SAFE = "making safe"
    """Shutdown actions run. Nothing ends a wait, so that each of them is completed."""
    SAVING = "saving"
    """The bench is safe and the run is over; its data are saved. Nothing waits on the bench."""


TRANSITIONS: Mapping[RunPhase, frozenset[RunPhase]] = {
    RunPhase.READY: frozenset({RunPhase.MEASURING, RunPhase.MAKING_SAFE}),
    RunPhase.MEASURING: frozenset({RunPhase.READY, RunPhase.MAKING_SAFE}),
    # after a trip: arm again and retake; after a hold: wait; at the end: save
    RunPhase.MAKING_SAFE: frozenset(
        {RunPhase.READY, RunPhase.ON_HOLD, RunPhase.MAKING_SAFE, RunPhase.SAVING}
    ),
    RunPhase.ON_HOLD: frozenset({RunPhase.READY, RunPhase.MAKING_SAFE}),
    RunPhase.SAVING: frozenset(),
}
"""Allowed changes of phase. Making safe is reachable from every phase in which something can be
armed: no failure may prevent a run from it."""


class Phases:
    """The present phase of a run, which changes along `TRANSITIONS` only."""

    def __init__(self) -> None:
        self.now = RunPhase.READY
        self.passing = Passing()
        """Whether what ends a wait of the present measurement passes through the procedure."""

    def enter(self, phase: RunPhase) -> None:
        """Change the phase. Raises AssertionError for a change that is not in `TRANSITIONS`: a
        defect."""
        assert phase in TRANSITIONS[self.now], f"a run cannot go from {self.now} to {phase}"
        self.now = phase

    @contextlib.contextmanager
    def measuring(self) -> Iterator[None]:
        """Enter `MEASURING` for the block, then `READY`, whatever the block raises."""
        self.enter(RunPhase.MEASURING)
        try:
            yield
        finally:
            self.passing.passed()
            self.enter(RunPhase.READY)
