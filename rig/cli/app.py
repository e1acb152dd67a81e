"""The application ``rig``: its commands, put together so that ``rig --help`` imports next to
nothing.

Only what was asked for is imported. A procedure's options come from its settings, whose classes are
expensive; the others show the first line of their module's docstring, read from the source.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from importlib import import_module

import typer

from rig.cli.outcome import printable, report, say
from rig.core.entry_points import PROCEDURES, BrokenPackageError, names, summary
from rig.core.errors import ConfigurationError, RigError

COMMANDS: dict[str, tuple[str, str, str]] = {
    "resume": (
        "rig.cli.files",
        "resume",
        "Resume an interrupted run at the point where it was interrupted.",
    ),
    "show": (
        "rig.cli.files",
        "show",
        "Show what a run file, processed file or journal holds, and draw its figures again.",
    ),
    "verify": (
        "rig.cli.files",
        "verify",
        "Check run files, processed files and journals; exit 8 if something is wrong.",
    ),
    "recover": (
        "rig.cli.files",
        "recover",
        "Rebuild the run file of a crashed run from its journal.",
    ),
    "import": (
        "rig.cli.imports",
        "import_",
        "Make a run file of another program's recording: CSV, text in columns, LVM, MATLAB.",
    ),
    "detect": (
        "rig.cli.detect",
        "detect",
        "Find incipient slips in run files and write the results to processed files.",
    ),
    "filter": (
        "rig.cli.low_pass",
        "filter_",
        "Design the low-pass filter of the predictive signal and draw its curves (Figure 14).",
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
        "Score detectors on trials whose truth is known: slips found, false alarms, delays.",
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
        "Simulate the finger skin: slides, rolls, the paper's section 4.2, places for the strips.",
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
    as_json = "--json" in arguments
    try:
        app = build(arguments)
    except RigError as error:
        sys.exit(report(error, "--debug" in arguments, as_json))
    if not as_json:
        app(arguments)
        return
    try:
        code = app(arguments, standalone_mode=False)
    except typer.TyperException as error:
        hint = "see rig --help"
        code = report(ConfigurationError(error.format_message(), hint), as_json=True)
    sys.exit(code)


def build(arguments: Sequence[str]) -> typer.Typer:
    """The application for this command line; ConfigurationError where the procedure that it asks
    for cannot be used. Procedures that are broken and not asked for are listed as unavailable."""
    app = typer.Typer(
        name="rig",
        help=HELP,
        no_args_is_help=True,
        add_completion=False,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
    )
    asked = next((word for word in arguments if not word.startswith("-")), None)
    installed = names(PROCEDURES)
    own = (*COMMANDS, *GROUPS)
    listed = asked not in own and asked not in installed
    for name in installed:
        if name in own:  # a package does not replace a command of the program
            if asked is None:
                say(f"warning: a procedure {name!r} is installed, which is the name of a command")
            continue
        function: Callable[..., None] = _not_asked
        if name == asked:
            from rig.cli.procedures import command

            function = command(name)
        _add(app, name, _summary(name) if listed or name == asked else "", function)
    for name, (module, function_name, text) in COMMANDS.items():
        function = getattr(import_module(module), function_name) if name == asked else _not_asked
        _add(app, name, text, function)
    for name, (module, text) in GROUPS.items():
        if name == asked:
            app.add_typer(import_module(module).app, name=name, short_help=text)
        else:
            _add(app, name, text, _not_asked)
    return app


def _add(app: typer.Typer, name: str, text: str, function: Callable[..., None]) -> None:
    app.command(name, help=text, short_help=text)(function)


def _summary(name: str) -> str:
    """What the list of commands says of a procedure, without importing it."""
    try:
        return summary(PROCEDURES, name)
    except BrokenPackageError as error:
        return printable(f"(unavailable: {error.package}: {error.reason})")
    except ConfigurationError as error:
        return printable(f"(unavailable: {error.message})")


def _not_asked() -> None:
    """Stands in the list of commands for what another command line asks for."""
