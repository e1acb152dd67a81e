"""Select the bench that a command works on: that of a bench file, or a simulated one that it
starts.

The bench of a file is locked, and refused where an earlier run left it unsafe. A simulated bench
boots as a process of its own and belongs to the command alone. Nothing is connected here.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rig.core.entry_points import BENCHES, DRIVERS, load
from rig.core.errors import ConfigurationError

if TYPE_CHECKING:
    from rig.bench.plan import BenchPlan
    from rig.bench.settings import Fixture
    from rig.bench.simulated import BenchFactory, RunningBench
    from rig.core.clock import Clock
    from rig.run.locks.lock import BenchLock

BENCH_FILE = Path("bench.toml")
NOT_MEASURED = "These are not measurements."
FIRST_TIME = "the first time on a computer it takes up to two minutes"
STARTING: dict[Fixture, str] = {
    "film-clamp": "film in its clamp",
    "plate": "skin above its plate",
    "semi-spherical-object": "skin above a head on the rotary stage",
}

POPULATION = "population"
"""Stands for a World that the seed draws, in the place of a file."""


@dataclass(frozen=True, kw_only=True)
class BenchRequest:
    """The options of a command that select its bench."""

    bench: Path | None = None
    """Bench file; None for a simulated bench."""
    results: Path = Path("results")
    seed: int = 0
    dry_run: bool = False
    """Rehearse on a simulated bench under the bench file's limits."""
    stages: str | None = None
    """One of `simulated_variants`; None for the default."""
    world: Path | None = None
    """File of World settings, or `POPULATION`."""
    fault: Path | None = None
    world_log: Path | None = None


@dataclass(frozen=True)
class ChosenBench:
    """The bench that a command works on, not yet connected."""

    plan: BenchPlan
    clock: Clock
    lock: BenchLock | None = None
    """Lock on the instruments; None for a simulated bench that this command started."""
    started: RunningBench | None = None
    """Simulated bench that was started for this command."""
    recorded_toml: str | None = None
    """Bench file of a simulated bench without the process's port numbers."""


def world_in(folder: Path, world: str) -> Path:
    """Return the World of a simulated bench that a file in `folder` names: a file relative to that
    folder, or the word for a World that the seed draws."""
    return Path(world) if world == POPULATION else folder / world


def bench_file(given: Path | None) -> Path | None:
    """Return the bench file that a command names, else ./bench.toml if there is one, else None for
    a simulated bench."""
    return given or (BENCH_FILE if BENCH_FILE.exists() else None)


def existing_bench_file(given: Path | None) -> Path | None:
    """Return `bench_file`. Raises ConfigurationError for a file that does not exist."""
    chosen = bench_file(given)
    if chosen is not None and not chosen.is_file():
        raise ConfigurationError(
            f"the bench file {chosen} does not exist",
            "name a bench file with --bench, or leave it out to follow the runs alone",
        )
    return chosen


@dataclass(frozen=True)
class BenchSelector:
    """Selects the bench that a command works on, and prepares it."""

    say: Callable[[str], None]
    """Function that shows a line to a person."""
    warn: Callable[[str], None] | None = None
    """Function that shows what became of an earlier run; None for `say`."""
    paced: bool = False
    """True if a simulated bench's time passes at a person's pace."""
    waiting: Callable[[], AbstractContextManager[None]] = nullcontext
    """Function whose context lasts while a simulated bench is waited for, to show a person that
    something happens."""
    check: Callable[[], None] = lambda: None
    """Function that raises what ends a wait for the guard of an earlier run."""
    rehearsal: str = "dry run"
    """What a simulated bench is for, where it is not the command's own bench."""
    while_it_boots: Callable[[], None] = lambda: None
    """Function that is called while a simulated bench boots, which takes about a second; nothing is
    connected yet."""

    def select(
        self,
        request: BenchRequest,
        at_the_end: ExitStack,
        fixture: Fixture = "film-clamp",
        started: RunningBench | None = None,
    ) -> ChosenBench:
        """Return the bench of a bench file with a wall clock, locked until `at_the_end`, or a
        simulated bench with `fixture` mounted and a clock of its own. The simulated bench is the
        one `started` ahead for this request, if given."""
        if request.bench is not None and not request.dry_run:
            return self._of_file(request, at_the_end, request.bench)
        real = None
        try:
            if request.bench is not None:
                from rig.bench.plan import read_bench

                real = read_bench(request.bench)
        except BaseException:
            if started is not None:
                started.abandon()
            raise
        if started is None:
            self.say(f"starting the simulated bench ({_starting(fixture)}) ...")
            started = start_simulated(request, fixture, real)
        try:
            return self._simulated(request, started, real)
        except BaseException:
            started.abandon()
            raise

    def _of_file(self, request: BenchRequest, at_the_end: ExitStack, path: Path) -> ChosenBench:
        from rig.bench.plan import read_bench
        from rig.core.clock import WallClock
        from rig.run.locks.bench_mark import clear_marks, read_marks, refuse_unsafe
        from rig.run.locks.lock import BenchLock, GuardWait

        plan = read_bench(path)
        _refuse_simulation_options(request, path)
        wait = GuardWait(self.say, self.check)
        lock = at_the_end.enter_context(BenchLock(plan, wait=wait))
        marks = read_marks(lock.names)
        refuse_unsafe(marks, str(path))
        for mark in marks:
            self._warn(mark.in_words())
        clear_marks(lock.names)
        if plan.settings.simulation is not None:
            self.say(f"SIMULATED bench ({path}). {NOT_MEASURED}")
        roles = ", ".join(part.role for part in plan.instruments)
        self.say(f"getting ready to connect to {roles} ...")
        return ChosenBench(plan, WallClock(), lock)

    def _simulated(
        self, request: BenchRequest, started: RunningBench, real: BenchPlan | None
    ) -> ChosenBench:
        from rig.bench.plan import parse_bench, rehearsal
        from rig.core.clock import ControlLink, PacedClock, SlavedClock
        from rig.run.making_safe.guard_report import GUARD_SUFFIX

        self._report_takeovers(*sorted(request.results.glob(f"*/*{GUARD_SUFFIX}")))
        self.while_it_boots()
        _import_drivers(started.drivers)
        with self.waiting():
            ready = started.ready()
        why = self.rehearsal if request.dry_run else f"no {BENCH_FILE} found in {Path.cwd()}"
        self.say(f"SIMULATED bench ({why}; seed {request.seed}). {NOT_MEASURED}")
        plan = parse_bench(ready["bench_toml"], "the simulated bench")
        if real is not None:
            plan = rehearsal(real, plan, ready.get("models"))
            for line in plan.stand_ins:
                self.say(line)
        control = ControlLink(ready["control_port"])
        clock = PacedClock(control) if self.paced else SlavedClock(control)
        return ChosenBench(plan, clock, None, started, ready["recorded_toml"])

    def _report_takeovers(self, *reports: Path) -> None:
        from rig.run.making_safe.guard_report import takeover_notice

        for report in reports:
            if (notice := takeover_notice(report)) is not None:
                self._warn(notice)

    def _warn(self, text: str) -> None:
        (self.warn or self.say)(text)


