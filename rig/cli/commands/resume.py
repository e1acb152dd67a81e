"""The command ``rig resume``, which measures the rest of an interrupted run."""

from __future__ import annotations

import contextlib
import json
import tempfile
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from rig.cli.options.shared import AllowExpired, AsJson, Debug, WorldLog
from rig.cli.outcome import reported
from rig.core.errors import ConfigurationError, finding


def resume(
    file: Annotated[
        Path, typer.Argument(help="Journal or run file of the interrupted run.", metavar="FILE")
    ],
    as_json: AsJson = False,
    figures: Annotated[bool, typer.Option(help="Draw the figures of the run.")] = True,
    allow_expired: AllowExpired = False,
    world_log: WorldLog = None,
    debug: Debug = False,
) -> None:
    """Resume an interrupted run at the point where it was interrupted."""
    with reported(debug, as_json):
        from pydantic import ValidationError

        from rig.cli.commands.procedures import ProcedureRequest, perform
        from rig.cli.show.digest import not_usable
        from rig.core.entry_points import PROCEDURES, names
        from rig.files.naming import results_folder_of
        from rig.files.runfile.recover import interrupted
        from rig.run.load_procedure import load_procedure

        contents = interrupted(file)
        header = contents.header
        if header.procedure not in names(PROCEDURES):
            version = f" {header.procedure_version}" if header.procedure_version else ""
            raise ConfigurationError(
                f"{file}: procedure {not_usable(header)}",
                f"install {header.procedure_package or 'the package that has it'}{version}",
            )
        try:
            procedure = load_procedure(header.procedure)
        except ConfigurationError as error:
            raise ConfigurationError(f"{file}: {error.message}", error.hint) from error
        try:
            settings = procedure.Settings.model_validate_json(json.dumps(header.settings))
        except ValidationError as error:
            found = "; ".join(map(finding, error.errors()))
            raise ConfigurationError(
                f"{file}: procedure {header.procedure} does not take the settings of this run "
                f"here: {found}",
                "install what is missing, or restore the version that began the run",
            ) from error
        with _world_of(header.bench_toml) as (world, stages):
            bench_file = None if world is not None else Path(header.bench_file)
            if bench_file is not None and not bench_file.exists():
                raise ConfigurationError(
                    f"{file}: the bench file of this run, {bench_file}, does not exist"
                    + ("" if bench_file.is_absolute() else f" in {Path.cwd()}"),
                    "give the command in the folder in which the run began, or put the file there",
                )
            request = ProcedureRequest(
                bench=bench_file,
                results=results_folder_of(contents.path),
                seed=header.seed,
                user=header.user.name,
                sample=header.sample.name,
                notes=header.notes,
                accept=header.accepted or None,
                as_json=as_json,
                figures=figures,
                stages=stages,
                world=world,
                allow_expired=allow_expired,
                world_log=world_log,
                debug=debug,
            )
            perform(procedure(settings), request, resume=contents)


@contextlib.contextmanager
def _world_of(bench_toml: str) -> Iterator[tuple[Path | None, str | None]]:
    """Write the World settings of a run to a file again; yield the file and the stages.

    This is for a bench that the run's command had started. Yield None for any other bench, whose
    file is read from where it was.
    """
    from rig.core.toml_files import toml_value

    # Not as a bench file of today: an earlier version may have taken what is refused now.
    simulation = dict(tomllib.loads(bench_toml).get("simulation") or {})
    if not simulation or ("::0::" not in bench_toml and ",0::" not in bench_toml):
        yield None, None
        return
    simulation.pop("seed", None)
    simulation.pop("world", None)
    stages = simulation.pop("stages", None)
    with tempfile.NamedTemporaryFile("w", suffix=".toml", encoding="utf-8") as file:
        file.write("".join(f"{key} = {toml_value(value)}\n" for key, value in simulation.items()))
        file.flush()
        yield Path(file.name), stages
