"""The command of a procedure: options to a job, the job to a bench, the outcome to the terminal."""

from __future__ import annotations

import contextlib
import inspect
import sys
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rig.cli.options.groups import group_parameters, option_group
from rig.cli.options.settings import SimulatedStages, parameters, settings_from, texts_of
from rig.cli.options.shared import (
    RESULTS,
    AllowExpired,
    AsJson,
    BenchFile,
    Debug,
    Fault,
    Notes,
    RunFolder,
    Seed,
    World,
    WorldLog,
)
from rig.cli.options.utf8 import as_utf8
from rig.cli.outcome import reported, say, start_log, turning
from rig.core.errors import ConfigurationError
from rig.run.bench_selector import BenchRequest, BenchSelector, bench_file, refuse_seed

if TYPE_CHECKING:
    from rig.files.journal.reader import JournalContents
    from rig.run.procedure import Procedure

STORED_TEXTS = ("user", "sample", "notes", "accept")
"""Options of a procedure whose texts are stored in the run file."""


@option_group
class ProcedureRequest(BenchRequest):
    """Options that every procedure has."""

    bench: BenchFile = None
    results: RunFolder = RESULTS
    seed: Seed = 0
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run",
            help="Check the settings and run the procedure on a simulated bench; nothing is saved.",
        ),
    ] = False
    stages: SimulatedStages = None
    world: World = None
    fault: Fault = None
    world_log: WorldLog = None
    as_json: AsJson = False
    user: Annotated[str, typer.Option(help="Name of the person who runs it.", metavar="NAME")] = ""
    sample: Annotated[str, typer.Option(help="Sample on the bench.", metavar="NAME")] = ""
    notes: Notes = ""
    accept: Annotated[
        str | None,
        typer.Option(
            metavar="REASON",
            help="Accept a press that does not fit earlier runs, and make it the reference.",
        ),
    ] = None
    figures: Annotated[bool, typer.Option(help="Draw the figures of the run.")] = True
    allow_expired: AllowExpired = False
    debug: Debug = False


def command(name: str) -> Callable[..., None]:
    """Return the command function of a procedure, with an option for each of its settings.

    Raises ConfigurationError if the procedure cannot be used.
    """
    from rig.run.load_procedure import load_procedure

    procedure = load_procedure(name)

    def run(**given: Any) -> None:
        options = {name: given.pop(name) for name in ProcedureRequest.__dataclass_fields__}
        request = ProcedureRequest(**options | {"bench": bench_file(options["bench"])})
        with reported(request.debug, request.as_json):
            for text in STORED_TEXTS:
                as_utf8(f"--{text}", getattr(request, text) or "", "a run file")
            if request.accept is not None and not request.accept.strip():
                raise ConfigurationError(
                    f"--accept {request.accept!r}: must be a reason, which the run file states",
                    "write why the press is to be the reference, or leave --accept out",
                )
            refuse_seed(request)
            settings = settings_from(procedure.Settings, texts_of(procedure.Settings, given))
            perform(procedure(settings), request)

    options = [*parameters(procedure.Settings), *group_parameters(ProcedureRequest)]
    run.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
    run.__annotations__ = {option.name: option.annotation for option in options}
    return run


def perform(
    procedure: Procedure,
    request: ProcedureRequest,
    resume: JournalContents | None = None,
) -> None:
    """Run a procedure, made with its settings, on the bench that was asked for, and end the process
    with the run's exit code."""
    from rig.cli.report import ConsoleObserver, finish, finish_dry_run
    from rig.cli.streams import leave_at_once, say_at_once
    from rig.core.threads import thread_remains
    from rig.figures.drawing import DrawingProcess
    from rig.run.stopping import StopFlag

    with ExitStack() as stack:
        # From here on, a signal ends things in order.
        stop = stack.enter_context(StopFlag(say_at_once))
        results = request.results
        if request.dry_run:
            results = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rig-dry-run-")))
            _check_records(request)
        else:
            start_log(results)
        with stop.nothing_connected():
            selector = BenchSelector(
                say,
                waiting=lambda: turning("the simulated bench is starting"),
                while_it_boots=lambda: _import_for(procedure),
            )
            bench = selector.select(request, stack, procedure.fixtures[0])
        from rig.run.execute import execute
        from rig.run.job import RunJob

        job = RunJob(
            procedure=procedure,
            seed=request.seed,
            results=results,
            user=request.user,
            sample=request.sample,
            notes=request.notes,
            accept=request.accept or "",
            resume=resume,
            collection=None if resume is None else resume.header.collection,
            run_number=0 if resume is None else resume.header.run_number,
            allow_expired=request.allow_expired,
            recorded_toml=bench.recorded_toml,
            lock=bench.lock,
        )
        simulated = bench.plan.settings.simulation is not None
        drawing = None
        if request.figures and not request.dry_run:
            drawing = stack.enter_context(DrawingProcess())
        with (
            contextlib.redirect_stdout(sys.stderr),  # what a driver prints is not for stdout
            ConsoleObserver(type(procedure), simulated=simulated) as console,
        ):
            outcome = execute(job, bench.plan, bench.clock, stop, console)
            if bench.lock is not None:
                # The bench is safe, or its guard has it. What is printed next may have to wait for
                # a terminal that is held, and figures take their time.
                bench.lock.release()
        if bench.started is not None:
            bench.started.wait()
        if request.dry_run:
            finish_dry_run(type(procedure), outcome, request.as_json, request.debug)
        else:
            finish(type(procedure), outcome, request.as_json, drawing, request.debug)
    if thread_remains(say):
        leave_at_once(int(outcome.code))
    raise typer.Exit(int(outcome.code))


def _import_for(procedure: Procedure) -> None:
    """Import what a run of a procedure needs, which takes about half a second."""
    import rig.run.execute  # noqa: F401
    from rig.run.checked_procedure import CheckedProcedure

    CheckedProcedure(procedure).import_ahead()


def _check_records(request: ProcedureRequest) -> None:
    """Check the calibration records of the bench file in a dry run, whose simulated bench uses none
    of them."""
    if request.bench is None:
        return
    from datetime import datetime

    from rig.bench.apply_calibrations import check_records
    from rig.bench.plan import read_bench

    now = datetime.now().astimezone()
    for warning in check_records(read_bench(request.bench), now, request.allow_expired):
        say(f"warning: {warning}")
