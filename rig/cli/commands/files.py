"""The commands ``rig verify``, which checks files, and ``rig recover``, which rebuilds them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rig.cli.options.shared import AnyFiles, Debug
from rig.cli.outcome import reported, say
from rig.core.errors import ExitCode, FoundWrongError, RigError
from rig.core.text import printable

ToRecover = Annotated[
    list[Path],
    typer.Argument(help="Journals (.rigj), or run files of interrupted runs.", metavar="FILE"),
]


def verify(files: AnyFiles, debug: Debug = False) -> None:
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
