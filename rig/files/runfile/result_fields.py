"""Results as fields: the summary of a run, nested as the procedure gave it, one field a number.

Pure functions of a journal's results, which the writer and the read-back share.

    an estimate        NAME, and beside it NAME_errors (standard error), NAME_low and NAME_high
                       (95 % interval), all with its unit
    a list of tables   a group of arrays, an element for each table: notches, for instance
    a list of numbers  an array, with NaN for what is not known
    a text             a text
    None               nothing: the result does not exist
    anything else      its JSON text
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from rig.core.settings import unit_of
from rig.files.hdf5.nexus import UniqueNames, plain_text
from rig.files.journal.format import to_json
from rig.files.journal.values import Results

ESTIMATE = {"value", "standard_error", "low", "high", "unit"}
"""Keys of an estimate."""
STANDARD_ERRORS = "standard_errors"
"""Key of the table of standard errors of other values of the summary, by their names."""
PARTS = {"value": "", "standard_error": "_errors", "low": "_low", "high": "_high"}
MEANINGS = {
    "standard_error": "standard error",
    "low": "lower end of the 95 % interval",
    "high": "upper end of the 95 % interval",
}
LONGEST = 1000
"""Characters of a text that becomes an attribute."""
MOST_PUT_IN = 1000
"""Longest list that becomes an attribute, which ends at 64 KiB."""
MEASURED, RECOVERED = "measured", "recovered"


@dataclass(frozen=True)
class ResultField:
    """A field of the results: its names from the outermost group on, its value, its attributes.

    The value is a number, a text, a list of numbers or a list of texts.
    """

    path: tuple[str, ...]
    value: Any
    attributes: dict[str, Any] = field(default_factory=dict)


def result_fields(results: Results) -> Iterator[ResultField]:
    """Yield every field of the results, in the order of the summary."""
    yield from _Fields(results).of_table(results.values, (), "")


class _Fields:
    """Makes fields of nested values; knows what the results say of each by its dotted name."""

    def __init__(self, results: Results):
        self._results = results
        errors = results.values.get(STANDARD_ERRORS)
        self._errors = errors if isinstance(errors, Mapping) else {}

    def of_table(
        self, values: Mapping[str, Any], place: tuple[str, ...], prefix: str
    ) -> Iterator[ResultField]:
        """Yield the fields of a table whose names begin with `prefix`."""
        names = UniqueNames()
        paths = {key: (*place, names.name(str(key))) for key in values}
        for key, value in values.items():
            dotted = f"{prefix}{key}"
            if value is None or dotted == STANDARD_ERRORS:
                continue
            if not prefix and key in self._errors:
                parts = {"value": value, "standard_error": self._errors[key]}
                unit = unit_of(str(key)) or ""
                yield from self._of_estimates(paths[key], names, dotted, parts, unit)
            elif _is_estimate(value):
                parts = {part: value[part] for part in PARTS}
                unit = str(value["unit"])
                yield from self._of_estimates(paths[key], names, dotted, parts, unit)
            elif isinstance(value, Mapping):
                yield from self.of_table(value, paths[key], f"{dotted}.")
            elif _is_table_list(value):
                yield from self._of_columns(paths[key], dotted, value)
            else:
                yield self._field(paths[key], dotted, _plain(value), unit_of(str(key)) or "")

    def _of_columns(
        self, place: tuple[str, ...], prefix: str, rows: Sequence[Mapping[str, Any]]
    ) -> Iterator[ResultField]:
        names = UniqueNames()
        paths = {key: (*place, names.name(str(key))) for key in rows[0]}
        for key, path in paths.items():
            column, dotted = [row[key] for row in rows], f"{prefix}.{key}"
            if all(map(_is_estimate, column)):
                parts = {part: [one[part] for one in column] for part in PARTS}
                unit = str(column[0]["unit"])
                yield from self._of_estimates(path, names, dotted, parts, unit)
            else:
                yield self._field(path, dotted, _plain(column), unit_of(str(key)) or "")

    def _of_estimates(
        self,
        path: tuple[str, ...],
        names: UniqueNames,
        dotted: str,
        parts: Mapping[str, Any],
        unit: str,
    ) -> Iterator[ResultField]:
        """Yield a value, its error and its interval; `names` are those of the group so far."""
        for part, number in parts.items():
            known = math.nan if number is None else _plain(number)
            if part == "value":
                yield self._field(path, dotted, known, unit)
                continue
            attributes = {"units": _short(unit) or "1", "description": MEANINGS[part]}
            yield ResultField((*path[:-1], names.name(path[-1] + PARTS[part])), known, attributes)

    def _field(self, path: tuple[str, ...], dotted: str, value: Any, unit: str) -> ResultField:
        results, attributes = self._results, dict[str, Any]()
        if (label := results.labels.get(dotted)) is not None:
            attributes["description"] = plain_text(label)
        if not _is_text(value):
            attributes["units"] = _short(unit) or "1"
            put_in = results.put_in.get(dotted)
            attributes["origin"] = _origin(dotted, results.origins, put_in is not None)
            if put_in is not None and not (isinstance(put_in, list) and len(put_in) > MOST_PUT_IN):
                attributes["put_in_by_the_World"] = _plain(put_in)
        return ResultField(path, value, attributes)


def _origin(dotted: str, origins: Mapping[str, str], recovered: bool) -> str:
    """Return where a number comes from: what is said of it, or of the nearest group around it."""
    name = dotted
    while name:
        if name in origins:
            return plain_text(origins[name])
        name = name.rpartition(".")[0]
    return RECOVERED if recovered else MEASURED


def _short(text: str) -> str:
    return plain_text(text)[:LONGEST]


def _is_estimate(value: Any) -> bool:
    return isinstance(value, Mapping) and value.keys() == ESTIMATE


def _is_table_list(value: Any) -> bool:
    """Return whether the value is a list of tables, all with the same keys."""
    return (
        isinstance(value, (list, tuple))
        and bool(value)
        and all(isinstance(row, Mapping) for row in value)
        and all(row.keys() == value[0].keys() for row in value)
    )


def _is_text(value: Any) -> bool:
    return isinstance(value, str) or (
        isinstance(value, list) and bool(value) and isinstance(value[0], str)
    )


def _plain(value: Any) -> Any:
    """Return a number, a text, or a list of one of them, as HDF5 holds it."""
    if isinstance(value, str):
        return plain_text(value)
    if isinstance(value, (bool, float)) or (isinstance(value, int) and abs(value) < 2**63):
        return value
    if isinstance(value, (list, tuple)) and value:
        if all(isinstance(one, str) for one in value):
            return [plain_text(one) for one in value]
        if all(one is None or type(one) in (int, float) for one in value):
            return [math.nan if one is None else float(one) for one in value]
    return to_json(value)
