"""The report in which the guard states what it has done to a bench, and what a reader makes of it.

The guard writes it, the run that has handed its bench over reads it, and so does the next command.
"""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

from rig.core.atomic import write_text
from rig.core.text import in_shell

GUARD_SUFFIX = ".guard.json"
"""Suffix of a report next to its run file, for a bench that ended with the run."""


def report_path(results: Path, bench_name: str) -> Path:
    """Return the path of the report of a bench's guard."""
    return results / f"guard-{bench_name}.json"


def takeover_notice(path: Path) -> str | None:
    """Return, once, a sentence on what the guard did when the run of a simulated bench of its own
    died, from its report. Returns None for a guard that is still acting, and for one that could not
    make the bench safe: that bench has ended."""
    try:
        report = json.loads(path.read_text())
        if report["safe"] is not True or report.get("told") or "file" not in report:
            return None
        notice = in_words(report)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    mark_reported(path, report)
    return notice


def in_words(report: dict[str, Any]) -> str:
    """Return what the guard has done, from its report, as a sentence without a full stop."""
    words = (
        f"the guard of an earlier run had to act at {report['time']}: {report['cause']}; "
        "everything was stopped and switched off"
    )
    for role in report["failures"] if report["safe"] else ():
        words += f"; {role} did not answer, which drives nothing"
    if report.get("pressed"):
        words += f", {report['pressed']}"
    if report["journal"] is not None and "file" in report:
        words += f"; data: {report['file']}; continue with: {_continuing(Path(report['journal']))}"
    return words


def _continuing(journal: Path) -> str:
    """Return the command that continues a run: that of its batch, if it is one of a batch."""
    # Here, since a guard that waits imports little; once a file is compiled, this is imported.
    from rig.files.file_kind import BATCH_QUEUE

    batch = journal.parent.parent
    with contextlib.suppress(OSError):  # a folder that may not be looked into
        if (batch / BATCH_QUEUE).is_file():
            return f"rig batch resume {in_shell(batch)}"
    return f"rig resume {in_shell(journal)}"


def mark_reported(path: Path, report: dict[str, Any]) -> None:
    """Note in the report's file that a person has been shown it, so that no command shows it again.
    A file that cannot be written stays as it is: the report is then shown once more."""
    with contextlib.suppress(OSError):
        write(path, report | {"told": True})


def write(path: Path, report: dict[str, Any]) -> None:
    """Write the report in one step; a power cut may lose it. Raises OSError if it cannot be
    written."""
    write_text(path, json.dumps(report, indent=1) + "\n", durable=False)
