"""The commands ``rig verify``, which checks files, and ``rig recover``, which rebuilds them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.outcome import reported, say
from rig.core.errors import ExitCode, FoundWrongError, RigError
from rig.core.text import printable

Files = Annotated[
    list[Path],
    typer.Argument(
        help="Run files, processed files, files of rig skin (.h5) or journals (.rigj).",
        metavar="FILE",
    ),
]
ToRecover = Annotated[
    list[Path],
    typer.Argument(help="Journals (.rigj), or run files of interrupted runs.", metavar="FILE"),
]
Debug = Annotated[bool, typer.Option("--debug", help="Show tracebacks.")]


def verify(files: Files, debug: Debug = False) -> None:
    """Check run files, processed files and journals; exit 8 if something is wrong.

    Checks checksums, structure and completeness.
    """
    with reported(debug):
        from rig.cli.show.digest import noun_of
        from rig.files.verify import safe_verdict

        wrong = 0
        for path in files:
            found = safe_verdict(path, noun_of)
            wrong += not found.sound
            print(printable(f"{path}: {found}"))  # noqa: T201 - stdout carries data
        if wrong:
            of = f"{len(files)} files" if len(files) > 1 else "1 file"
            raise FoundWrongError(f"{wrong} of {of} failed verification")


def recover(files: ToRecover, debug: Debug = False) -> None:
    """Rebuild the run file of a crashed run from its journal."""
    with reported(debug):
        from rig.files.runfile.recover import recover as rebuild

        failed: RigError | None = None
        for path in files:
            try:
                print(rebuild(path))  # noqa: T201 - stdout carries data
            except RigError as error:
                say(f"error: {error.one_line()}")
                failed = failed or error
        if failed is not None:
            raise typer.Exit(int(failed.code or ExitCode.INTERNAL))
