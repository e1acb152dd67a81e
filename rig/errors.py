"""What can go wrong, as one family: every expected failure is a RigError with an exit code.

A message is one line that names the thing, the value, the unit and the limit; the hint says what
to do about it. Only the command line decides how they are shown.
"""

from __future__ import annotations

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
    SIGTERM = 143


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


class ConfigurationError(RigError):
    """Settings, a file or an option that cannot be used; nothing was touched."""

    code = ExitCode.USAGE

    @classmethod
    def from_validation(
        cls, error: ValidationError, source: str, hint: str | None = None
    ) -> ConfigurationError:
        """All of a pydantic error's findings in one message, each with key, value and reason."""
        found = error.errors()
        findings = [_finding(item) for item in found[:MOST_FINDINGS]]
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


def _finding(item: Any) -> str:
    key = ".".join(shortened(str(part)) for part in item["loc"])
    value = item.get("input")
    kind = item["type"]
    if kind == "extra_forbidden":
        return f"{key}: unknown key"
    if kind == "missing":
        return f"{key}: missing"
    message = str(item["msg"]).removeprefix("Value error, ")
    message = shortened(message, LONGEST_REASON)
    if not key:
        return message
    if isinstance(value, (dict, list, tuple)) or len(shown := repr(value)) > LONGEST_NAME:
        return f"{key}: {message}"
    return f"{key} = {shown}: {message}"


def shortened(text: str, longest: int = LONGEST_NAME) -> str:
    """A text from a file as a message can quote it: not longer than `longest` characters."""
    return text if len(text) <= longest else text[: longest - 3] + "..."
