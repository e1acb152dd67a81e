"""What is wrong with a batch: each finding with its place in the batch file, told all at once."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from rig.core.errors import MOST_FINDINGS, ConfigurationError, ExitCode, RigError

Where = tuple[str | int, ...]
"""Keys and places in lists that lead to a part of the batch file: ("experiment", 1, "matrix")."""


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong."""

    where: Where
    message: str
    hint: str | None = None
    code: ExitCode = ExitCode.USAGE

    @property
    def told(self) -> str:
        """The message, after which experiment it is about, counted from 1."""
        if len(self.where) > 1 and self.where[0] == "experiment":
            return f"experiment {int(self.where[1]) + 1}: {self.message}"
        return self.message


@dataclass(frozen=True)
class Source:
    """A batch file and on which line each of its parts begins."""

    name: str
    lines: Mapping[Where, int] = field(default_factory=dict)

    def line(self, where: Where) -> int:
        """The line of a part, or of the nearest one around it that the file names."""
        while where and where not in self.lines:
            where = where[:-1]
        return self.lines.get(where, 1)


class RefusedBatchError(ConfigurationError):
    """A batch that is not begun: all that is wrong with it, in the order of the file."""

    def __init__(self, findings: Iterable[Finding], source: Source | None = None):
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
        """One error a finding."""
        return self._parts


def _part(finding: Finding, source: Source | None) -> RigError:
    place = "" if source is None else f"{source.name}:{source.line(finding.where)}: "
    return RigError(place + finding.told, finding.hint, finding.code)
