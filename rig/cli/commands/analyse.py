"""The command ``rig analyse``, which saves what the installed analyses compute of run files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.options.shared import Debug, ProcessedFolder
from rig.cli.outcome import reported, say_failure
from rig.cli.show.words import value_lines
from rig.core.errors import ConfigurationError, ExitCode
from rig.core.text import printable


def analyse(
    files: Annotated[list[Path], typer.Argument(help="Run files (.h5).", metavar="FILE")],
    to: ProcessedFolder = None,
    debug: Debug = False,
) -> None:
    """Compute the values of the installed analyses and save them.

    `rig show` computes and shows the same values, and saves nothing.
    """
    with reported(debug):
        from rig.cli.show.results import analysed
        from rig.files.errors import RunFileError
        from rig.files.runfile.reader import RunFile
        from rig.processing.analyses import analyse as compute
        from rig.processing.analyses import keep

        nothing_of: list[str] = []
        hint = None
        unusable: list[RunFileError] = []
        for path in files:
            try:
                opened = RunFile.open(path)
            except RunFileError as error:  # those behind it are analysed all the same
                if len(files) == 1:
                    raise
                say_failure(error, debug)
                unusable.append(error)
                continue
            with opened as run:
                analyses = compute(run)
                for line in value_lines(analysed(analyses, debug)):
                    print(printable(line))  # noqa: T201 - stdout carries data
                if analyses.found:
                    print(printable(f"saved {keep(run, analyses, to)}"))  # noqa: T201 - data
                    continue
                named = f"{path} (a {run.header.procedure})"
                if analyses.tracebacks:
                    nothing_of.append(f"{named}: its analysis failed (see above)")
                    hint = hint or "correct the package that is named above; --debug shows more"
                elif not run.point_ids():
                    nothing_of.append(f"{named}: no point was completed")
                else:
                    nothing_of.append(named)
                    hint = "install a package with an analysis for it: see docs/add-an-analysis.md"
        if nothing_of:
            raise ConfigurationError(f"nothing was computed for {', '.join(nothing_of)}", hint)
        if unusable:
            some = len(unusable) < len(files)
            raise typer.Exit(int(ExitCode.FINISHED_WITH_FAILURES if some else unusable[0].code))
