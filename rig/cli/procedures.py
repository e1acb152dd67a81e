"""The command of a procedure: options to a job, the job to a bench, the outcome to the terminal."""

from __future__ import annotations

import inspect
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from rig.cli.options import parameters, settings_from
from rig.cli.outcome import reported, say, start_log

if TYPE_CHECKING:
    from rig.bench import BenchFactory, BenchPlan, Fixture, RunningBench
    from rig.clock import Clock
    from rig.recording.contents import JournalContents
    from rig.runner.lock import BenchLock
    from rig.runner.procedure import Procedure
    from rig.settings import Settings

Stages = Literal["festo", "az", "festo-az", "az-festo"]
"""Of a simulated bench: on Modbus TCP, or on one Modbus RTU line."""
BENCH_FILE = Path("bench.toml")
FIRST_TIME = "the first time on a computer it takes up to two minutes"
STARTING: dict[Fixture, str] = {
    "film-clamp": "film in its clamp",
    "plate": f"skin above its plate; {FIRST_TIME}",
    "semi-spherical-object": f"skin above a head on the rotary stage; {FIRST_TIME}",
}
LIBRARIES_OF_LINKS = ("pyvisa_py.highlevel", "pymodbus.client", "serial")
"""What the simulated bench's drivers import when they connect."""


@dataclass(frozen=True)
class Request:
    """The options that every procedure has."""

    bench: Path | None = None
    results: Path = Path("results")
    seed: int = 0
    dry_run: bool = False
    as_json: bool = False
    user: str = ""
    sample: str = ""
    notes: str = ""
    figures: bool = True
    allow_expired: bool = False
    stages: Stages | None = None
    world: Path | None = None
    fault: Path | None = None
    world_log: Path | None = None
    debug: bool = False


