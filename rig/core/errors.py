"""Every expected failure is a RigError, with a message, a hint and an exit code.

A message is one line that names the thing, the value, the unit and the limit; the hint names the
remedy. Only the command line decides how they are shown.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date, time
from enum import IntEnum
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pydantic import ValidationError


MOST_FINDINGS = 20
"""Largest number of faults reported of one file: its author needs no more, and a file of another
kind must not fill the terminal."""
LONGEST_NAME = 60
"""Largest number of characters of a key or a value in a message."""
LONGEST_REASON = 300


class ExitCode(IntEnum):
    """The exit codes of the process; the numbers are part of the interface."""

    DONE = 0
    INTERNAL = 1
    USAGE = 2
    INSTRUMENT = 3
    LIMIT = 4
    FINISHED_WITH_FAILURES = 5
    STOPPED_BY_CONDITION = 6
    UNSAFE = 7
    FOUND_WRONG = 8
    SIGHUP = 129
    SIGINT = 130
    SIGQUIT = 131
    SIGTERM = 143


STOPPED_BY_SIGNAL = frozenset(
    {ExitCode.SIGHUP, ExitCode.SIGINT, ExitCode.SIGQUIT, ExitCode.SIGTERM}
)
"""Exit codes of a process that a signal has ended: 128 plus the signal's number."""


def is_stop(error: BaseException) -> bool:
    """Return whether an exception is a signal's request to stop.

    It is raised in the middle of whatever code is running, so code that tolerates every exception
    of another package has to let it pass: that package has not failed.
    """
    if not isinstance(error, (RigError, SystemExit)):
        return False
    return isinstance(error.code, int) and error.code in STOPPED_BY_SIGNAL


class RigError(Exception):
    """An expected failure: a message of one line, an optional hint, an exit code."""

    code: ExitCode = ExitCode.INTERNAL

    def __init__(self, message: str, hint: str | None = None, code: ExitCode | None = None):
        super().__init__(message)
        self.message = message
        self.hint = hint
        if code is not None:
            self.code = code

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the error whatever its class is made of."""
        return _restored, (type(self), self.args), self.__dict__

    def one_line(self) -> str:
        """Return the message and hint on one line, as a person reads it."""
        text = f"{self.message}; {self.hint}" if self.hint else self.message
        return " ".join(text.split())

    def parts(self) -> tuple[RigError, ...]:
        """Return the failures that this error consists of, to be reported one by one: itself
        only."""
        return (self,)


def _restored(kind: type[RigError], args: tuple[Any, ...]) -> RigError:
    """Return an error of a class without its constructor, whose arguments are not known."""
    return kind.__new__(kind, *args)


class SeveralFailuresError(RigError):
    """Several failures that do not depend on each other, with the exit code of the first."""

    def __init__(self, errors: Sequence[RigError]):
        super().__init__("; ".join(error.message for error in errors), code=errors[0].code)
        self.errors = tuple(errors)

    def parts(self) -> tuple[RigError, ...]:
        """Return the failures that this error consists of."""
        return self.errors


class ConfigurationError(RigError):
    """Raised for settings, a file or an option that cannot be used; no instrument was touched."""

    code = ExitCode.USAGE

    @classmethod
    def from_validation(
        cls, error: ValidationError, source: str, hint: str | None = None
    ) -> ConfigurationError:
        """Return an error whose message has all findings of a pydantic error: key, value and
        reason."""
        found = error.errors()
        findings = [finding(item) for item in found[:MOST_FINDINGS]]
        if len(found) > MOST_FINDINGS:
            findings.append(f"and {len(found) - MOST_FINDINGS} more")
        return cls(f"{source}: " + "; ".join(findings), hint)


class OutputError(RigError):
    """Raised where what a command has made cannot be written (exit code 1, whatever it is). A place
    that is refused before anything is computed or measured is a ConfigurationError instead."""


class InstrumentError(RigError):
    """Raised when an instrument fails, refuses, misreports or falls silent; names device, command,
    cause."""

    code = ExitCode.INSTRUMENT

    def __init__(self, device: str, command: str, cause: str, hint: str | None = None):
        super().__init__(f"{device}: {command}: {cause}", hint)
        self.device = device
        self.command = command
        self.cause = cause


class InstrumentTimeoutError(InstrumentError):
    """Raised when no answer comes within the time-out; the link is resynchronised before its next
    use."""


class InstrumentLinkError(InstrumentError):
    """Raised when a connection breaks or an answer is spoilt on it; the next command opens it
    again."""


class WrongPositionError(InstrumentError):
    """Raised for a position of a stage that is not a number, or where its axis cannot be."""

    def __init__(self, device: str, command: str, cause: str, hint: str, position: float):
        super().__init__(device, command, cause, hint)
        self.position = position
        """The position, in mm or deg; NaN where it is not a number."""


class WrongFramesError(InstrumentError):
    """Raised for what a force sensor's driver returned in place of frames with forces."""


