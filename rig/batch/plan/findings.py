"""Collects the findings about a batch file, each with its place in the file."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

from rig.core.errors import MOST_FINDINGS, ConfigurationError, ExitCode, RigError

KeyPath = tuple[str | int, ...]
"""Keys and places in lists that lead to a part of the batch file: ("experiment", 1, "matrix")."""


@dataclass(frozen=True)
class PlanFinding:
    """A fault of a batch file: where it is, what is wrong and how to correct it."""

    where: KeyPath
    message: str
    hint: str | None = None
    code: ExitCode = ExitCode.USAGE

    @property
    def text(self) -> str:
        """The message, preceded by the experiment it is about, counted from 1."""
        if len(self.where) > 1 and self.where[0] == "experiment":
            return f"experiment {int(self.where[1]) + 1}: {self.message}"
        return self.message


KEY = r"""[A-Za-z0-9_-]+|"[^"]*"|'[^']*'"""
KEYS = rf"((?:{KEY})(?:\s*\.\s*(?:{KEY}))*)"
HEADER = re.compile(rf"\s*(\[\[?)\s*{KEYS}\s*\]\]?\s*(?:#.*)?$")
ASSIGNMENT = re.compile(rf"\s*{KEYS}\s*=")


@dataclass(frozen=True)
class BatchText:
    """The text of a batch file and its name, from which messages take line numbers."""

    name: str
    text: str

    def line(self, where: KeyPath) -> int:
        """Return the line of a key or table, counted from 1; that of the nearest table around it
        where the part itself does not begin a line (an entry of a list, say), or 1."""
        while where and where not in self._lines:
            where = where[:-1]
        return self._lines.get(where, 1)

    @cached_property
    def _lines(self) -> dict[KeyPath, int]:
        """The first line of every table and key. A search for headers and assignments, no parser:
        what looks like one within a text of several lines is taken for one."""
        lines: dict[KeyPath, int] = {}
        table: KeyPath = ()
        entries: dict[KeyPath, int] = {}
        for number, line in enumerate(self.text.splitlines(), 1):
            if header := HEADER.match(line):
                table = ()
                for name in _names(header[2]):
                    table = (*table, *([entries[table]] if table in entries else []), name)
                if header[1] == "[[":
                    lines.setdefault(table, number)
                    entries[table] = entries.get(table, -1) + 1
                if table in entries:
                    table = (*table, entries[table])
                lines.setdefault(table, number)
            elif key := ASSIGNMENT.match(line):
                lines.setdefault((*table, *_names(key[1])), number)
        return lines


class RefusedBatchError(ConfigurationError):
    """A batch that is not begun: everything that is wrong with it, in the order of the file."""

    def __init__(self, findings: Iterable[PlanFinding], source: BatchText | None = None):
        found = list(dict.fromkeys(findings))
        if source is not None:
            found.sort(key=lambda finding: source.line(finding.where))
        self.findings = tuple(found)
        self._parts = tuple(_part(finding, source) for finding in found[:MOST_FINDINGS])
        if (more := len(found) - MOST_FINDINGS) > 0:
            self._parts += (ConfigurationError(f"and {more} more"),)
        codes = {finding.code for finding in found}
        super().__init__(
            "; ".join(part.message for part in self._parts),
            code=ExitCode.LIMIT if codes == {ExitCode.LIMIT} else ExitCode.USAGE,
        )

    def parts(self) -> tuple[RigError, ...]:
        """Return one error for each finding."""
        return self._parts


def _part(finding: PlanFinding, source: BatchText | None) -> RigError:
    place = "" if source is None else f"{source.name}:{source.line(finding.where)}: "
    return RigError(place + finding.text, finding.hint, finding.code)


def _names(key: str) -> list[str]:
    return [name.strip("\"'") for name in re.findall(KEY, key)]
