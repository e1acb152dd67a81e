"""Columns, reading keys and results that had other names in run files of earlier versions.

Old files stay as they are. Whatever reads a column, a reading or a result uses the present name;
here is where it stands in an older file, and where a journal that was begun with an older layout
finds what a resumed run has recorded under the present name.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from rig.files.journal.layout import Column, Layout


class RenamedColumn(NamedTuple):
    """A column, by its name and its key in the readings, then and now."""

    former_column: str
    former_key: str
    column: str
    key: str


_PRESSED = (
    RenamedColumn("normal_force", "normal_force_N", "mean_normal_force", "mean_normal_force_N"),
    RenamedColumn(
        "normal_force_set", "normal_force_set_N", "set_normal_force", "set_normal_force_N"
    ),
)
"""The setting ``normal_force_N`` is a set point, and a reading of that name was a mean."""
RENAMED: Mapping[tuple[str, str], tuple[RenamedColumn, ...]] = {
    ("NXrig_slip_trial", "1"): _PRESSED,
    ("NXrig_roll_trial", "1"): _PRESSED,
}
"""Renamed columns, by definition and version of the layout that has the former names."""

RENAMED_RESULTS: Mapping[str, Mapping[str, str]] = {
    "NXrig_sweep": {"model.circuit.separability.seen_above.R1+R2": "R1+R2_ohm"},
}
"""Present names of renamed results, by definition and by the dotted name that they had."""


def column_in(layout: Layout, name: str) -> str:
    """Return what a file of this layout calls the column `name`: that, or its former name."""
    for renamed in _renamed_in(layout):
        if renamed.column == name:
            return renamed.former_column
    return name


def with_present_keys(layout: Layout, reading: Mapping[str, Any]) -> dict[str, Any]:
    """Return a reading of a file of this layout with the present keys in place of former ones."""
    present = {renamed.former_key: renamed.key for renamed in _renamed_in(layout)}
    return {present.get(key, key): value for key, value in reading.items()}


def with_present_names(layout: Layout, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the results of a file of this layout with the present names in place of former
    ones."""
    return _with_names(values, RENAMED_RESULTS.get(layout.definition, {}), "")


def _with_names(values: Mapping[str, Any], names: Mapping[str, str], prefix: str) -> dict[str, Any]:
    return {
        names.get(prefix + key, key): _with_names(value, names, f"{prefix}{key}.")
        if isinstance(value, Mapping)
        else value
        for key, value in values.items()
    }


def value_for(layout: Layout, column: Column, reading: Mapping[str, Any]) -> Any:
    """Return a reading's value for a column of this layout, recorded under its key there or under
    the present one; None where the reading has neither."""
    if column.key in reading:
        return reading[column.key]
    for renamed in _renamed_in(layout):
        if renamed.former_key == column.key:
            return reading.get(renamed.key)
    return None


def _renamed_in(layout: Layout) -> tuple[RenamedColumn, ...]:
    return RENAMED.get((layout.definition, layout.version), ())
