"""The benches of a batch's runs: the bench file's, locked once for all, or a simulated one each."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from rig.batch.execute.terms import BatchTerms
from rig.batch.execute.worker_link import SendEvent
from rig.batch.folder import BatchFolder
from rig.batch.plan.procedures import installed
from rig.batch.queue_records import Claim
from rig.core.errors import ConfigurationError
from rig.run.bench_selector import (
    BenchRequest,
    BenchSelector,
    ChosenBench,
    start_simulated,
    world_in,
)
from rig.run.stopping import StopFlag

if TYPE_CHECKING:
    from rig.bench.settings import Fixture
    from rig.bench.simulated import RunningBench
    from rig.run.procedure import Procedure


@dataclass(frozen=True)
class _Ahead:
    """A simulated bench that boots while the run before its own is taken."""

    request: BenchRequest
    fixture: Fixture
    started: RunningBench


class RunBenches:
    """Gives each run its bench; a simulated one boots while the run before its own is taken."""

    def __init__(self, terms: BatchTerms, folder: BatchFolder, stop: StopFlag, send: SendEvent):
        self._terms, self._folder, self._stop, self._send = terms, folder, stop, send
        self.lasting: ChosenBench | None = None
        """The bench of the bench file once a run has chosen it, locked for all runs."""
        self._ahead: _Ahead | None = None
        """The simulated bench of the next run, while this one is taken."""

    def bench_for(self, claim: Claim, procedure: Procedure, at_the_end: ExitStack) -> ChosenBench:
        """Return the bench file's bench, locked once for all runs; or a simulated one for this
        run."""
        fixture = procedure.fixtures[0]
        selector = BenchSelector(
            lambda text: self._send("note", level="info", text=text),
            warn=lambda text: self._send("note", level="warning", text=text),
            check=self._stop.check,
        )
        if self._terms.bench is None:
            request = self._simulated(claim)
            with self._stop.nothing_connected(), ExitStack() as nothing:
                return selector.select(request, nothing, fixture, self._booted(request, fixture))
        if self.lasting is None:
            request = BenchRequest(bench=self._terms.bench, results=self._terms.results)
            self.lasting = selector.select(request, at_the_end, fixture)
        from rig.core.clock import WallClock

        return replace(self.lasting, clock=WallClock())

    def _booted(self, request: BenchRequest, fixture: Fixture) -> RunningBench | None:
        """Return the simulated bench that was started ahead, if it is the one that is needed."""
        ahead, self._ahead = self._ahead, None
        if ahead is not None and (ahead.request, ahead.fixture) != (request, fixture):
            ahead.started.abandon()
            return None
        return None if ahead is None else ahead.started

    def boot(self, upcoming: Claim) -> None:
        """Start the simulated bench of a run that is to come, during the one before it. One with a
        fault plan is started later: its plan may affect this process's disk."""
        request = self._simulated(upcoming)
        try:
            fixture = installed(upcoming.condition.procedure).fixtures[0]
        except ConfigurationError:  # uninstalled since: that run fails, not the one before it
            return
        if request.fault is None:
            self._ahead = _Ahead(request, fixture, start_simulated(request, fixture))

    def abandon(self) -> None:
        """End the bench that was started ahead and that no run has taken."""
        if self._ahead is not None:
            self._ahead.started.abandon()

    def _simulated(self, claim: Claim) -> BenchRequest:
        """Return the simulated bench of a run: its World and its faults."""
        own = self._terms.file.simulation
        request = BenchRequest(seed=self.seed, results=self._folder.path / "runs")
        if own is None:
            return request
        worlds = [own.world] + [c.settings for c in own.change if c.from_run <= claim.number]
        world = worlds[-1]
        fault = next(
            (f.plan for f in own.fault if claim.number in f.runs and claim.attempt <= f.attempts),
            None,
        )
        return replace(
            request,
            stages=own.stages,
            world=None if world is None else world_in(self._terms.files_from, world),
            fault=None if fault is None else self._terms.files_from / fault,
            world_log=self._folder.world_log(claim.number) if own.world_log else None,
        )

    @property
    def seed(self) -> int:
        """Seed of the batch's simulated benches."""
        own = self._terms.file.simulation
        return 0 if own is None else own.seed
