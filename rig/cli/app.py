"""The application ``rig``: its commands, put together so that ``rig --help`` imports next to
nothing.

A procedure's options come from its settings, whose classes are expensive to import. Only the
procedure that was asked for is therefore imported; the others show the first line of their module's
docstring, read from the source.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path

import typer

from rig.cli import (
    batch,
    calibrate,
    detect,
    files,
    imports,
    jog,
    low_pass,
    score,
    simulate,
    skin,
    train,
)
from rig.cli.outcome import report
from rig.errors import ConfigurationError
from rig.imports import importing

COMMANDS: dict[str, Callable[..., None]] = {
    "resume": files.resume,
    "show": files.show,
    "verify": files.verify,
    "recover": files.recover,
    "import": imports.import_,
    "detect": detect.detect,
    "filter": low_pass.filter_,
    "simulate": simulate.simulate,
    "jog": jog.jog,
    "score": score.score,
    "train": train.train,
    "make-safe": simulate.make_safe,
}

HELP = """Tactile bench controller: sweeps, slip and roll trials, calibrations, and their files.

Without a bench file (--bench FILE, or bench.toml here) a command runs on the simulated bench and
says so.
"""


def perform(arguments: Sequence[str]) -> None:
    """Perform a command line and end the process with its exit code.

    With ``--json`` stdout carries an object for one that cannot be understood, too.
    """
    if "--json" not in arguments:
        build(arguments)(arguments)
        return
    try:
        code = build(arguments)(arguments, standalone_mode=False)
    except typer.TyperException as error:
        hint = "see rig --help"
        code = report(ConfigurationError(error.format_message(), hint), as_json=True)
    sys.exit(code)


def build(arguments: Sequence[str]) -> typer.Typer:
    """The application for this command line."""
    app = typer.Typer(
        name="rig",
        help=HELP,
        no_args_is_help=True,
        add_completion=False,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
    )
    asked = next((word for word in arguments if not word.startswith("-")), None)
    for procedure in entry_points(group="rig.procedures"):
        function: Callable[..., None] = _not_asked
        if procedure.name == asked:
            with importing():
                from rig.cli.procedures import command

                function = command(procedure)
        _add(app, procedure.name, summary(procedure), function)
    for name, function in COMMANDS.items():
        _add(app, name, (function.__doc__ or "").split("\n", 1)[0], function)
    app.add_typer(batch.app, name="batch", short_help=batch.HELP)
    app.add_typer(calibrate.app, name="calibrate", short_help=calibrate.HELP)
    app.add_typer(skin.app, name="skin", short_help=skin.HELP)
    return app


def _add(app: typer.Typer, name: str, text: str, function: Callable[..., None]) -> None:
    app.command(name, help=text, short_help=text)(function)


def summary(procedure: EntryPoint) -> str:
    """First line of the docstring of a procedure's module, without importing the module."""
    spec = find_spec(procedure.module)
    if spec is None or spec.origin is None:
        return ""
    docstring = ast.get_docstring(ast.parse(Path(spec.origin).read_text(encoding="utf-8")))
    return (docstring or "").strip().split("\n", 1)[0]


def _not_asked() -> None:
    """Stands in the list of commands for a procedure that another command line asks for."""
