"""The application ``rig``: its commands, assembled so that ``rig --help`` is fast.

The modules of commands import what is expensive inside their commands. Typer reads the types of
every option it is given, for which it imports pydantic; so it gets the function of the given
command only, and for the others one line of the list, read without running their modules.
"""

from __future__ import annotations

import inspect
import os
import sys
import time
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.abc import InspectLoader
from importlib.util import find_spec
from types import CodeType

import typer

from rig.cli.outcome import report, say
from rig.core import unreadable_packages
from rig.core.entry_points import (
    OWN_PACKAGE,
    PROCEDURES,
    BrokenPackageError,
    names,
    packages_of,
    summary,
)
from rig.core.errors import ConfigurationError, RigError
from rig.core.text import printable

COMMANDS: dict[str, tuple[str, str]] = {
    "resume": ("rig.cli.commands.resume", "resume"),
    "show": ("rig.cli.commands.show", "show"),
    "analyse": ("rig.cli.commands.analyse", "analyse"),
    "verify": ("rig.cli.commands.files", "verify"),
    "recover": ("rig.cli.commands.files", "recover"),
    "import": ("rig.cli.commands.imports", "import_"),
    "detect": ("rig.cli.commands.detect", "detect"),
    "detectors": ("rig.cli.commands.detectors", "detectors"),
    "filter": ("rig.cli.commands.low_pass", "filter_"),
    "simulate": ("rig.cli.commands.simulate", "simulate"),
    "jog": ("rig.cli.commands.jog", "jog"),
    "score": ("rig.cli.commands.score", "score"),
    "train": ("rig.cli.commands.train", "train"),
    "regrip-study": ("rig.cli.commands.regrip_study", "regrip_study"),
    "page": ("rig.cli.commands.page", "page"),
    "monitor": ("rig.cli.commands.monitor", "monitor"),
    "make-safe": ("rig.cli.commands.make_safe", "make_safe"),
}
"""Commands in the order of the help, each described by the first line of its docstring."""

GROUPS: dict[str, str] = {
    "batch": "rig.cli.commands.batch",
    "calibrate": "rig.cli.commands.calibrate",
    "interlocks": "rig.cli.commands.interlocks",
    "skin": "rig.cli.commands.skin",
}
"""Groups of commands: modules with an ``app``, described by the first line of their docstring."""

DAY_S = 86_400
"""Times can be stored with an offset from UTC of less than a day only."""

HELP = """Tactile bench controller: sweeps, slip and roll trials, calibrations, and their files.

Without a bench file (--bench FILE, or bench.toml here) a command runs on the simulated bench and
says so. "Paper 4.1" is section 4.1 of the paper by Yamada, Maeno et al.
"""


def perform(arguments: Sequence[str]) -> None:
    """Perform a command line and end the process with its exit code.

    With ``--json`` stdout gets an object even for a command line that cannot be parsed.
    """
    as_json = "--json" in arguments
    _use_time_zone()
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
        code = report(ConfigurationError(error.format_message().rstrip("."), hint), as_json=True)
    sys.exit(code)


def _use_time_zone() -> None:
    """Use UTC, in this process and those that it starts, if the time zone of the computer is a day
    or more away from it: no command may fail because of that, least of all `rig make-safe`."""
    if max(abs(time.timezone), abs(time.altzone)) < DAY_S:
        return
    zone = f"TZ={printable(os.environ['TZ'])}" if "TZ" in os.environ else "the computer's time zone"
    os.environ["TZ"] = "UTC"
    time.tzset()
    say(f"warning: {zone} is a day or more away from UTC, so times are given in UTC; correct it")


def build(arguments: Sequence[str]) -> typer.Typer:
    """Return the application for this command line. Raises ConfigurationError if its procedure
    cannot be used. Other procedures that are broken are listed as unavailable."""
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
    for line in unreadable_packages.warnings():
        say(f"warning: {printable(line)}")
    own = (*COMMANDS, *GROUPS)
    listed = asked not in own and asked not in installed
    for name in installed:
        # A package must not replace a command or a procedure of this program.
        packages = packages_of(PROCEDURES, name)
        if asked is None and (name in own or OWN_PACKAGE in packages):
            for other in (one for one in packages if one != OWN_PACKAGE):
                say(
                    f"warning: the procedure {name!r} of the package {printable(other)} is left "
                    f"out: rig has a command {name!r} already; rename it there"
                )
        if name in own:
            continue
        function: Callable[..., None] = _not_asked
        if name == asked:
            from rig.cli.commands.procedures import command

            function = command(name)
        _add(app, name, _summary(name) if listed or name == asked else "", function)
    # A command imports its own module only: `rig make-safe` depends on no other.
    for name, (module, function_name) in COMMANDS.items():
        if name == asked:
            function = getattr(import_module(module), function_name)
            _add(app, name, _first_line(function.__doc__), function)
        else:
            _add(app, name, first_line_in(module, function_name) if listed else "", _not_asked)
    for name, module in GROUPS.items():
        text = first_line_in(module) if listed or name == asked else ""
        if name == asked:
            app.add_typer(import_module(module).app, name=name, short_help=text)
        else:
            _add(app, name, text, _not_asked)
    return app


def _add(app: typer.Typer, name: str, text: str, function: Callable[..., None]) -> None:
    """Add a command with its line in the list; its own help is the whole docstring, if any."""
    whole = function.__doc__ if function is not _not_asked else None
    app.command(name, help=inspect.cleandoc(whole or text), short_help=text)(function)


def _summary(name: str) -> str:
    """Return the line of a procedure in the list of commands, without importing it."""
    try:
        return summary(PROCEDURES, name)
    except BrokenPackageError as error:
        return printable(f"(unavailable: {error.package}: {error.reason})")
    except ConfigurationError as error:
        return printable(f"(unavailable: {error.message})")


def first_line_in(module: str, function_name: str | None = None) -> str:
    """Return the first line of the docstring of a module of this package, or of a function in it.

    The module is compiled, or read as it was compiled before, but not run: what all of them import
    would take most of the time of ``rig --help``.
    """
    spec = find_spec(module)
    loader = None if spec is None else spec.loader
    assert isinstance(loader, InspectLoader)
    code = loader.get_code(module)
    assert code is not None
    if function_name is not None:
        parts = (part for part in code.co_consts if isinstance(part, CodeType))
        code = next(part for part in parts if part.co_name == function_name)
    # Compiled code keeps its docstring as the first of its constants.
    return _first_line(code.co_consts[0])


def _first_line(docstring: str | None) -> str:
    return (docstring or "").strip().split("\n", 1)[0]


def _not_asked() -> None:
    """Stand in the list for the commands that this command line does not call."""
