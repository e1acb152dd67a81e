"""Commands about run files: resume, show, verify, recover."""

from __future__ import annotations

import contextlib
import json
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from rig.cli.outcome import printable, reported, say
from rig.errors import ConfigurationError, ExitCode, FoundWrongError

Files = Annotated[list[Path], typer.Argument(help="Run files (.h5) or journals (.rigj).")]
Debug = Annotated[bool, typer.Option("--debug", help="Show tracebacks.")]


def resume(
    file: Annotated[Path, typer.Argument(help="Journal or run file of the interrupted run.")],
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
    figures: Annotated[bool, typer.Option(help="Draw the figure of the run.")] = True,
    world_log: Annotated[
        Path | None, typer.Option(help="File for a simulated bench's own log.")
    ] = None,
    debug: Debug = False,
) -> None:
    """Go on with an interrupted run at the point where it was interrupted."""
    with reported(debug, as_json):
        from pydantic import ValidationError

        from rig.bench import entry
        from rig.cli.procedures import Request, perform
        from rig.recording.contents import read_journal
        from rig.recording.naming import RUN_SUFFIX, journal_path, results_of

        journal = journal_path(file) if file.suffix == RUN_SUFFIX else file
        if not journal.exists() and journal.with_suffix(RUN_SUFFIX).exists():
            raise ConfigurationError(f"{file}: the run is complete; there is nothing to resume")
        contents = read_journal(journal)
        header = contents.header
        if contents.complete:
            raise ConfigurationError(f"{file}: the run is complete; there is nothing to resume")
        found = entry("rig.procedures", header.procedure)
        if found is None:
            raise ConfigurationError(f"{file}: procedure {header.procedure!r} is not installed")
        procedure = found.load()
        try:
            settings = procedure.Settings.model_validate_json(json.dumps(header.settings))
        except ValidationError as error:
            raise ConfigurationError.from_validation(error, str(file)) from error
        with _world_of(header.bench_toml, str(file)) as world:
            bench_file = None if world is not None else Path(header.bench_file)
            request = Request(
                bench=bench_file,
                results=results_of(journal),
                seed=header.seed,
                as_json=as_json,
                figures=figures,
                world=world,
                world_log=world_log,
                debug=debug,
            )
            perform(procedure, settings, request, resume=contents)


def show(files: Files, debug: Debug = False) -> None:
    """Say what a run file holds, and draw its figure again."""
    with reported(debug):
        from rig.figures import draw
        from rig.recording.runfile import RunFile
        from rig.recording.verify import verify_apart

        for path in files:
            verify_apart(path)  # for a file that HDF5 would die of
            with RunFile.open(path) as run:
                for name, value in run.summary().items():
                    print(printable(f"{name}: {value}"))  # noqa: T201 - stdout carries data
                figure = run.header.procedure.replace("-", "_")
                has_points = bool(run.point_ids())
            if has_points:
                for drawn in draw(figure, path):
                    print(f"figure: {drawn}")  # noqa: T201 - stdout carries data


def verify(files: Files, debug: Debug = False) -> None:
    """Check run files: checksums, structure, completeness; exit 8 where something is wrong."""
    with reported(debug):
        from rig.recording.errors import RunFileError
        from rig.recording.verify import verify_apart

        wrong = 0
        for path in files:
            try:
                findings = verify_apart(path)
            except RunFileError as error:
                findings = [error.reason]
            wrong += bool(findings)
            verdict = "; ".join(findings) if findings else "sound"
            print(printable(f"{path}: {verdict}"))  # noqa: T201 - stdout carries data
        if wrong:
            raise FoundWrongError(f"{wrong} of {len(files)} files are not sound")


def recover(files: Files, debug: Debug = False) -> None:
    """Compile what a killed run left behind into its run file."""
    with reported(debug):
        from rig.errors import RigError
        from rig.recording.recover import recover as compile_left_over

        failed: RigError | None = None
        for path in files:
            try:
                print(compile_left_over(path))  # noqa: T201 - stdout carries data
            except RigError as error:
                say(f"error: {error.one_line()}")
                failed = failed or error
        if failed is not None:
            raise typer.Exit(int(failed.code or ExitCode.INTERNAL))


@contextlib.contextmanager
def _world_of(bench_toml: str, source: str) -> Iterator[Path | None]:
    """The World settings of a run on a bench that its command had started, as a file again.

    None for any other bench: that one's file is read from where it was.
    """
    from rig.bench import parse_bench

    plan = parse_bench(bench_toml, f"{source}: its bench file")
    simulation = dict(plan.settings.simulation or {})
    if not simulation or ("::0::" not in bench_toml and ",0::" not in bench_toml):
        yield None
        return
    simulation.pop("seed", None)
    with tempfile.NamedTemporaryFile("w", suffix=".toml", encoding="utf-8") as file:
        file.write("".join(f"{key} = {json.dumps(value)}\n" for key, value in simulation.items()))
        file.flush()
        yield Path(file.name)
