"""Files of the skin model: what ``rig skin`` has computed, from which settings, by which program.

    /entry                 title, definition, program_name with its version
    /entry/settings_json   all settings, to be given back with --settings
    /entry/parameters      the same as fields with units; the attribute is_default says whether a
                           value is the usual one
    /entry/data            the results, each with its unit, its meaning and the names of its axes

Everything in such a file is computed; nothing is measured.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import rig
from rig.core.settings import Settings, leaves
from rig.files.errors import RunFileError
from rig.files.hdf5.nexus import array_field, group, set_attributes, text_field, write_note
from rig.files.hdf5.open_file import OpenFile, definition_of
from rig.files.hdf5.publishing import publishing
from rig.files.hdf5.safe_reading import text_of, whole

if TYPE_CHECKING:
    import h5py
    from numpy.typing import ArrayLike

DEFINITION = "NXrig_model"


@dataclass(frozen=True)
class ModelQuantity:
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
    results: Mapping[str, ModelQuantity],
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
        usual = {path: value for path, value, _ in leaves(type(one)())}
        for path, value, unit in leaves(one):
            if value is None:
                continue
            plain: Any = value
            if not isinstance(value, bool | int | float | str):
                plain = json.dumps(value, default=_as_plain)
            field = made.create_dataset(path.replace(".", "/"), data=plain)
            field.attrs["is_default"] = bool(value == usual.get(path))
            if unit:
                field.attrs["units"] = unit


def _as_plain(value: Any) -> Any:
    return value.model_dump(mode="json") if isinstance(value, Settings) else str(value)


def _write_result(data: h5py.Group, name: str, result: ModelQuantity) -> None:
    values = np.asarray(result.values)
    if values.ndim:
        field = array_field(data, name, values, result.unit, result.meaning)
        set_attributes(field, {"axes": list(result.axes)})
    else:
        field = data.create_dataset(name, data=values)
        set_attributes(field, {"units": result.unit, "long_name": result.meaning})


def is_model(path: Path) -> bool:
    """Return whether a file says that it is one of the skin model; a damaged one does not."""
    return definition_of(path) == DEFINITION


class ModelFile(OpenFile):
    """An open file of the skin model; use it as a context. Whatever is wrong with it is a
    RunFileError that names it."""

    KIND = "file of rig skin"

    def _check(self) -> None:
        if text_of(self.entry["definition"]) != DEFINITION:
            raise RunFileError(self.path, "an HDF5 file, but not one of `rig skin`")
        _ = self.title, self.settings, self.results()

    @property
    def title(self) -> str:
        """What was computed, with the mark SIMULATED."""
        with self._naming():
            return text_of(self.entry["title"])

    @property
    def program(self) -> str:
        """The command that has computed it, with its version."""
        with self._naming():
            name = self.entry["program_name"]
            return f"{text_of(name)} {name.attrs['version']}"

    @property
    def settings(self) -> dict[str, Any]:
        """All settings, nested, as ``--settings`` and ``--skin`` take them."""
        with self._naming():
            found = json.loads(text_of(self.entry["settings_json/data"]))
            return {str(name): value for name, value in found.items()}

    def changed_settings(self) -> dict[str, Any] | None:
        """Return the settings that differ from their defaults, by dotted names; None in a file of
        a version that did not record which they are."""
        found: dict[str, Any] = {}
        with self._naming():
            for name, field in _fields(self.entry["parameters"]):
                if "is_default" not in field.attrs:
                    return None
                if not field.attrs["is_default"]:
                    value = whole(field)
                    found[name] = value.decode() if isinstance(value, bytes) else value.item()
        return found

    def results(self) -> dict[str, ModelQuantity]:
        """Return what was computed, by name."""
        with self._naming():
            return {
                name: ModelQuantity(
                    whole(field),
                    str(field.attrs.get("units", "")),
                    str(field.attrs["long_name"]),
                    tuple(map(str, field.attrs.get("axes", ()))),
                )
                for name, field in self.entry["data"].items()
            }


def _fields(place: h5py.Group, prefix: str = "") -> Iterator[tuple[str, h5py.Dataset]]:
    """Yield each field below a group by its dotted name."""
    for name, item in place.items():
        if hasattr(item, "items"):
            yield from _fields(item, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", item
