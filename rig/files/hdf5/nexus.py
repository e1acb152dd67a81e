"""NeXus in HDF5: groups with a class, fields with a unit and a name that viewers show.

Nothing here knows what a run is. h5py and numpy are imported only where something is written, since
together they take a third of a second.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

from rig.files.journal.format import to_json

if TYPE_CHECKING:
    import h5py
    from numpy.typing import NDArray


CHUNK_ROWS = 1 << 18
"""Rows of a chunk: half a MiB of int16, which viewers read at a time."""


def set_attributes(item: h5py.Group | h5py.Dataset, values: Mapping[str, Any]) -> None:
    """Set attributes that do not exist yet. ``item.attrs[name] = value`` takes twice the time,
    since it writes each under a temporary name first, and a run file has thousands. Use that for
    attributes that may exist.
    """
    import numpy as np
    from h5py import h5a

    for name, value in values.items():
        kind: type = type(value)
        rows = None
        if kind is list and value and all(type(text) is str for text in value):
            kind, rows = str, len(value)
        if kind not in (str, float, int):
            item.attrs[name] = value
            continue
        memory, stored, space = _attribute(kind, rows)
        h5a.create(item.id, name.encode(), stored, space).write(np.array(value, memory))


@cache
def _attribute(kind: type, rows: int | None) -> tuple[Any, Any, Any]:
    """Return how a scalar or a list is written: its type in memory, the one in the file, its
    space."""
    import numpy as np
    from h5py import h5s, h5t, string_dtype

    memory = np.dtype({float: "<f8", int: "<i8"}.get(kind, string_dtype()))
    space = h5s.create(h5s.SCALAR) if rows is None else h5s.create_simple((rows,))
    return memory, h5t.py_create(memory, logical=True), space


def safe_name(text: str) -> str:
    """Return a valid NeXus name that looks like the text: ``f=10.5 Hz`` gives ``f_10_5_Hz``."""
    return re.sub(r"[^A-Za-z0-9_]+", "_", text)[:100] or "_"


class UniqueNames:
    """Gives names to the items of one group, all different."""

    def __init__(self, *taken: str) -> None:
        self._numbers = dict.fromkeys(taken, 1)
        """The last number that was appended to each name."""

    def name(self, text: str) -> str:
        """Return ``safe_name`` of the text, with a number behind it if that name is in use."""
        name = base = safe_name(text)
        while name in self._numbers:
            self._numbers[base] += 1
            name = f"{base}_{self._numbers[base]}"
        self._numbers[name] = 1
        return name


def plain_text(text: object) -> str:
    """Return the text as HDF5 can hold it: without NUL and lone surrogates."""
    return str(text).replace("\0", "\ufffd").encode("utf-8", "replace").decode()


def group(parent: h5py.Group, name: str, nx_class: str) -> h5py.Group:
    """Create a group of a NeXus class and return it."""
    made = parent.create_group(name)
    set_attributes(made, {"NX_class": nx_class})
    return made


def text_field(parent: h5py.Group, name: str, text: object) -> h5py.Dataset:
    """Create a scalar dataset of UTF-8 text and return it."""
    return parent.create_dataset(name, data=plain_text(text))


def texts_field(parent: h5py.Group, name: str, texts: Sequence[str]) -> h5py.Dataset:
    """Create a dataset of UTF-8 texts, shape (n,), and return it."""
    import h5py

    plain = [plain_text(text) for text in texts]
    return parent.create_dataset(name, (len(plain),), h5py.string_dtype(), data=plain or None)


def number_field(parent: h5py.Group, name: str, value: Any, units: str = "") -> h5py.Dataset:
    """Create a scalar dataset of a number and return it."""
    field = parent.create_dataset(name, data=value)
    if units:
        field.attrs["units"] = units
    return field


def array_field(
    parent: h5py.Group, name: str, values: NDArray[Any], units: str = "", long_name: str = ""
) -> h5py.Dataset:
    """Create a compressed dataset with checksums from an array and return it."""
    field = empty_field(parent, name, values.shape, values.dtype)
    if values.size:
        field[...] = values
    label(field, units, long_name)
    field.flush()  # else its place in the file is found when the last reference to it goes
    return field


def empty_field(parent: h5py.Group, name: str, shape: tuple[int, ...], dtype: Any) -> h5py.Dataset:
    """Create a compressed dataset with checksums, to be filled by the caller, and return it.
    Filters: gzip 1, shuffle, fletcher32, which every HDF5 reader has.
    """
    if 0 in shape:
        return parent.create_dataset(name, shape, dtype)
    return parent.create_dataset(
        name,
        shape,
        dtype,
        chunks=(min(shape[0], CHUNK_ROWS), *shape[1:]),
        compression="gzip",
        compression_opts=1,
        shuffle=True,
        fletcher32=True,
    )


def label(field: h5py.Dataset, units: str, long_name: str) -> None:
    """Set the unit and the name that viewers show."""
    set_attributes(field, {"units": units} | ({"long_name": long_name} if long_name else {}))


def share_scale(made: h5py.Group, name: str) -> None:
    """Make a dataset of a group the dimension scale of all others with an axis. xarray, HDFView and
    others know the dimension by it."""
    scale = made[name]
    scale.make_scale(name)
    for field in made.values():
        if field != scale and getattr(field, "shape", ()):
            field.dims[0].attach_scale(scale)


def write_values(
    made: h5py.Group, values: Mapping[str, Any], units: Mapping[str, str], prefix: str = ""
) -> None:
    """Write nested values as nested groups. `units` maps dotted names to their units; what has a
    unit is a number: NaN where it was left out, also in a list, and an empty list is an empty
    array."""
    names = UniqueNames(*made)
    for key, value in values.items():
        name, dotted = names.name(key), f"{prefix}{key}"
        if isinstance(value, Mapping):
            write_values(group(made, name, "NXparameters"), value, units, f"{dotted}.")
            continue
        quantity = dotted in units
        field = made.create_dataset(name, data=_number(value) if quantity else _field_value(value))
        if quantity and field.dtype.kind in "iuf":
            field.attrs["units"] = plain_text(units[dotted])


def _number(value: Any) -> Any:
    """Return the value of a quantity, which is a number also where there is none."""
    if value is None:
        return math.nan
    if isinstance(value, (list, tuple)) and not value:
        import numpy as np

        return np.empty(0, np.float64)
    if isinstance(value, (list, tuple)) and all(
        v is None or type(v) in (int, float) for v in value
    ):
        return [math.nan if v is None else float(v) for v in value]
    return _field_value(value)


def _field_value(value: Any) -> Any:
    """Return a number, text or list of numbers as it is, anything else as its JSON text."""
    if isinstance(value, (bool, float)):
        return value
    if isinstance(value, int) and abs(value) < 2**63:
        return value
    if isinstance(value, str):
        return plain_text(value)
    if isinstance(value, (list, tuple)) and value and all(type(v) is float for v in value):
        return list(value)
    if isinstance(value, (list, tuple)) and value and all(type(v) in (int, float) for v in value):
        return [float(v) for v in value] if all(abs(v) < 2**53 for v in value) else to_json(value)
    if _is_matrix(value):
        return [[float(number) for number in row] for row in value]
    return to_json(value)


def _is_matrix(value: Any) -> bool:
    """Rows of equally many numbers, each exact as a float."""
    rows = value if isinstance(value, (list, tuple)) else []
    return (
        bool(rows)
        and all(isinstance(row, (list, tuple)) and row for row in rows)
        and len({len(row) for row in rows}) == 1
        and all(type(v) is float or (type(v) is int and abs(v) < 2**53) for r in rows for v in r)
    )


def write_note(entry: h5py.Group, name: str, kind: str, file_name: str, data: str) -> None:
    """Write a text of media type `kind` as an NXnote."""
    note = group(entry, name, "NXnote")
    text_field(note, "type", kind)
    text_field(note, "file_name", file_name)
    text_field(note, "data", data)
