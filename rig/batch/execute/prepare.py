"""Everything that is known of a batch before it begins: read, expanded, validated, forecast.

`rig batch plan` shows it, and `rig batch run` begins nothing without it. No real instrument is
contacted: limits are checked on a simulated bench under the limits of the bench file.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from rig.batch.plan.conditions import BatchPlan
from rig.batch.plan.estimate import ExpectedRun, Forecast, expect, forecast, homing_s
from rig.batch.plan.findings import KeyPath, PlanFinding, RefusedBatchError
from rig.batch.plan.read import read_batch
from rig.batch.plan.settings import BatchFile
from rig.batch.plan.validate import BenchConnector, ValidationResult, validate
from rig.batch.plan.window import fault_of
from rig.batch.queue_records import RunEstimate
from rig.batch.report.notify import require_usable
from rig.bench.apply_calibrations import check_records
from rig.bench.connect import connect
from rig.bench.connected import Bench
from rig.bench.plan import BenchPlan, read_bench
from rig.bench.settings import Fixture
from rig.core.errors import ConfigurationError, shortened
from rig.run.bench_selector import (
    POPULATION,
    BenchRequest,
    BenchSelector,
    bench_file,
    simulated_variant_for,
    world_in,
)


@dataclass(frozen=True)
class PreparedBatch:
    """A batch that has been checked and may begin."""

    batch: BatchFile
    plan: BatchPlan
    bench: Path | None
    """Bench file; None where every run gets a simulated bench of its own."""
    expected: Mapping[str, ExpectedRun]
    """Expected duration and size of a run, by condition."""
    forecast: Forecast
    text: str
    """The batch file as it was read."""

    @property
    def estimates(self) -> dict[str, RunEstimate]:
        """The estimate for a run, by condition."""
        return {
            name: RunEstimate(one.duration_s, one.spread_s, one.size_B)
            for name, one in self.expected.items()
        }


def prepare(
    path: Path,
    given: Path | None,
    now: datetime,
    say: Callable[[str], None],
    *,
    begun: bool = False,
) -> PreparedBatch:
    """Read a batch file, expand it, validate all of it on its bench and forecast it as if it began
    `now`. `given`: the bench file of the command line; `say` gets lines for a person.
    The window of a batch that was `begun` earlier may have passed.

    RefusedBatchError lists all that is wrong, each with its line.
    """
    batch, plan, source = read_batch(path)
    chosen = bench_of(batch, path, given)
    for named in (path, chosen):
        if named is not None:
            _require_utf8(named.absolute())
    real = None if chosen is None else read_bench(chosen)
    findings = [
        *_simulation(batch, path, chosen),
        *_bad_records(batch, real, now),
        *_unusable_notifications(batch),
        *(() if begun else _no_window(batch, now)),
        *(() if begun else _folder_of_a_shell(batch)),
    ]
    with tempfile.TemporaryDirectory(prefix="rig-batch-plan-") as results:
        request = _request(batch, path, chosen, real, Path(results))
        checked = (
            validate(plan, real, rehearsed(request, say)) if not findings else ValidationResult()
        )
    if findings := [*findings, *checked.findings]:
        raise RefusedBatchError(findings, source)
    fixtures = checked.fixtures
    expected = expect(plan, fixtures, real is not None)
    first_s = homing_s(plan, fixtures) if real is not None else 0.0
    expectation = forecast(batch.batch, plan, expected, now, first_s, real)
    return PreparedBatch(batch, plan, chosen, expected, expectation, source.text)


def _require_utf8(path: Path) -> None:
    """Raise ConfigurationError for a path that the queue cannot hold."""
    try:
        str(path).encode()
    except UnicodeEncodeError as error:
        raise ConfigurationError(
            f"{path}: the name, or that of a folder above it, is not UTF-8 text, and a batch has "
            "to record it",
            "rename it, or move the file to another folder",
        ) from error


def _folder_of_a_shell(batch: BatchFile) -> Iterator[PlanFinding]:
    """Refuse ``results = "~/..."``: only a shell replaces ~. A folder of that name would be made,
    and whoever removes it with a shell removes a home folder."""
    results = batch.batch.results
    if results.startswith("~"):
        yield PlanFinding(
            ("batch", "results"),
            f"batch.results = {shortened(repr(results))}: ~ is not replaced by your home folder",
            f"write the whole path, e.g. {Path.home()}/{results.lstrip('~/')}",
        )


def bench_of(batch: BatchFile, path: Path, given: Path | None) -> Path | None:
    """Return the bench file of a batch: that of the command line, of the batch file, or
    ./bench.toml; None for simulated benches, one a run."""
    if given is None and batch.batch.bench is not None:
        return path.parent / batch.batch.bench
    return bench_file(given)


def rehearsed(request: BenchRequest, say: Callable[[str], None]) -> BenchConnector:
    """Return the simulated benches under the limits of the request's bench file, connected one at a
    time."""

    @contextlib.contextmanager
    def connected(fixture: Fixture) -> Iterator[Bench]:
        with ExitStack() as at_the_end:
            selector = BenchSelector(say, rehearsal="to check the batch")
            chosen = selector.select(request, at_the_end, fixture)
            assert chosen.started is not None, "a rehearsal starts its bench"
            at_the_end.callback(chosen.started.wait)
            try:
                bench = connect(chosen.plan.on(fixture), chosen.clock)
            except BaseException:
                chosen.clock.close()
                raise
            with contextlib.closing(bench):
                yield bench

    return connected


def _request(
    batch: BatchFile, path: Path, chosen: Path | None, real: BenchPlan | None, results: Path
) -> BenchRequest:
    """Return the simulated bench that a batch is checked on."""
    own = batch.simulation
    if real is not None or own is None:
        stages = None if real is None else simulated_variant_for(real)
        return BenchRequest(bench=chosen, results=results, dry_run=True, stages=stages)
    world = None if own.world is None else world_in(path.parent, own.world)
    return BenchRequest(
        results=results, dry_run=True, seed=own.seed, stages=own.stages, world=world
    )


def _simulation(batch: BatchFile, path: Path, bench: Path | None) -> Iterator[PlanFinding]:
    """Return the findings about [simulation]: a bench that it does not fit, files that do not
    exist."""
    own = batch.simulation
    if own is None:
        return
    if bench is not None:
        yield PlanFinding(
            ("simulation",),
            f"[simulation] is for batches that start their own benches; this one uses {bench}",
            "leave out [simulation], or the bench file",
        )
    named: list[tuple[KeyPath, str | None]] = []
    if own.world != POPULATION:
        named.append((("simulation", "world"), own.world))
    named += [(("simulation", "fault", k, "plan"), one.plan) for k, one in enumerate(own.fault)]
    named += [
        (("simulation", "change", k, "settings"), one.settings) for k, one in enumerate(own.change)
    ]
    for where, name in named:
        if name is not None and not (path.parent / name).is_file():
            key = ".".join(str(part) for part in where if isinstance(part, str))
            yield PlanFinding(
                where,
                f"{key} = {name!r}: there is no such file in the folder of the batch file",
                "name a file relative to the batch file",
            )


def _unusable_notifications(batch: BatchFile) -> Iterator[PlanFinding]:
    """Yield notifications that could never be delivered."""
    try:
        require_usable(batch.batch.notify)
    except ConfigurationError as error:
        yield PlanFinding(("batch", "notify"), error.message, error.hint)


def _no_window(batch: BatchFile, now: datetime) -> Iterator[PlanFinding]:
    """Yield a window in which no run could be taken."""
    if fault := fault_of(batch.batch, now):
        yield PlanFinding(
            ("batch", "stop_by"),
            f"batch.stop_by = {batch.batch.stop_by} {fault}",
            "write a time of the day, which is the next one, or a later date",
        )


def _bad_records(batch: BatchFile, real: BenchPlan | None, now: datetime) -> Iterator[PlanFinding]:
    """Yield the calibration records that no run could use."""
    try:
        if real is not None:
            check_records(real, now, batch.batch.allow_expired)
    except ConfigurationError as error:
        yield PlanFinding(("batch", "bench"), error.message, error.hint)
