"""What can go wrong, as one family: every expected failure is a RigError with an exit code.

A message is one line that names the thing, the value, the unit and the limit; the hint says what
to do about it. Only the command line decides how they are shown.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pydantic import ValidationError


MOST_FINDINGS = 20
"""Told of one file at once: who wrote it needs no more, who did not shall not fill the terminal."""
LONGEST_NAME = 60
"""Characters of a key or a value in a message."""
LONGEST_REASON = 300


class ExitCode(IntEnum):
    """What the process tells its caller; the numbers are part of the interface."""

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
"""Exit codes of what a signal has ended: 128 and the signal's number."""


class RigError(Exception):
    """An expected failure: one line of message, an optional remedy, an exit code."""

    code: ExitCode = ExitCode.INTERNAL

    def __init__(self, message: str, hint: str | None = None, code: ExitCode | None = None):
        super().__init__(message)
        self.message = message
        self.hint = hint
        if code is not None:
            self.code = code

    def one_line(self) -> str:
        """Message and hint as one line, the form in which a person reads it."""
        text = f"{self.message}; {self.hint}" if self.hint else self.message
        return " ".join(text.split())

    def parts(self) -> tuple[RigError, ...]:
        """The failures it consists of, each told for itself: this one."""
        return (self,)


class SeveralFailuresError(RigError):
    """Failures that have nothing to do with each other; the first one's exit code counts."""

    def __init__(self, errors: Sequence[RigError]):
        super().__init__("; ".join(error.message for error in errors), code=errors[0].code)
        self.errors = tuple(errors)

    def parts(self) -> tuple[RigError, ...]:
        """Each of them."""
        return self.errors


class ConfigurationError(RigError):
    """Settings, a file or an option that cannot be used; nothing was touched."""

    code = ExitCode.USAGE

    @classmethod
    def from_validation(
        cls, error: ValidationError, source: str, hint: str | None = None
    ) -> ConfigurationError:
        """All of a pydantic error's findings in one message, each with key, value and reason."""
        found = error.errors()
        findings = [finding(item) for item in found[:MOST_FINDINGS]]
        if len(found) > MOST_FINDINGS:
            findings.append(f"and {len(found) - MOST_FINDINGS} more")
        return cls(f"{source}: " + "; ".join(findings), hint)


class InstrumentError(RigError):
    """An instrument failed, refused, lied or fell silent: names device, command and cause."""

    code = ExitCode.INSTRUMENT

    def __init__(self, device: str, command: str, cause: str, hint: str | None = None):
        super().__init__(f"{device}: {command}: {cause}", hint)
        self.device = device
        self.command = command
        self.cause = cause


class InstrumentTimeoutError(InstrumentError):
    """No answer within the time-out; the link is resynchronised before it is trusted again."""


class LimitError(RigError):
    """A value outside a limit of the bench, refused or tripped."""

    code = ExitCode.LIMIT


class UnsafeError(RigError):
    """The bench could not be made safe: somebody has to go and look."""

    code = ExitCode.UNSAFE


class FoundWrongError(RigError):
    """A check ran and what it checked is wrong (``verify``, ``reproduce``)."""

    code = ExitCode.FOUND_WRONG


_WORDS = {
    "greater_than": "has to be above {gt:g}{unit}",
    "greater_than_equal": "has to be at least {ge:g}{unit}",
    "less_than": "has to be below {lt:g}{unit}",
    "less_than_equal": "has to be at most {le:g}{unit}",
    "finite_number": "has to be a finite number",
    "float_parsing": "has to be a number",
    "float_type": "has to be a number",
    "int_parsing": "has to be a whole number",
    "int_from_float": "has to be a whole number",
    "int_type": "has to be a whole number",
    "bool_parsing": "has to be true or false",
    "bool_type": "has to be true or false",
    "string_type": "has to be text",
    "string_too_short": "has to have at least {min_length} characters",
    "tuple_type": "has to be a list",
    "list_type": "has to be a list",
    "too_short": "has to have at least {min_length} values, not {actual_length}",
    "too_long": "has to have at most {max_length} values, not {actual_length}",
    "literal_error": "has to be {expected}",
    "extra_forbidden": "unknown key",
    "missing": "missing",
    "union_tag_invalid": "{discriminator} = '{tag}' is unknown",
    "union_tag_not_found": "{discriminator} is missing",
}
"""Kinds of pydantic's findings in a person's words; its own are shown for the others."""


def finding(item: Any) -> str:
    """One of pydantic's findings (an entry of `ValidationError.errors`) in words: key, value with
    unit, and the limit."""
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
    else:
        message = shortened(str(item["msg"]).removeprefix("Value error, "), LONGEST_REASON)
    if not key:
        return message
    shown = repr(value)
    if kind in ("missing", "extra_forbidden") or len(shown) > LONGEST_NAME:
        return f"{key}: {message}"
    if isinstance(value, (dict, list, tuple)):
        return f"{key}: {message}"
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return f"{key} = {shown}{unit if number else ''}: {message}"


def shortened(text: str, longest: int = LONGEST_NAME) -> str:
    """A text from a file as a message can quote it: not longer than `longest` characters."""
    return text if len(text) <= longest else text[: longest - 3] + "..."