def _common(
    bench: Annotated[
        Path | None,
        typer.Option(help="Bench file; without one, ./bench.toml or the simulated bench."),
    ] = None,
    results: Annotated[Path, typer.Option(help="Folder for run files.")] = Path("results"),
    seed: Annotated[int, typer.Option(help="Seed of the simulated bench.", min=0)] = 0,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Check and rehearse on the simulated bench; no file.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
    user: Annotated[str, typer.Option(help="Who runs it.")] = "",
    sample: Annotated[str, typer.Option(help="What is on the bench.")] = "",
    notes: Annotated[str, typer.Option(help="Anything worth keeping.")] = "",
    figures: Annotated[bool, typer.Option(help="Draw the figures of the run.")] = True,
    allow_expired: Annotated[
        bool, typer.Option("--allow-expired", help="Use calibration records that have expired.")
    ] = False,
    stages: Annotated[
        Stages | None,
        typer.Option(help="Stages of a simulated bench, z and x: festo by default."),
    ] = None,
    world: Annotated[
        Path | None, typer.Option(help="World settings (TOML) of a simulated bench.")
    ] = None,
    fault: Annotated[
        Path | None, typer.Option(help="Fault plan (TOML) of a simulated bench.")
    ] = None,
    world_log: Annotated[
        Path | None, typer.Option(help="File for a simulated bench's own log.")
    ] = None,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Signature of the common options."""


def command(entry: EntryPoint) -> Callable[..., None]:
    """The command function of a procedure, with an option for each of its settings."""
    procedure: Procedure = entry.load()

    def run(**given: Any) -> None:
        request = Request(**{name: given.pop(name) for name in Request.__dataclass_fields__})
        with reported(request.debug, request.as_json):
            perform(procedure, settings_from(procedure.Settings, given), request)

    common = list(inspect.signature(_common, eval_str=True).parameters.values())
    own = parameters(procedure.Settings)
    common = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in common]
    run.__signature__ = inspect.Signature([*own, *common])  # type: ignore[attr-defined]
    run.__annotations__ = {p.name: p.annotation for p in (*own, *common)}
    return run


def perform(
    procedure: Procedure,
    settings: Settings,
    request: Request,
    resume: JournalContents | None = None,
) -> None:
    """Run a procedure on the bench that was asked for and end the process with its exit code."""
    from rig.cli.report import ConsoleReporter, finish, finish_dry_run
    from rig.cli.streams import say_at_once
    from rig.runner.stopping import StopFlag

    with ExitStack() as stack:
        # From here on, a signal ends things in order.
        stop = stack.enter_context(StopFlag(say_at_once))
        results = request.results
        if request.dry_run:
            results = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rig-dry-run-")))
        else:
            start_log(results)
        import_ahead = getattr(procedure, "import_ahead", _nothing)
        with stop.nothing_connected():
            bench = bench_for(request, stack, procedure.FIXTURES[0], import_ahead)
        from rig.runner.execution import execute
        from rig.runner.jobs import Job

        job = Job(
            procedure=procedure,
            settings=settings,
            seed=request.seed,
            results=results,
            user=request.user,
            sample=request.sample,
            notes=request.notes,
            resume=resume,
            allow_expired=request.allow_expired,
            recorded_toml=bench.recorded_toml,
            lock=bench.lock,
        )
        drawn = procedure.FIGURE if request.figures and not request.dry_run else None
        own = bench.started is not None
        reporter = stack.enter_context(ConsoleReporter(procedure.NAME, drawn, draws_ahead=own))
        outcome = execute(job, bench.plan, bench.clock, stop, reporter)
        if bench.started is not None:
            bench.started.wait()
        if request.dry_run:
            finish_dry_run(outcome, request.as_json)
        else:
            finish(procedure, outcome, request.as_json, reporter, request.debug)
    raise typer.Exit(int(outcome.code))


def _nothing() -> None:
    """What a procedure imports ahead that does not say."""


@dataclass(frozen=True)
class ChosenBench:
    """The bench that a command works on, not yet connected."""

    plan: BenchPlan
    clock: Clock
    lock: BenchLock | None = None
    """On its instruments, unless they are this command's own."""
    started: RunningBench | None = None
    """The simulated bench that was started for this command."""
    recorded_toml: str | None = None
    """Its bench file without the process's port numbers."""


def bench_for(
    request: Request,
    at_the_end: ExitStack,
    fixture: Fixture = "film-clamp",
    meanwhile: Callable[[], None] = _nothing,
    paced: bool = False,
) -> ChosenBench:
    """The bench file's plan with a wall clock, locked until `at_the_end`, or a started simulated
    bench, on which `fixture` is mounted, with its own clock, `paced` for a person. `meanwhile` is
    called before anything is connected, while that one boots."""
    path = request.bench or (BENCH_FILE if BENCH_FILE.exists() else None)
    started = None
    if path is None or request.dry_run:
        say(f"starting the simulated bench ({STARTING[fixture]}) ...")
        # It boots while this process goes on importing.
        started = _start_simulated(request, fixture)
    try:
        from rig.bench import read_bench

        real = read_bench(path) if path is not None else None
        if started is not None:
            return _simulated_bench(request, started, real, meanwhile, paced)
    except BaseException:
        if started is not None:
            started.abandon()
        raise
    assert path is not None
    assert real is not None
    return _real_bench(request, at_the_end, path, real, meanwhile)


def _real_bench(
    request: Request,
    at_the_end: ExitStack,
    path: Path,
    plan: BenchPlan,
    meanwhile: Callable[[], None],
) -> ChosenBench:
    from rig.clock import WallClock
    from rig.runner.guard import refuse_unsafe, report_path
    from rig.runner.lock import BenchLock

    _refuse_simulation_options(request, path)
    lock = at_the_end.enter_context(BenchLock(plan))
    _tell_killed(report_path(request.results, plan.settings.name))
    refuse_unsafe(request.results, plan.settings.name)
    if plan.settings.simulation is not None:
        say(f"SIMULATED bench ({path}): nothing here is measured")
    say(f"getting ready to connect to {', '.join(part.role for part in plan.instruments)} ...")
    _import_ahead()
    meanwhile()
    return ChosenBench(plan, WallClock(), lock)


def _simulated_bench(
    request: Request,
    started: RunningBench,
    real: BenchPlan | None,
    meanwhile: Callable[[], None],
    paced: bool,
) -> ChosenBench:
    from rig.bench import parse_bench, rehearsal
    from rig.clock import ControlLink, PacedClock, SlavedClock
    from rig.runner.guard import GUARD_SUFFIX

    _tell_killed(*sorted(request.results.glob(f"*/*{GUARD_SUFFIX}")))
    _import_ahead()
    meanwhile()
    ready = started.ready()
    why = "a rehearsal" if request.dry_run else "no bench.toml"
    say(f"SIMULATED bench ({why}, seed {request.seed}): nothing here is measured")
    plan = parse_bench(ready["bench_toml"], "the simulated bench")
    if real is not None:
        plan = rehearsal(real, plan)
    control = ControlLink(ready["control_port"])
    clock = PacedClock(control) if paced else SlavedClock(control)
    return ChosenBench(plan, clock, None, started, ready["recorded_toml"])


def _tell_killed(*reports: Path) -> None:
    from rig.runner.guard import tell_killed

    for report in reports:
        if (told := tell_killed(report)) is not None:
            say(told)


def _import_ahead() -> None:
    """What this command will need, while the simulated bench boots beside it."""
    for name in ("rig.recording.compiled", "rig.runner.execution", *LIBRARIES_OF_LINKS):
        import_module(name)


def _start_simulated(request: Request, fixture: Fixture) -> RunningBench:
    from importlib.metadata import entry_points

    (entry,) = entry_points(group="rig.benches", name="simulated")
    factory: BenchFactory = entry.load()
    return factory.start(
        {
            "fixture": fixture,
            **({} if request.stages is None else {"stages": request.stages}),
            "seed": request.seed,
            "world": _text(request.world),
            "fault": _text(request.fault),
            "world_log": _text(request.world_log),
            "results": str(request.results),
        }
    )


def _refuse_simulation_options(request: Request, path: Path | None) -> None:
    from rig.errors import ConfigurationError

    own = ("stages", "world", "fault", "world_log")
    given = [name for name in own if getattr(request, name) is not None]
    if given:
        options = ", ".join("--" + name.replace("_", "-") for name in given)
        raise ConfigurationError(
            f"{options} belongs to a simulated bench that this command starts, not to {path}",
            "give it to `rig simulate`, or leave the bench file out",
        )


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)
