"""Files of the skin model: what ``rig skin`` has computed, from which settings, by which program.

    /entry                 title, definition, program_name with its version
    /entry/settings_json   all settings, to be given back with --settings
    /entry/parameters      the same as fields with units
    /entry/data            the results, each with its unit, its meaning and the names of its axes

Everything in such a file is computed; nothing is measured.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import rig
from rig.core.settings import Settings, leaves
from rig.files.hdf5.nexus import array_field, group, set_attributes, text_field, write_note
from rig.files.hdf5.publishing import publishing

if TYPE_CHECKING:
    import h5py
    from numpy.typing import ArrayLike

DEFINITION = "NXrig_model"


@dataclass(frozen=True)
class Quantity:
    """A result with what a stranger needs to use it."""

    values: ArrayLike
    unit: str
    """Empty for a number without one."""
    meaning: str
    axes: tuple[str, ...] = ()
    """Name of each axis; that of a field of the same file where there is one."""


def write_model(
    target: Path,
    title: str,
    command: str,
    settings: Mapping[str, Settings],
    results: Mapping[str, Quantity],
) -> None:
    """Write results of the skin model; the file appears when it is whole, with its checksum.

    `settings` are the objects that determine the results, by their names. Raises OSError where the
    disk does not take it.
    """
    import h5py

    with publishing(target) as part, h5py.File(part, "w") as file:
        set_attributes(file, {"NX_class": "NXroot", "default": "entry"})
        entry = group(file, "entry", "NXentry")
        text_field(entry, "title", f"SIMULATED {title}")
        text_field(entry, "definition", DEFINITION)
        set_attributes(text_field(entry, "program_name", command), {"version": rig.__version__})
        plain = {name: one.model_dump(mode="json") for name, one in settings.items()}
        write_note(
            entry, "settings_json", "application/json", "settings.json", json.dumps(plain, indent=2)
        )
        _write_parameters(group(entry, "parameters", "NXcollection"), settings)
        data = group(entry, "data", "NXcollection")
        for name, result in results.items():
            _write_result(data, name, result)


def _write_parameters(place: h5py.Group, settings: Mapping[str, Settings]) -> None:
    for name, one in settings.items():
        made = group(place, name, "NXcollection")
        for path, value, unit in leaves(one):
            if value is None:
                continue
            plain: Any = value
            if not isinstance(value, bool | int | float | str):
                plain = json.dumps(value, default=_as_plain)
            field = made.create_dataset(path.replace(".", "/"), data=plain)
            if unit:
                field.attrs["units"] = unit


def _as_plain(value: Any) -> Any:
    return value.model_dump(mode="json") if isinstance(value, Settings) else str(value)


def _write_result(data: h5py.Group, name: str, result: Quantity) -> None:
    values = np.asarray(result.values)
    if values.ndim:
        field = array_field(data, name, values, result.unit, result.meaning)
        set_attributes(field, {"axes": list(result.axes)})
    else:
        field = data.create_dataset(name, data=values)
        set_attributes(field, {"units": result.unit, "long_name": result.meaning})