class LimitError(RigError):
    """Raised for a value outside a limit of the bench, whether refused or tripped."""

    code = ExitCode.LIMIT


class UnsafeError(RigError):
    """Raised when the bench could not be made safe: a person has to check it."""

    code = ExitCode.UNSAFE


class FoundWrongError(RigError):
    """Raised when a check (``verify``, ``reproduce``) finds an error in what it checked."""

    code = ExitCode.FOUND_WRONG


_WORDS = {
    "greater_than": "must be above {gt:g}{unit}",
    "greater_than_equal": "must be at least {ge:g}{unit}",
    "less_than": "must be below {lt:g}{unit}",
    "less_than_equal": "must be at most {le:g}{unit}",
    "finite_number": "must be a finite number",
    "float_parsing": "must be a number",
    "float_type": "must be a number",
    "int_parsing": "must be a whole number",
    "int_from_float": "must be a whole number",
    "int_type": "must be a whole number",
    "bool_parsing": "must be true or false",
    "bool_type": "must be true or false",
    "string_type": "must be text",
    "string_too_short": "must have {min_length} or more characters",
    "string_too_long": "must have at most {max_length} characters",
    "string_pattern_mismatch": "must match {pattern}",
    "tuple_type": "must be a list",
    "list_type": "must be a list",
    "too_short": "must have {min_length} or more values, not {actual_length}",
    "too_long": "must have at most {max_length} values, not {actual_length}",
    "literal_error": "must be {expected}",
    "extra_forbidden": "unknown key",
    "missing": "missing",
    "union_tag_invalid": "{discriminator} = '{tag}' is unknown",
    "union_tag_not_found": "{discriminator} is missing",
}
"""Messages for pydantic's kinds of findings; the others are shown in pydantic's own words."""


def finding(item: Any) -> str:
    """Return one of pydantic's findings (an entry of `ValidationError.errors`) in words: key, value
    with unit, and the limit."""
    from rig.core.name_patterns import IN_WORDS
    from rig.core.settings import unit_of

    key = ".".join(shortened(str(part)) for part in item["loc"])
    name = next((part for part in reversed(item["loc"]) if isinstance(part, str)), "")
    unit = f" {known}" if (known := unit_of(name)) else ""
    kind, value = item["type"], item.get("input")
    if kind in _WORDS:
        context = {
            name: shortened(part, LONGEST_REASON) if isinstance(part, str) else part
            for name, part in item.get("ctx", {}).items()
        }
        message = _WORDS[kind].format(**context, unit=unit)
        message = IN_WORDS.get(context.get("pattern", ""), message)
    else:
        message = shortened(str(item["msg"]).removeprefix("Value error, "), LONGEST_REASON)
    if not key:
        return message
    shown = str(value) if isinstance(value, date | time) else repr(value)
    if kind in ("missing", "extra_forbidden") or len(shown) > LONGEST_NAME:
        return f"{key}: {message}"
    if isinstance(value, (dict, list, tuple)):
        return f"{key}: {message}"
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return f"{key} = {shown}{unit if number else ''}: {message}"


def shortened(text: str, longest: int = LONGEST_NAME) -> str:
    """Return a text, shortened to at most `longest` characters, for quoting it in a message."""
    return text if len(text) <= longest else text[: longest - 3] + "..."
