"""The application ``rig``: its commands, put together so that ``rig --help`` imports next to
nothing.

Only what was asked for is imported. A procedure's options come from its settings, whose classes are
expensive; the others show the first line of their module's docstring, read from the source.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from importlib.util import find_spec
from pathlib import Path

import typer

from rig.cli.outcome import report
from rig.core.errors import ConfigurationError

COMMANDS: dict[str, tuple[str, str, str]] = {
    "resume": (
        "rig.cli.files",
        "resume",
        "Go on with an interrupted run at the point where it was interrupted.",
    ),
    "show": (
        "rig.cli.files",
        "show",
        "Say what a run file, processed file or journal holds; draw a file's figures again.",
    ),
    "verify": (
        "rig.cli.files",
        "verify",
        "Check run files, processed files and journals; exit 8 where something is wrong.",
    ),
    "recover": (
        "rig.cli.files",
        "recover",
        "Compile what a killed run left behind into its run file.",
    ),
    "import": (
        "rig.cli.imports",
        "import_",
        "Make a run file of a recording from elsewhere: CSV, text in columns, LVM, MATLAB.",
    ),
    "detect": (
        "rig.cli.detect",
        "detect",
        "Look for incipient slips in run files; what is found goes into processed files.",
    ),
    "filter": (
        "rig.cli.low_pass",
        "filter_",
        "Design the low-pass of the predictive signal: its numbers, its curves, Figure 14.",
    ),
    "simulate": (
        "rig.cli.simulate",
        "simulate",
        "Serve the simulated bench in real time and print the bench file that drives it.",
    ),
    "jog": (
        "rig.cli.jog",
        "jog",
        "Move an axis by keys: small slow steps, stopped when the key is let go.",
    ),
    "score": (
        "rig.cli.score",
        "score",
        "Score detectors on trials whose truth is known: found, false alarms, delays, prediction.",
    ),
    "train": (
        "rig.cli.train",
        "train",
        "Train the network of the detector `rig` on simulated trials whose truth is known.",
    ),
    "make-safe": (
        "rig.cli.simulate",
        "make_safe",
        "Bring every instrument of a bench to rest, whatever state it was left in.",
    ),
}
"""Module, function, and the first line of its docstring: only the one that is asked for is
imported."""

GROUPS: dict[str, tuple[str, str]] = {
    "batch": ("rig.cli.batch", "Overnight batches: a file of many runs, each taken exactly once."),
    "calibrate": (
        "rig.cli.calibrate",
        "Make calibration records: a film from a sweep's file, sensors from known weights.",
    ),
    "skin": (
        "rig.cli.skin",
        "Simulate the finger skin: slides, rolls, the paper's 4.2, where strips belong.",
    ),
}
"""Module with its ``app``, and its ``HELP``."""

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
            from rig.cli.procedures import command

            function = command(procedure)
        _add(app, procedure.name, summary(procedure), function)
    for name, (module, function_name, text) in COMMANDS.items():
        own = getattr(import_module(module), function_name) if name == asked else _not_asked
        _add(app, name, text, own)
    for name, (module, text) in GROUPS.items():
        if name == asked:
            app.add_typer(import_module(module).app, name=name, short_help=text)
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
    docstring = ast.get_docstring(ast.parse(Path(spec.origin).read_text(encoding="utf-8")))
    return (docstring or "").strip().split("\n", 1)[0]


def _not_asked() -> None:
    """Stands in the list of commands for what another command line asks for."""
