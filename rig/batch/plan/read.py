"""Reading a batch file: the whole file is validated, and all errors are reported with their lines.

Errors of the file and of the settings of its procedures are reported together;
what a bench makes of it is in `rig.batch.plan.validate`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from rig.batch.plan.conditions import BatchPlan
from rig.batch.plan.expand import Expansion, check_defaults, expand, labels
from rig.batch.plan.findings import BatchText, KeyPath, PlanFinding, RefusedBatchError
from rig.batch.plan.settings import BatchFile, Experiment
from rig.core.errors import finding
from rig.core.toml_files import MAX_TOML_BYTES, parse_toml, read_text

WHAT = "batch file"


def read_batch(path: Path) -> tuple[BatchFile, BatchPlan, BatchText]:
    """Return a batch file, the plan that it expands to, and its text.

    Raises ConfigurationError if it cannot be read, and RefusedBatchError with all its errors.
    """
    return parse_batch(batch_text(path), str(path))


def batch_text(path: Path, *, with_mark: bool = False) -> str:
    """Return the text of a batch file, with its byte order mark if `with_mark`. Raises
    ConfigurationError if it cannot be read."""
    hint = "name a batch file (TOML)"
    return read_text(path, WHAT, MAX_TOML_BYTES, hint, with_mark=with_mark)


def parse_batch(text: str, name: str) -> tuple[BatchFile, BatchPlan, BatchText]:
    """Return the same from the text of a file of this `name`.

    Raises RefusedBatchError, with all findings.
    """
    tables = parse_toml(text, name)
    source = BatchText(name, text)
    try:
        batch = BatchFile.model_validate(tables)
    except ValidationError as error:
        findings = [*_findings(error, tables), *_further(tables)]
        raise RefusedBatchError(findings, source) from error
    try:
        return batch, expand(batch), source
    except RefusedBatchError as error:
        raise RefusedBatchError(error.findings, source) from error


BOOL, INTEGER = "true or false", "a whole number"
"""What two of the kinds of a value in a batch file have to be, in the words of `finding`."""
ONE_VALUE = (
    'an entry must be one value: a number, text ("200Hz"), true or false. A list is written as '
    'text ("20,200")'
)


def _findings(error: ValidationError, tables: Mapping[str, Any]) -> Iterator[PlanFinding]:
    """Return pydantic's findings in words. A value that could be of several kinds and is of none of
    them is one finding."""
    by_place: dict[KeyPath, list[str]] = {}
    items = error.errors()
    for item in items:
        where: KeyPath = item["loc"]
        # pydantic does not count entries that are wrong in themselves: those are reported.
        if item["type"] == "too_short" and any(
            len(other["loc"]) > len(where) and other["loc"][: len(where)] == where
            for other in items
        ):
            continue
        named = where if item["type"] == "missing" else _existing(where, tables)
        shown = named[2:] if named[0] == "experiment" and len(named) > 1 else named
        keys = tuple(part for part in shown if isinstance(part, str))
        by_place.setdefault(named, []).append(finding({**item, "loc": keys}))
    for where, messages in by_place.items():
        first, *others = dict.fromkeys(messages)
        reasons = [other.rpartition(": ")[2].removeprefix("must be ") for other in others]
        if {BOOL, INTEGER} <= {first.rpartition(": ")[2].removeprefix("must be "), *reasons}:
            yield PlanFinding(where, f"{first.rpartition(': ')[0]}: {ONE_VALUE}")
        else:
            yield PlanFinding(where, " or ".join([first, *reasons]))


def _existing(where: KeyPath, tables: Any) -> KeyPath:
    """Return the part of a place that exists in the file: pydantic adds the kind of value that it
    tried."""
    found: KeyPath = ()
    for part in where:
        try:
            tables = tables[part]
        except (LookupError, TypeError):
            break
        found = (*found, part)
    return found or where[:1]


def _further(tables: Mapping[str, Any]) -> Iterator[PlanFinding]:
    """Return the findings about the settings in a file of which another part is wrong."""
    defaults = tables.get("defaults", {})
    entries = tables.get("experiment", [])
    if not isinstance(defaults, dict) or not isinstance(entries, list):
        return
    defaults = {name: table for name, table in defaults.items() if isinstance(table, dict)}
    yield from check_defaults(defaults)
    experiments: dict[int, Experiment] = {}
    for number, entry in enumerate(entries):
        try:
            experiments[number] = Experiment.model_validate(entry)
        except ValidationError:
            continue  # reported already
    for (number, experiment), label in zip(
        experiments.items(), labels(list(experiments.values())), strict=True
    ):
        expansion = Expansion(number, experiment, label, defaults, seed=0)
        if not expansion.is_too_large:
            expansion.expand()
        yield from expansion.findings
