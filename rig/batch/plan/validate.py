"""A whole plan against a bench, before anything starts: fixtures, instruments, every limit.

A plan is checked on connected instruments, since only they know all of their limits. For a batch
on a real bench these are simulated ones under the bench file's limits, as in a dry run: nothing on
the bench is touched.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field

from rig.batch.plan.conditions import BatchCondition, BatchPlan
from rig.batch.plan.findings import KeyPath, PlanFinding
from rig.batch.plan.procedures import installed
from rig.bench.connected import Bench
from rig.bench.plan import BenchPlan
from rig.bench.settings import Fixture, FixtureSettings
from rig.core.errors import RigError
from rig.run.checked_procedure import CheckedProcedure
from rig.run.points import refusals, require_roles

BenchConnector = Callable[[Fixture], AbstractContextManager[Bench]]
"""A connected bench with a fixture mounted, for as long as a `with` block lasts."""

RUNS_NAMED = 3


@dataclass
class ValidationResult:
    """Result of validating a batch on a bench."""

    findings: list[PlanFinding] = field(default_factory=list)
    """Everything that is wrong; empty if the batch may begin."""
    fixtures: dict[str, FixtureSettings] = field(default_factory=dict)
    """Mounted fixture for each procedure, with all positions."""


def validate(
    plan: BatchPlan, real: BenchPlan | None, connected: BenchConnector
) -> ValidationResult:
    """Check a plan on a bench, each condition once. `real` is the bench file's plan, None where
    each run gets a simulated bench of its own, on which what it needs is mounted."""
    checked = ValidationResult()
    wanted = {name: fixture_for(name, real) for name in procedures_of(plan)}
    if real is not None:
        checked.findings += _unmounted(plan, real, wanted)
    for fixture in dict.fromkeys(fixture for fixture in wanted.values() if fixture is not None):
        conditions = [c for c in plan.conditions.values() if wanted[c.procedure] == fixture]
        with connected(fixture) as bench:
            refused = [(c, error) for c in conditions for error in _refusals(c, bench, real)]
            place = bench.settings.fixture
        checked.findings += _together(refused)
        checked.fixtures |= {name: place for name, one in wanted.items() if one == fixture}
    return checked


def procedures_of(plan: BatchPlan) -> tuple[str, ...]:
    """Return the procedures of a plan, each once, as the file names them first."""
    return tuple(dict.fromkeys(condition.procedure for condition in plan.conditions.values()))


def fixture_for(procedure: str, real: BenchPlan | None) -> Fixture | None:
    """Return the fixture a procedure works on: the first of those mounted that it accepts, None
    where none is. A bench that is simulated for a run has the one that the procedure names first.
    """
    accepted = installed(procedure).fixtures
    if real is None:
        return accepted[0]
    return next((mounted for mounted in real.mounted if mounted in accepted), None)


def _unmounted(
    plan: BatchPlan, real: BenchPlan, fixtures: Mapping[str, Fixture | None]
) -> Iterator[PlanFinding]:
    """Experiments that would need another fixture mounted half-way."""
    mounted = " and the ".join(real.mounted)
    for experiment in dict.fromkeys(c.experiment for c in plan.conditions.values()):
        own = {c.id: c for c in plan.conditions.values() if c.experiment == experiment}
        procedure = next(iter(own.values())).procedure
        if fixtures[procedure] is not None:
            continue
        needed = installed(procedure).fixtures
        numbers = [run.number for run in plan.runs if run.condition in own]
        yield PlanFinding(
            ("experiment", experiment, "procedure"),
            f"{procedure} ({_runs(numbers)}) needs the {' or the '.join(needed)}, the bench has "
            f"the {mounted} mounted: it would have to be changed during the batch",
            f"put these runs into a batch of their own; or, if both are mounted at once, declare "
            f'the other with [[also_mounted]] mounted = "{needed[0]}" in {real.source}',
        )


def _runs(numbers: list[int]) -> str:
    named = ", ".join(str(number) for number in numbers[:RUNS_NAMED])
    more = len(numbers) - RUNS_NAMED
    return f"run {named}" + (f" and {more} more" if more > 0 else "")


def _refusals(
    condition: BatchCondition, bench: Bench, real: BenchPlan | None
) -> Iterator[RigError]:
    """Return the reasons why a condition cannot be run on a bench, each on its own."""
    own = installed(condition.procedure)
    procedure = CheckedProcedure(own(own.Settings.model_validate(condition.settings)))
    try:
        points = procedure.points()
        if real is not None:  # the simulated bench may have more than the real one
            require_roles(points, real)
        require_roles(points, bench.plan)
    except RigError as error:
        yield error
        return
    yield from refusals(points, bench)
    try:
        procedure.check(bench)
    except RigError as error:
        yield error


def _together(refused: Iterable[tuple[BatchCondition, RigError]]) -> Iterator[PlanFinding]:
    """Yield one finding for each reason, which names the first condition and point that it
    concerns."""
    conditions: dict[tuple[int, str], dict[str, None]] = {}
    errors: dict[tuple[int, str], RigError] = {}
    for condition, error in refused:
        reason = condition.experiment, re.sub(r"^point \S+: ", "", error.message)
        conditions.setdefault(reason, {})[condition.id] = None
        errors.setdefault(reason, error)
    for reason, ids in conditions.items():
        experiment, error = reason[0], errors[reason]
        name, more = next(iter(ids)), len(ids) - 1
        others = f" and {more} more" if more else ""
        where: KeyPath = ("experiment", experiment)
        yield PlanFinding(where, f"{name}{others}: {error.message}", error.hint, error.code)
