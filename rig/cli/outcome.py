"""How commands end: errors as one line on stderr, the exit code of the contract."""

from __future__ import annotations

import contextlib
import json
import logging
import sys
from collections.abc import Iterator
from pathlib import Path

import typer

from rig.core.errors import STOPPED_BY_SIGNAL, ExitCode, RigError

log = logging.getLogger("rig")
log.addHandler(logging.NullHandler())


class _Log(logging.FileHandler):
    """A log that cannot be written disturbs nobody: it opens its file with its first record."""

    def emit(self, record: logging.LogRecord) -> None:
        with contextlib.suppress(OSError):
            super().emit(record)


def start_log(results: Path) -> None:
    """Keep warnings, errors and tracebacks in ``rig.log`` beside the results, where possible."""
    with contextlib.suppress(OSError):
        results.mkdir(parents=True, exist_ok=True)
        handler = _Log(results / "rig.log", delay=True)
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
        log.addHandler(handler)
    log.propagate = False
    logging.raiseExceptions = False  # a log that cannot be written must not disturb a run


@contextlib.contextmanager
def reported(debug: bool = False, as_json: bool = False) -> Iterator[None]:
    """Turn what a command raises into one line and an exit code; ``--debug`` shows tracebacks.

    With `as_json` stdout carries an object for a command that could not even begin, too.
    """
    try:
        yield
    except RigError as error:
        raise typer.Exit(report(error, debug, as_json)) from None
    except KeyboardInterrupt:
        say("stopped by Ctrl-C; nothing was left running")
        raise typer.Exit(int(ExitCode.SIGINT)) from None


def report(error: RigError, debug: bool = False, as_json: bool = False) -> int:
    """Tell why a command has not begun; its exit code."""
    stopped = error.code in STOPPED_BY_SIGNAL
    if stopped:
        say(error.one_line())
    else:
        tell_failure(error, debug)
    if as_json:
        nothing_done: dict[str, object] = {
            "file": None,
            "outcome": "stopped" if stopped else "failed",
            "exit": int(error.code),
            "simulated": None,
            "summary": {},
            "errors": [one.one_line() for one in error.parts()],
        }
        print(json.dumps(nothing_done))  # noqa: T201 - stdout carries data
    return int(error.code)


def tell_failure(error: RigError, debug: bool = False) -> None:
    """One failure as one line on stderr, its traceback in the log."""
    for part in error.parts():
        log.error("%s", part.one_line(), exc_info=part)
        say(f"error: {part.one_line()}")
    if debug:
        import traceback

        traceback.print_exception(error)


def say(text: str) -> None:
    """One line for a person."""
    print(printable(text), file=sys.stderr, flush=True)  # noqa: T201 - the command line's own voice


def printable(text: str) -> str:
    """The text with control characters and what no encoding has as escapes: a name or a title in a
    file has no business with the terminal."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
