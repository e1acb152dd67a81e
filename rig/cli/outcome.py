"""The ends of commands: errors as one line on stderr, and the exit code."""

from __future__ import annotations

import contextlib
import errno
import logging
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import typer

from rig.core.errors import STOPPED_BY_SIGNAL, ExitCode, RigError, shortened
from rig.core.json_text import json_text
from rig.core.text import printable

log = logging.getLogger("rig")
log.addHandler(logging.NullHandler())


class _Log(logging.FileHandler):
    """A log file that is opened with its first record, and ignored if it cannot be written."""

    def emit(self, record: logging.LogRecord) -> None:
        with contextlib.suppress(OSError):
            super().emit(record)


def start_log(results: Path) -> None:
    """Log warnings, errors and tracebacks to ``rig.log`` in the results folder, if possible."""
    with contextlib.suppress(OSError):
        results.mkdir(parents=True, exist_ok=True)
        handler = _Log(results / "rig.log", delay=True)
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
        log.addHandler(handler)
    log.propagate = False
    logging.raiseExceptions = False  # A log that cannot be written must not disturb a run.


@contextlib.contextmanager
def reported(debug: bool = False, as_json: bool = False) -> Iterator[None]:
    """Turn an exception of a command into one line and an exit code; ``--debug`` shows tracebacks.

    With `as_json` stdout gets an object even for a command that could not begin, or that Ctrl-C has
    stopped.
    """
    try:
        yield
    except RigError as error:
        raise typer.Exit(report(error, debug, as_json)) from None
    except (OSError, ImportError, MemoryError) as error:
        raise typer.Exit(report(of_the_computer(error), debug, as_json)) from None
    except KeyboardInterrupt:
        stopped = RigError("stopped by Ctrl-C", "this command left nothing running")
        stopped.code = ExitCode.SIGINT
        raise typer.Exit(report(stopped, debug, as_json)) from None


def of_the_computer(error: OSError | ImportError | MemoryError) -> RigError:
    """Return what the computer refuses as an error in one line: a name that is too long, a library
    for which there is no memory, a process too many."""
    if isinstance(error, OSError):
        name = str(error.filename or "")
        if error.errno == errno.ENAMETOOLONG:
            name = shortened(name)
        where = f"{name}: " if name else ""
        message = f"{where}{error.strerror or error}"
        if error.filename:
            failure = RigError(message, "give another name or place", ExitCode.USAGE)
        else:
            hint = "free what the computer lacks: processes (ulimit -u), memory, open files"
            failure = RigError(message, hint, ExitCode.INTERNAL)
    else:
        failure = RigError(
            f"{type(error).__name__}: {error}" if str(error) else type(error).__name__,
            "not enough memory (ulimit -v), or the installation is damaged: install it again",
            ExitCode.INTERNAL,
        )
    failure.__cause__ = error
    return failure


def report(
    error: RigError, debug: bool = False, as_json: bool = False, file: Path | None = None
) -> int:
    """Report why a command has not begun, or has not begun with a `file`; return its exit code."""
    stopped = error.code in STOPPED_BY_SIGNAL
    if stopped:
        say(error.one_line())
    else:
        say_failure(error, debug)
    if as_json:
        nothing_done: dict[str, object] = {
            "file": None if file is None else str(file),
            "outcome": "stopped" if stopped else "failed",
            "exit": int(error.code),
            "simulated": None,
            "summary": {},
            "errors": [one.one_line() for one in error.parts()],
        }
        print_json(nothing_done)
    return int(error.code)


def say_failure(error: RigError, debug: bool = False) -> None:
    """Report a failure as one line on stderr, with its traceback in the log."""
    for part in error.parts():
        log.error("%s", part.one_line(), exc_info=part)
        say(f"error: {part.one_line()}")
    if debug:
        import traceback

        traceback.print_exception(error)


@contextlib.contextmanager
def turning(what: str) -> Iterator[None]:
    """Show on a terminal, as long as the block lasts, that something takes its time."""
    if not sys.stderr.isatty():
        yield
        return
    from rich.console import Console  # takes longer to import than most commands take

    with Console(stderr=True).status(what):
        yield


def print_json(value: Mapping[str, Any]) -> None:
    """Print an object for another program to stdout, on one line and as `json_text` has it."""
    print(json_text(value), flush=True)  # noqa: T201 - stdout carries data


def say_all(text: str) -> None:
    """Print several lines, such as a traceback, to stderr."""
    for line in text.splitlines():
        say(line)


def say(text: str) -> None:
    """Print one line for a person to stderr."""
    print(printable(text), file=sys.stderr, flush=True)  # noqa: T201 - the command line's own voice
