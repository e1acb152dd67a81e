"""The application ``rig``: its commands, put together so that ``rig --help`` comes at once.

The modules of commands import what is expensive inside their commands. Typer reads the types of
every option it is given, for which it imports pydantic; so it gets the function of the command that
was asked for, and of the others only a line for the list. A procedure's settings are classes of
pydantic, so a procedure that was not asked for is not imported: the first line of its module's
docstring is read from the source.
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
from rig.core.errors import ConfigurationError

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
"""Commands in the order of the help, each described by the first line of its docstring."""

GROUPS: dict[str, tuple[typer.Typer, str]] = {
    "batch": (batch.app, batch.HELP),
    "calibrate": (calibrate.app, calibrate.HELP),
    "skin": (skin.app, skin.HELP),
}
"""Groups of commands with their description."""

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
        if procedure.name == asked:
            from rig.cli.procedures import command

            _add(app, procedure.name, summary(procedure), command(procedure))
        else:
            _add(app, procedure.name, summary(procedure), _not_asked)
    for name, function in COMMANDS.items():
        text = _first_line(function.__doc__)
        _add(app, name, text, function if name == asked else _not_asked)
    for name, (group, text) in GROUPS.items():
        if name == asked:
            app.add_typer(group, name=name, short_help=text)
        else:
            _add(app, name, text, _not_asked)
    return app


def _add(app: typer.Typer, name: str, text: str, function: Callable[..., None]) -> None:
    app.command(name, help=text, short_help=text)(function)


def summary(procedure: EntryPoint) -> str:
    """First line of the docstring of a procedure's module, without importing the module."""
    spec = find_spec(procedure.module)
    if spec is None or spec.origin is None:
        return ""
    source = Path(spec.origin).read_text(encoding="utf-8")
    return _first_line(ast.get_docstring(ast.parse(source)))


def _first_line(docstring: str | None) -> str:
    return (docstring or "").strip().split("\n", 1)[0]


def _not_asked() -> None:
    """Stands in the list of commands for what another command line asks for."""