def _starting(fixture: Fixture) -> str:
    """Return what is started, and that it takes long where no skin is in the cache yet."""
    from rig.core.cache import user_cache

    if fixture == "film-clamp" or user_cache().has_entries():
        return STARTING[fixture]
    return f"{STARTING[fixture]}; {FIRST_TIME}"


def start_simulated(
    request: BenchRequest, fixture: Fixture, real: BenchPlan | None = None
) -> RunningBench:
    """Start a simulated bench as a command wants it.

    In a dry run of the bench `real` it has the simulators of that bench's drivers, as far as they
    are installed; stages that the command names come before them.
    """
    drivers = {} if real is None else {part.role: part.driver_name for part in real.instruments}
    return _simulated_benches().start(
        {
            "fixture": fixture,
            **_simulated_benches().options_for(drivers),
            **({} if request.stages is None else {"stages": request.stages}),
            "seed": request.seed,
            "world": _text(request.world),
            "fault": _text(request.fault),
            "world_log": _text(request.world_log),
            "results": str(request.results),
        }
    )


def simulated_variants() -> tuple[str, ...]:
    """Return the names of the simulated benches that can be started, the default first."""
    return _simulated_benches().variants()


def require_variant(name: str) -> str:
    """Return `name`. Raises ValueError, which lists the choices, if no simulated bench has it."""
    if name not in (known := simulated_variants()):
        raise ValueError(f"must be one of {', '.join(known)}")
    return name


def simulated_variant_for(plan: BenchPlan) -> str | None:
    """Return the name of the simulated bench whose stages have the limits of those of a bench file,
    or None if there is none for its drivers."""
    drivers = {part.role: part.driver_name for part in plan.instruments}
    return _simulated_benches().variant_for(drivers)


def _import_drivers(names: tuple[str, ...]) -> None:
    """Import drivers. One that is broken is reported when the bench file that names it is read."""
    for name in names:
        with suppress(ConfigurationError):
            load(DRIVERS, name)


def _simulated_benches() -> BenchFactory:
    factory: BenchFactory = load(BENCHES, "simulated")
    return factory


def refuse_seed(request: BenchRequest) -> None:
    """Raise ConfigurationError for a seed that a person gave with a bench file: it would have no
    effect. A run that is resumed keeps the seed that its journal states."""
    if request.seed and request.bench is not None and not request.dry_run:
        raise ConfigurationError(
            f"--seed {request.seed} belongs to a simulated bench that this command starts, not to "
            f"{request.bench}",
            "give it to `rig simulate`, or leave the bench file out",
        )


def _refuse_simulation_options(request: BenchRequest, path: Path) -> None:
    """Raise ConfigurationError for an option of a simulated bench with the bench file at
    `path`."""
    own = ("stages", "world", "fault", "world_log")
    given = [name for name in own if getattr(request, name) is not None]
    if given:
        options = " and ".join("--" + name.replace("_", "-") for name in given)
        belong, it = ("belongs", "it") if len(given) == 1 else ("belong", "them")
        raise ConfigurationError(
            f"{options} {belong} to a simulated bench that this command starts, not to {path}",
            f"give {it} to `rig simulate`, or leave the bench file out",
        )


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)
